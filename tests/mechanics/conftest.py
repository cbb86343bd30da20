"""A robot with a gear, two servos on a hip, a gripper that slides, and a differential wrist."""

from collections.abc import Callable
from pathlib import Path

import pytest

from dxlrun.plan.robot_plan import Plan
from dxlrun.testing import plan_of

ROBOT = """\
name: body
buses:
  main: {port: sim, protocol: 2.0, baud_rate: 1_000_000, return_delay_time: 0 us, adapter: {kind: direct}}
loop: {rate: 50}
joints:
  head: {bus: main, id: 1, model: XL430-W250, reference: 180 deg, direction: 1, gear_ratio: 2,
         limits: {position: [-40 deg, 40 deg]}}
  hip: {bus: main, model: XM430-W350, reference: 180 deg, direction: 1,
        servos: [{id: 2}, {id: 3, direction: -1}], limits: {position: [-60 deg, 60 deg]}}
  gripper: {bus: main, id: 7, model: XL430-W250, reference: 180 deg, direction: 1, travel_per_turn: 94.2 mm,
            limits: {position: [0 mm, 40 mm], velocity: 100 mm/s}}
  pitch: {limits: {position: [-45 deg, 45 deg]}}
  roll: {limits: {position: [-60 deg, 60 deg]}}
transmissions:
  wrist:
    type: differential
    joints: [pitch, roll]
    servos:
      left: {bus: main, id: 5, model: XM430-W350, reference: 180 deg, direction: 1}
      right: {bus: main, id: 6, model: XM430-W350, reference: 180 deg, direction: -1}
controllers:
  states: {type: joint_state_broadcaster}
  all: {type: joint_group_position_controller, joints: [head, hip, gripper, pitch, roll]}
"""


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
