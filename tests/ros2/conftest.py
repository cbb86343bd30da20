"""What ROS programs see of a robot is judged in a ROS environment of its own."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.ros2.started import PYTHON, Place


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Place]:
    """A place for the tests of a file."""
    if not PYTHON:
        pytest.skip("needs DXLRUN_ROS2_PYTHON: a Python of a ROS environment that has dxlrun_ros2")
    assert Path(PYTHON).with_name("dxlrun-ros2").exists(), f"{PYTHON} has no dxlrun-ros2 beside it"
    folder = tmp_path_factory.mktemp("ros")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_RUNTIME_DIR", str(folder))
        one = Place(folder)
        yield one
        one.end()
