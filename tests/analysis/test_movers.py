"""Which servos move which joints, by the plan in a log, and what an analysis makes of it."""

import math

import msgspec
import pytest
from msgspec import structs
from tests.kit.made_logs import JOINTS, Cycle, loop_of

from dxlrun.log.log_reader import read_log
from dxlrun.plan.loop_plan import JointPlan
from dxlrun.plan.mechanics_plan import CouplingPlan
from dxlrun_analysis.joints.goal_tracking import tracking
from dxlrun_analysis.plan_excerpt import LoggedPlan, plan_of
from dxlrun_analysis.report import analyze, tables
from dxlwire.joint_unit import LINEAR, ROTARY, JointUnit

TICK = math.tau / 4096


def servo(row: int, joint: str, **more: object) -> dict[str, object]:
    return {"joint": joint, "row": row, "servo_id": row + 1, "rad_per_tick": TICK, **more}


def plan(
    servos: list[dict[str, object]], *, unit: JointUnit = ROTARY, **mechanics: object
) -> dict[str, object]:
    loop = loop_of(joints=tuple(JointPlan(name, 0.0, 1.0, None, unit=unit) for name in JOINTS))
    return {"loop": loop, "buses": [{"name": "main", "servos": servos}], "mechanics": mechanics}


def test_a_gear_and_a_slide_share_their_ratio(write):
    geared = plan([servo(row, joint, ratio=0.25) for row, joint in enumerate(JOINTS)], unit=LINEAR)
    path = write([Cycle(0), Cycle(1)], plan=geared)
    movers = plan_of(read_log(path)).movers
    assert [[(each.servo.servo_id, each.share) for each in movers[name]] for name in JOINTS] == [
        [(1, 0.25)],
        [(2, 0.25)],
    ]
    assert {one.unit for one in tracking(read_log(path))} == {LINEAR}
    table = tables(analyze(read_log(path)))["joints"]
    assert "linear joints in mm" in table.title


def test_a_differentials_joints_have_both_servos_and_a_pair_shares_its_joint():
    both = [servo(0, "wrist/left"), servo(1, "wrist/right", ratio=0.5)]
    coupling = structs.asdict(CouplingPlan("wrist", (0, 1), (0, 1), ((0.5, 0.5), (0.5, -0.5)), ()))
    movers = msgspec.convert(plan(both, couplings=[coupling]), LoggedPlan).movers
    for name in JOINTS:
        assert [(each.servo.own_name, each.share) for each in movers[name]] == [
            ("wrist/left", 0.5),
            ("wrist/right", 0.25),
        ]
    pair = [servo(0, JOINTS[0], name="hip/1"), servo(1, JOINTS[0], name="hip/2"), servo(2, JOINTS[1])]
    one = structs.asdict(CouplingPlan("hip", (0,), (0, 1), ((0.5, 0.5),), ()))
    movers = msgspec.convert(plan(pair, couplings=[one], direct=[(1, 2)]), LoggedPlan).movers
    assert sum(each.share for each in movers[JOINTS[0]]) == pytest.approx(1.0)
    assert [each.servo.own_name for each in movers[JOINTS[0]]] == ["hip/1", "hip/2"]
    assert [each.servo.servo_id for each in movers[JOINTS[1]]] == [3]
