"""A crane of two servos with a URDF, and sensors on it."""

from collections.abc import Callable
from pathlib import Path

import pytest
from tests.kit.robots import CASES


@pytest.fixture
def crane(tmp_path: Path) -> Callable[..., Path]:
    """Return what writes the robot with other texts in it."""
    files = (CASES / "sensors.txt").read_text("utf-8").partition("====\n")[0]
    robot, _, urdf = files.partition("---- crane.urdf\n")
    (tmp_path / "crane.urdf").write_text(urdf)

    def write(*changes: tuple[str, str]) -> Path:
        text = robot
        for old, new in changes:
            assert old in text
            text = text.replace(old, new)
        (tmp_path / "crane.yaml").write_text(text)
        return tmp_path / "crane.yaml"

    return write
