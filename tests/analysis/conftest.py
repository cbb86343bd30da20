"""Logs of runs that are known to the last number."""

from functools import partial

import pytest
from tests.kit.made_logs import made_log


@pytest.fixture
def write(tmp_path):
    """Write a log of these cycles, packets and events; return its path."""
    return partial(made_log, tmp_path)
