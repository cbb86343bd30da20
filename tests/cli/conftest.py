from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from dxlsim.bus.ledger import LedgerEntry, read_ledger
from dxlsim.simulation_plan import BusConfig
from exchange.simulated import SimulatedServos

ROBOTS = Path(__file__).parents[2] / "robots"


@pytest.fixture
def torso() -> Path:
    return ROBOTS / "bioloid_torso.yaml"


@pytest.fixture
def three_parts() -> Path:
    return ROBOTS / "motions" / "three_parts.yaml"


@pytest.fixture
def reader(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Working directory of a reader of the pages, with `robots`; no robot runs."""
    (tmp_path / "robots").symlink_to(ROBOTS)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    return tmp_path


SimulatedLine = Callable[[BusConfig], tuple[str, Callable[[], tuple[LedgerEntry, ...]]]]


@pytest.fixture
def simulated_line(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SimulatedLine]:
    """Serve a simulated bus; gives its pseudo-terminal, and what ends it and has the ledger."""
    ledger = tmp_path_factory.mktemp("line") / "ledger.jsonl"
    with ExitStack() as stack:

        def start(bus: BusConfig) -> tuple[str, Callable[[], tuple[LedgerEntry, ...]]]:
            served = stack.enter_context(SimulatedServos((bus,), -1, ledger))

            def finish() -> tuple[LedgerEntry, ...]:
                stack.close()
                return tuple(read_ledger(ledger))

            return served.ports[0], finish

        yield start
