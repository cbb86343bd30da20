"""Frames of a running robot: the gateway gives the URDF, the client computes where a frame lies now."""

import json

import numpy as np
import pytest
from msgspec.structs import replace

import dxlrun
from dxlrun.channels.cycle import CycleLayout, CycleRecord
from dxlrun.description.frames.tree import ORIENTATION, FramesPlan
from dxlrun.remote.client import RemoteRobot

URDF = """<robot name="pair">
<link name="base_link"/><link name="imu_link"/><link name="pan"/><link name="tilt"/>
<joint name="mount" type="fixed"><parent link="base_link"/><child link="imu_link"/></joint>
<joint name="pan" type="revolute"><parent link="base_link"/><child link="pan"/><axis xyz="0 0 1"/></joint>
<joint name="tilt" type="prismatic"><parent link="pan"/><child link="tilt"/><origin xyz="1 0 0"/></joint>
</robot>"""


class DeskLink:
    """Requests to the gateway without a socket."""

    def __init__(self, desk):
        self.asked, self._desk = [], desk

    def exchange(self, method, path, body):
        self.asked.append(path)
        status, answer = self._desk.ask(method, path)
        return status, json.dumps(answer).encode()


def with_urdf(desk, imu=""):
    """Let the robot of a desk have the URDF, and its IMU lie on its side once it is known."""
    layout = CycleLayout(("pan", "tilt"), ("left", "right", "spare"), (), {"imu": ORIENTATION})
    desk.record, desk.link._record = CycleRecord(layout), CycleRecord(layout)
    loop = replace(desk.link.plan.loop, urdf=URDF)
    desk.link.plan = replace(desk.link.plan, loop=loop, frames=FramesPlan(30.0, ("pan", "tilt"), imu))
    link = DeskLink(desk)
    return RemoteRobot("pair", link), link


def test_a_pose_is_that_of_the_newest_cycle(desk):
    robot, link = with_urdf(desk)
    for pan, tilt in ((np.pi / 2, 0.5), (0.0, -0.25)):
        desk.record.states.position[:] = (pan, tilt)
        desk.finish_cycle()
        found = robot.pose("tilt", "base_link")
        assert found.translation == pytest.approx(((1 + tilt) * np.cos(pan), (1 + tilt) * np.sin(pan), 0))
    assert robot.frames().pose("tilt", "pan", {"tilt": 3.0}).translation == (4, 0, 0)
    assert link.asked.count("/frames") == 1  # the tree stays as it is


def test_what_is_not_known_has_no_pose(desk):
    robot, _ = with_urdf(desk)
    desk.record.states.position[:] = (np.nan, 0.5)
    desk.finish_cycle()

    with pytest.raises(ValueError, match="a position is missing"):
        robot.pose("tilt", "base_link")
    assert robot.pose("tilt", "pan").translation == (1.5, 0, 0)
    with pytest.raises(LookupError, match=r"frame tlt not found; did you mean tilt\?"):
        robot.pose("tlt")


def test_the_body_turns_with_its_imu(desk):
    robot, _ = with_urdf(desk, "imu")
    desk.record.states.position[:] = (0.0, 0.0)
    desk.finish_cycle()
    with pytest.raises(ValueError, match="a position is missing"):
        robot.pose("pan", "odom")
    desk.record.sources.values[:] = (2.0, 0.0, 0.0, 2.0)  # on its side, and not of length 1
    desk.finish_cycle()

    assert robot.pose("pan", "odom").rpy == pytest.approx((np.pi / 2, 0, 0))
    states = robot.states()
    assert states.joint("pan")["position"] == 0.0
    assert states.joint("pan")["temperature"] is None
    assert (states.source_states[0], states.source_state[0]) == ("imu/orientation.x", 2.0)


def test_a_robot_without_a_urdf_says_so(desk):
    with pytest.raises(dxlrun.DxlrunError, match=r"pair has no URDF; write `model: {urdf"):
        RemoteRobot("pair", DeskLink(desk)).frames()
