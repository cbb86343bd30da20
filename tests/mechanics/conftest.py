"""A robot with a gear, two servos on a hip, a gripper that slides, and a differential wrist."""

from collections.abc import Callable
from pathlib import Path

import pytest
from tests.kit.cases import read_head

from dxlrun.plan.robot_plan import Plan
from dxlrun.testing import plan_of

ROBOT = read_head(Path(__file__).parents[1] / "robots/stories/coupled.txt")


@pytest.fixture
def plan(tmp_path: Path) -> Callable[..., Plan]:
    """Compile the robot with some of its text changed."""

    def compiled(*changes: tuple[str, str], more: str = "", duration_s: float = 1.0) -> Plan:
        text = ROBOT
        for old, new in changes:
            assert old in text
            text = text.replace(old, new)
        path = tmp_path / "body.yaml"
        path.write_text(text + more)
        return plan_of(path, duration_s=duration_s)

    return compiled
