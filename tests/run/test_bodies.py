"""A robot file whose simulated servos move a body together, on virtual time."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from dxlrun.log.log_reader import read_log
from dxlrun.testing import simulated_robot

ARM = """\
name: arm
buses: {main: {port: sim, protocol: 2.0, baud_rate: 1_000_000}}
loop: {rate: 50}
joints:
  elbow: {bus: main, id: 2, model: XM430-W350, reference: 180 deg, direction: -1}
  shoulder: {bus: main, id: 1, model: XM430-W350, reference: 180 deg, direction: 1}
controllers:
  states: {type: joint_state_broadcaster}
  arm: {type: joint_group_position_controller, joints: [shoulder, elbow]}
model: {urdf: arm.urdf}
"""
LEVER, MASS = 0.15, 0.3
PULL = MASS * 9.81 * LEVER
"""Nm of one link where it sticks out"""
TORQUE_PER_AMPERE = 4.1 / 2.3
"""Nm/A of an XM430-W350 (e-Manual, Specifications)"""
LINK = (
    f'<inertial><origin xyz="{LEVER} 0 0"/><mass value="{MASS}"/>'
    '<inertia ixx="1e-6" iyy="1e-6" izz="1e-6" ixy="0" ixz="0" iyz="0"/></inertial>'
)
URDF = f"""<robot name="arm"><link name="base"/>
<link name="upper">{LINK}</link>
<link name="lower">{LINK}</link>
<joint name="shoulder" type="continuous">
<parent link="base"/><child link="upper"/><axis xyz="0 -1 0"/></joint>
<joint name="elbow" type="continuous">
<parent link="upper"/><child link="lower"/><origin xyz="{LEVER} 0 0"/><axis xyz="0 -1 0"/></joint>
</robot>
"""
"""Both links point along x at 0, and rise with their angles."""


def _held(folder: Path, physics: str) -> dict[str, tuple[float, float]]:
    """Return angle, rad, and effort, A, of each joint after it was held for 2 s where it stood."""
    (folder / "arm.urdf").write_text(URDF, encoding="utf-8")
    robot, log = folder / f"{physics}.yaml", folder / f"{physics}.mcap"
    robot.write_text(f"{ARM}simulation: {{physics: {physics}}}\n", encoding="utf-8")
    assert simulated_robot(robot, duration_s=2.0, log=log).run().reason == "ended"
    record = read_log(log)
    last = record.cycles[-1]
    return {
        joint: (float(last["position"][row]), float(last["effort"][row]))
        for row, joint in enumerate(record.joints)
    }


@pytest.mark.needs("physics")
def test_the_weight_of_both_links_hangs_on_the_shoulder(tmp_path):
    held = _held(tmp_path, "mujoco")
    (shoulder, shoulder_effort), (elbow, elbow_effort) = held["shoulder"], held["elbow"]
    lower = PULL * math.cos(shoulder + elbow)
    assert elbow_effort * TORQUE_PER_AMPERE == pytest.approx(lower, rel=0.05)
    # the lower link hangs on the upper one's lever, too
    assert shoulder_effort * TORQUE_PER_AMPERE == pytest.approx(
        2 * PULL * math.cos(shoulder) + lower, rel=0.05
    )


def test_independent_joints_do_not_feel_the_urdf(tmp_path):
    for angle, effort in _held(tmp_path, "independent").values():
        assert angle == pytest.approx(0.0, abs=math.radians(0.2))
        assert effort == pytest.approx(0.0, abs=0.01)
