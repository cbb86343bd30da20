"""Runs without a joint: its servos get no packet, and nothing changes for the other joints."""

from pathlib import Path

import pytest
from msgspec.structs import replace
from tests.kit.virtual_run import VirtualRun
from tests.kit.wire import taken_apart, writes

from dxlrun.compile.robot_compiler import compile_files
from dxlrun.run.kept_files import state_directory
from dxlrun_analysis.replay import replay_log

ROBOTS = Path(__file__).parents[2] / "robots"
ALONE = (
    "single_joint",
    "held_arm",
    "open_manipulator_x_space",
    "koch_space",
    "koch_leads",
    "op3_space",
)  # no joint can be omitted
EXAMPLES = sorted(path for path in ROBOTS.glob("*.yaml") if not path.stem.startswith(ALONE))
READS = frozenset((0x82, 0x8A, 0x92))  # sync read, fast sync read, bulk read


@pytest.mark.parametrize(
    ("name", "joint", "motion"),
    [("bioloid_torso", "head_yaw_joint", "three_parts"), ("mechanics", "hip", "mechanics_reach")],
)
def test_servos_of_a_joint_get_no_packet(tmp_path, name, joint, motion):
    files = ROBOTS / f"{name}.yaml", {}, [ROBOTS / f"motions/{motion}.yaml"]
    whole = compile_files(*files).plan
    plan = compile_files(*files, 1_500_000_000, without=[joint]).plan
    absent = {servo.servo_id for _, servo in whole.servos_by_joint[joint]}
    robot = VirtualRun(plan, tmp_path / "run.mcap")
    log = robot.finish()
    (bus,) = robot.buses
    addressed: set[int] = set()
    for sent in taken_apart(bus.ledger.entries, plan.buses[0].protocol):
        addressed.add(sent.servo_id)
        addressed |= {one[0] for one in writes(sent, plan.buses[0].protocol)}
        if sent.instruction in READS:
            addressed |= {*sent.parameters[4:]}
    assert addressed >= {servo.servo_id for servo in plan.buses[0].servos}
    assert not addressed & absent
    assert joint not in log.joints
    assert replay_log(log.path, arguments={"port": "sim"}).same


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_limits_and_servos_of_the_others_are_those_of_the_whole_robot(path):
    whole = compile_files(path, {}, []).plan
    for joint in (whole.loop.joints[0], whole.loop.joints[-1]):
        plan = compile_files(path, {}, [], without=[joint.name]).plan
        assert plan.loop.joints == tuple(one for one in whole.loop.joints if one != joint)
        for name, each in plan.servos_by_joint.items():
            servos = [[replace(one, row=0) for _, one in two] for two in (each, whole.servos_by_joint[name])]
            assert servos[0] == servos[1]
        assert state_directory(plan) != state_directory(whole)
