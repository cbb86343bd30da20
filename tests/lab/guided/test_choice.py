"""Which joints an experiment may move, and how far: what is wrong is refused in a sentence each."""

import math
from pathlib import Path

import pytest

from dxlrun.errors import InputError
from dxlrun.testing import plan_of
from dxlrun_lab.commands.on_robot import RobotFileArguments
from dxlrun_lab.guided.choice import parse_ranges, situation_of, whole_situation
from dxlrun_lab.guided.virtual_rig import virtual_rig

ROBOT = """\
name: mixed
buses:
  main: {port: sim, protocol: 2.0, baud_rate: 1_000_000, return_delay_time: 0 us}
loop: {rate: 100}
joint_defaults: {bus: main, model: XM430-W350, reference: 180 deg, direction: 1}
joints:
  narrow: {id: 1, limits: {position: [-20 deg, 90 deg]}}
  wheel: {id: 2, continuous: true}
  limp: {id: 3, torque: off}
controllers:
  hold: {type: joint_group_position_controller, joints: [narrow]}
"""


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    file = tmp_path_factory.mktemp("choice") / "mixed.yaml"
    file.write_text(ROBOT)
    rig = virtual_rig(plan_of(file))
    yield rig
    rig.close()


def test_a_range_is_used_as_given_or_is_around_the_joint_within_its_limits(rig):
    (joint,) = situation_of(rig, ["narrow"], {}).joints
    assert math.degrees(joint.lower) == pytest.approx(-20, abs=0.1), "its limit is nearer than 30 deg"
    assert math.degrees(joint.upper) == pytest.approx(30, abs=0.1)
    assert joint.chosen.startswith("30 deg to each side of where it is, within its limits of -20")
    low, high = joint.inner
    assert joint.lower < low < joint.middle < high < joint.upper
    ranges = parse_ranges(["narrow=-10deg..0.5 rad", "wheel=-720 deg..720deg"])
    joints = situation_of(rig, ["wheel", "narrow"], ranges).joints
    assert [joint.name for joint in joints] == ["wheel", "narrow"], "as on the command line"
    assert (joints[1].lower, joints[1].upper) == (math.radians(-10), 0.5)
    assert joints[0].upper == pytest.approx(4 * math.pi)


def test_whole_range_is_that_of_the_limits_with_room_for_an_overshoot(rig):
    (joint,) = whole_situation(rig, ["narrow"]).joints
    assert [math.degrees(end) for end in (joint.lower, joint.upper)] == pytest.approx([-25, 95], abs=0.1)


def test_joint_outside_of_its_range_or_without_torque_is_refused(rig):
    """Other refusals are in tests/cli/refusals.txt."""
    with pytest.raises(InputError) as caught:
        situation_of(rig, ["narrow", "limp"], {"narrow": (math.radians(10), math.radians(60))})
    assert caught.value.sentences == (
        "joint narrow is at 0 deg, outside of its --range; move the joint inside first",
        "joint limp (ID 3 on bus main) is limp; enable its torque first: dxlrun torque on limp",
    )


def test_words_are_a_robot_file_its_arguments_and_joints():
    parse = RobotFileArguments.parse_words
    words = RobotFileArguments(Path("a.yaml"), ("port:=sim",), ("x", "y"))
    assert parse(["a.yaml", "port:=sim", "x", "y"]) == words
    assert parse(["x", "y"]) == RobotFileArguments(None, (), ("x", "y"))
    with pytest.raises(InputError, match="port:=sim is an argument of a robot file, but no file is given"):
        parse(["x", "port:=sim"])
