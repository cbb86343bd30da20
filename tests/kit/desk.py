"""A desk: files are written into the working directory and read; problems come as text without the folder."""

from collections.abc import Callable, Mapping
from pathlib import Path

import pytest
from tests.kit.robots import robot_text

from dxlrun.description.motion import MotionDescription, read_motion
from dxlrun.description.reading import Description, read_robot
from dxlrun.errors import InputError

TORSO = robot_text("torso")
NO_ARGUMENTS: Mapping[str, str] = {}


def write(text: str | bytes, name: str = "robot.yaml") -> Path:
    path = Path.cwd() / name
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return path


def robot(text: str, arguments: Mapping[str, str] = NO_ARGUMENTS) -> Description:
    """Read a robot file that is right."""
    return read_robot(write(text), arguments)


def motion(text: str) -> MotionDescription:
    """Read a motion file that is right."""
    return read_motion(write(text, "motion.yaml"))


def refusals(text: str | bytes, arguments: Mapping[str, str] = NO_ARGUMENTS) -> list[str]:
    """Return the problems of a robot file."""
    path = write(text)
    return caught(lambda: read_robot(path, arguments))


def motion_refusals(text: str) -> list[str]:
    """Return the problems of a motion file."""
    path = write(text, "motion.yaml")
    return caught(lambda: read_motion(path))


def caught(read: Callable[[], object]) -> list[str]:
    """Return the problems that reading raises."""
    with pytest.raises(InputError) as found:
        read()
    return [str(problem).replace(f"{Path.cwd()}/", "") for problem in found.value.problems]
