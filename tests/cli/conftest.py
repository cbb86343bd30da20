from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.kit.bus_process import SimulatedLine, simulated_lines
from tests.kit.rigs import VirtualLines

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


@pytest.fixture
def simulated_line(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SimulatedLine]:
    """Serve a simulated bus; gives its pseudo-terminal, and what ends it and has the ledger."""
    with simulated_lines(tmp_path_factory.mktemp("line")) as serve:
        yield serve


@pytest.fixture
def virtual_lines(monkeypatch: pytest.MonkeyPatch) -> VirtualLines:
    return VirtualLines(monkeypatch)
