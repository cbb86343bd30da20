"""A simulated bus in a process of its own."""

from __future__ import annotations

import json

import pytest
from tests.kit.awaited import DEADLINE_S
from tests.kit.bus_process import started

from dxlsim.bus.ledger import read_ledger


@pytest.fixture
def simulated_line(tmp_path):
    """Run a simulated bus as a run does; gives its pseudo-terminal, and what ends it and has the ledger."""
    children = []

    def start(bus):
        ledger = tmp_path / f"ledger{len(children)}.jsonl"
        child, ours = started((bus,), ledger=str(ledger))
        children.append((child, ours))
        ours.settimeout(60)

        def finish():
            ours.close()
            assert child.wait(DEADLINE_S) == 0
            return read_ledger(ledger)

        return json.loads(ours.recv(4096))["ports"][bus.name], finish

    yield start
    for child, ours in children:
        child.kill()
        child.wait()
        ours.close()
