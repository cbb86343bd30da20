from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from dxlsim.bus.ledger import LedgerEntry, read_ledger
from dxlsim.simulation_plan import BusConfig
from exchange.simulated import SimulatedServos


@pytest.fixture
def torso() -> Path:
    return Path(__file__).parents[2] / "robots" / "bioloid_torso.yaml"


@pytest.fixture
def three_parts() -> Path:
    return Path(__file__).parents[2] / "robots" / "motions" / "three_parts.yaml"


SimulatedLine = Callable[[BusConfig], tuple[str, Callable[[], tuple[LedgerEntry, ...]]]]


@pytest.fixture
def simulated_line(tmp_path: Path) -> Iterator[SimulatedLine]:
    """Serve a simulated bus; gives its pseudo-terminal, and what ends it and has the ledger."""
    with ExitStack() as stack:

        def start(bus: BusConfig) -> tuple[str, Callable[[], tuple[LedgerEntry, ...]]]:
            ledger = tmp_path / "ledger.jsonl"
            served = stack.enter_context(SimulatedServos((bus,), -1, ledger))

            def finish() -> tuple[LedgerEntry, ...]:
                stack.close()
                return tuple(read_ledger(ledger))

            return served.ports[0], finish

        yield start
