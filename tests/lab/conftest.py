"""Rigs of virtual time, and a directory to run commands in."""

from collections.abc import Callable
from pathlib import Path

import pytest
from tests.kit.experiments import ROBOTS

from dxlrun.testing import plan_of
from dxlrun_lab.guided.rig import Rig
from dxlrun_lab.guided.virtual_rig import virtual_rig

Rigs = Callable[[Path], Rig]


@pytest.fixture
def own_rig(tmp_path):
    """Return a function that makes a rig of a robot file; its log is in `tmp_path`."""
    rigs: list[Rig] = []

    def make(robot: Path) -> Rig:
        rigs.append(virtual_rig(plan_of(robot), log=tmp_path / f"{len(rigs)}.mcap"))
        return rigs[-1]

    yield make
    for rig in rigs:
        rig.close()


@pytest.fixture
def arm(own_rig):
    """A rig of an arm with two joints in a chain of controllers."""
    return own_rig(ROBOTS / "effort_arm.yaml")


@pytest.fixture
def single(own_rig):
    return own_rig(ROBOTS / "single_joint.yaml")


@pytest.fixture
def here(tmp_path, monkeypatch):
    """Work in a directory of the test, with the robots in it."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    (tmp_path / "robots").symlink_to(ROBOTS)
    return tmp_path
