"""A leader and a follower arm as learning frameworks such as LeRobot drive them, by the maker's SDK.

The sequence is theirs: greet every servo, configure, find the middle by Homing Offset, then read the leader
and write the follower as fast as it goes, on one group object each, whose address changes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import pytest
from dynamixel_sdk import COMM_SUCCESS, GroupSyncRead, GroupSyncWrite
from tests.foreign.conftest import Item
from tests.kit.awaited import until

from dxlsim.simulation_plan import BusConfig, ServoConfig
from dxlwire.control_table import ControlItem, find_table

PROTOCOL = 2.0
LEADER = dict.fromkeys(range(1, 7), "XL330-M077")
FOLLOWER = {1: "XL430-W250", 2: "XL430-W250", **dict.fromkeys(range(3, 7), "XL330-M288")}
GRIPPER = 6
EXTENDED_POSITION, CURRENT_BASED_POSITION = 4, 5


def arm(name: str, models: Mapping[int, str]) -> BusConfig:
    servos = tuple(ServoConfig(each, model, 2.0 + 0.2 * each) for each, model in models.items())
    return BusConfig(name, 1_000_000, servos, 2.0)


BUSES = (
    *(arm(name, LEADER) for name in ("leader", "leader again")),
    *(arm(name, FOLLOWER) for name in ("follower", "follower again", "follower apart")),
)


class Arm:
    """What such a framework knows of an arm: items by name, values as integers, one call for all servos."""

    def __init__(self, host: Any, models: Mapping[int, str]) -> None:
        self.models, self.host = models, host
        self._reader = GroupSyncRead(host.port, host.sdk, 0, 0)
        self._writer = GroupSyncWrite(host.port, host.sdk, 0, 0)

    def greet(self) -> dict[int, int]:
        return {each: self.host.ping(each) for each in self.models}

    def item(self, name: str, servo_id: int) -> ControlItem:
        return find_table(self.models[servo_id], 2.0).items[name]

    def write(self, name: str, servo_id: int, value: int) -> None:
        item = self.item(name, servo_id)
        self.host.write(servo_id, Item(item.address, item.size), value % (1 << 8 * item.size))

    def read_all(self, name: str) -> dict[int, int]:
        item = self.item(name, 1)
        self._reader.clearParam()
        self._reader.start_address, self._reader.data_length = item.address, item.size
        for each in self.models:
            assert self._reader.addParam(each)
        assert self._reader.txRxPacket() == COMM_SUCCESS
        wires = {each: self._reader.getData(each, item.address, item.size) for each in self.models}
        return {each: item.decode(wire.to_bytes(item.size, "little")) for each, wire in wires.items()}

    def write_all(self, name: str, values: Mapping[int, int]) -> None:
        item = self.item(name, 1)
        self._writer.clearParam()
        self._writer.start_address, self._writer.data_length = item.address, item.size
        for each, value in values.items():
            wire = value % (1 << 8 * item.size)
            assert self._writer.addParam(each, list(wire.to_bytes(item.size, "little")))
        assert self._writer.txPacket() == COMM_SUCCESS

    def configure(self) -> None:
        for each in self.models:
            self.write("torque_enable", each, 0)
            self.write("return_delay_time", each, 0)
            has_current = "goal_current" in find_table(self.models[each], 2.0).items
            mode = CURRENT_BASED_POSITION if each == GRIPPER and has_current else EXTENDED_POSITION
            self.write("operating_mode", each, mode)
            self.write("position_p_gain", each, 800)

    def centre(self) -> None:
        """Let the pose in which the arm is be the middle of each joint's turn."""
        self.write_all("homing_offset", dict.fromkeys(self.models, 0))
        for each, position in self.read_all("present_position").items():
            self.write("homing_offset", each, 2047 - position)


@pytest.fixture
def connect_arm(connect: Any) -> Callable[[str], Arm]:
    return lambda name: Arm(connect(name), LEADER if name.startswith("leader") else FOLLOWER)


@pytest.mark.parametrize("name", ["leader", "follower"])
def test_an_arm_has_the_promised_models_and_its_pose_becomes_the_middle_of_its_joints(
    connect_arm: Any, name: str
) -> None:
    held = connect_arm(name)
    assert held.greet() == {each: find_table(model, 2.0).model_number for each, model in held.models.items()}
    held.configure()
    held.centre()
    assert all(abs(position - 2047) <= 1 for position in held.read_all("present_position").values())


def test_a_follower_goes_where_its_leader_is(connect_arm: Any) -> None:
    leader, follower = connect_arm("leader again"), connect_arm("follower again")
    for each in (leader, follower):
        each.configure()
    start = follower.read_all("present_position")
    follower.write_all("goal_position", start)
    follower.write_all("torque_enable", dict.fromkeys(FOLLOWER, 1))
    goals: dict[int, int] = {}
    for cycle in range(40):
        pose = leader.read_all("present_position")
        goals = {each: pose[each] + 3 * cycle for each in pose}
        follower.write_all("goal_position", goals)
    assert follower.read_all("goal_position") == goals

    def there() -> bool:
        present = follower.read_all("present_position")
        return all(abs(present[each] - goal) <= 20 for each, goal in goals.items())

    assert until(there)
    assert all(leader.read_all("torque_enable")[each] == 0 for each in LEADER)
    follower.write_all("torque_enable", dict.fromkeys(FOLLOWER, 0))
    assert set(follower.read_all("torque_enable").values()) == {0}


def test_what_was_configured_is_there_for_the_next_connection(connect_arm: Any) -> None:
    first = connect_arm("follower apart")
    first.configure()
    first.host.port.closePort()
    again = connect_arm("follower apart")
    assert set(again.read_all("return_delay_time").values()) == {0}
    modes = {**dict.fromkeys(FOLLOWER, EXTENDED_POSITION), GRIPPER: CURRENT_BASED_POSITION}
    assert again.read_all("operating_mode") == modes
