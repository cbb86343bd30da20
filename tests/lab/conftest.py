"""Rigs of virtual time, and a directory to run commands in."""

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from tests.kit.experiments import ROBOTS

from dxlrun.testing import plan_of
from dxlrun_lab.guided.rig import Rig
from dxlrun_lab.guided.virtual_rig import virtual_rig

Rigs = Callable[[Path], Rig]


@pytest.fixture
def own_rig(tmp_path: Path) -> Iterator[Rigs]:
    """Return a function that makes a rig of a robot file; its log is in `tmp_path`."""
    rigs: list[Rig] = []

    def make(robot: Path) -> Rig:
        rigs.append(virtual_rig(plan_of(robot), log=tmp_path / f"{len(rigs)}.mcap"))
        return rigs[-1]

    yield make
    for rig in rigs:
        rig.close()


@pytest.fixture(scope="module")
def rigs(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[[str], Rig]]:
    """Return a function that gives the rig of a robot which the tests of a module share while it runs."""
    made: dict[str, Rig] = {}

    def rig(name: str) -> Rig:
        if name not in made or not made[name].robot.link.alive:
            log = tmp_path_factory.mktemp("rig") / "run.mcap"
            made[name] = virtual_rig(plan_of(ROBOTS / f"{name}.yaml"), log=log)
        made[name].robot.link.each_cycle = lambda cycle: None
        return made[name]

    yield rig
    for one in made.values():
        one.close()


@pytest.fixture
def arm(rigs: Callable[[str], Rig]) -> Rig:
    """A shared rig of an arm with two joints in a chain of controllers."""
    return rigs("effort_arm")


@pytest.fixture
def single(rigs: Callable[[str], Rig]) -> Rig:
    """A shared rig of one joint."""
    return rigs("single_joint")


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Work in a directory of the test, with the robots in it."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    (tmp_path / "robots").symlink_to(ROBOTS)
    return tmp_path
