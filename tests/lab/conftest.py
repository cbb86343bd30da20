"""Experiments on rigs of virtual time, and a directory to run commands in."""

import pytest
from tests.kit.experiments import ROBOTS, Stage


@pytest.fixture
def stage(tmp_path):
    stage = Stage(tmp_path)
    yield stage
    for rig in stage.rigs:
        rig.close()


@pytest.fixture
def here(tmp_path, monkeypatch):
    """Work in a directory of the test, with the robots in it."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    (tmp_path / "robots").symlink_to(ROBOTS)
    return tmp_path
