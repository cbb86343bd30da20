"""A seeded sample of the campaign in tests/bench/fuzz_receiver.py; the whole of it has 1,000,000 packets."""

import importlib.util
import sys
from pathlib import Path

import pytest

from dxlrun.dynamixel.wire import protocol1, protocol2

BENCH = Path(__file__).parent.parent / "bench" / "fuzz_receiver.py"


@pytest.fixture(scope="module")
def fuzz():
    spec = importlib.util.spec_from_file_location("fuzz_receiver", BENCH)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up there
    spec.loader.exec_module(module)
    yield module
    del sys.modules[spec.name]


@pytest.mark.parametrize("dialect", [protocol1, protocol2], ids=["protocol1", "protocol2"])
def test_fuzzed_packets_are_delivered_once_and_in_order(fuzz, dialect):
    tally = fuzz.campaign(dialect, 3_000, seed=7)
    assert tally.packets == 3_000
    assert tally.intact - tally.swallowed + tally.accidents == tally.delivered
    assert tally.swallowed < tally.intact // 100
    assert tally.most_pending < dialect.LONGEST
