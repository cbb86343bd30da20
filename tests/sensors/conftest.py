"""A crane of two servos with a URDF, and sensors on it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from dxlrun.errors import InputError
from dxlrun.testing import plan_of

URDF = """\
<robot name="crane">
  <link name="ground"/>
  <link name="mast"><inertial><origin xyz="0 0 0.1"/><mass value="0.1"/>
    <inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="boom"><inertial><origin xyz="0.02 0 0"/><mass value="0.05"/>
    <inertia ixx="1e-5" iyy="1e-5" izz="1e-5" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="tip"/>
  <joint name="turn" type="revolute"><parent link="ground"/><child link="mast"/>
    <origin xyz="0 0 0.2"/><axis xyz="0 0 1"/>
    <limit lower="-3.2" upper="3.2" effort="1" velocity="6"/></joint>
  <joint name="lift" type="revolute"><parent link="mast"/><child link="boom"/>
    <origin xyz="0 0 0.1"/><axis xyz="0 -1 0"/>
    <limit lower="-3.2" upper="3.2" effort="1" velocity="6"/></joint>
  <joint name="mount" type="fixed"><parent link="boom"/><child link="tip"/>
    <origin xyz="0.1 0 0" rpy="0 0 1.5707963267948966"/></joint>
</robot>
"""
ROBOT = """\
name: crane
buses:
  main: {port: sim, protocol: 2.0, baud_rate: 1_000_000, adapter: {latency: 0 ms}}
loop: {rate: 100}
joints:
  turn: {bus: main, id: 1, model: XM430-W350, reference: 180 deg, direction: 1}
  lift: {bus: main, id: 2, model: XM430-W350, reference: 180 deg, direction: 1}
controllers:
  arm: {type: joint_group_position_controller, joints: [turn, lift]}
sensors:
  imu: {type: simulated_imu, link: tip}
model: {urdf: crane.urdf}
"""


@pytest.fixture
def crane(tmp_path: Path) -> Callable[..., Path]:
    """Return what writes the robot with other texts in it."""
    (tmp_path / "crane.urdf").write_text(URDF)

    def write(*changes: tuple[str, str]) -> Path:
        text = ROBOT
        for old, new in changes:
            assert old in text
            text = text.replace(old, new)
        (tmp_path / "crane.yaml").write_text(text)
        return tmp_path / "crane.yaml"

    return write


@pytest.fixture
def refusals(crane: Callable[..., Path]) -> Callable[..., list[str]]:
    """Return what lists the problems of a changed robot file, without its folder."""

    def found(*changes: tuple[str, str]) -> list[str]:
        path = crane(*changes)
        with pytest.raises(InputError) as caught:
            plan_of(path)
        return [str(one).replace(f"{path.parent}/", "") for one in caught.value.problems]

    return found
