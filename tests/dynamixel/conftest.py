"""A simulated bus in a process of its own."""

import pytest
from tests.kit.bus_process import simulated_lines
from tests.kit.rigs import VirtualLines


@pytest.fixture
def simulated_line(tmp_path):
    """Run a simulated bus as a run does; gives its pseudo-terminal, and what ends it and has the ledger."""
    with simulated_lines(tmp_path) as serve:
        yield serve


@pytest.fixture
def virtual_lines(monkeypatch):
    return VirtualLines(monkeypatch)
