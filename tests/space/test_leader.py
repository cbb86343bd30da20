"""A tip that follows the tip of another arm, which a hand moves; judged by what the follower was sent."""

import math
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from tests.kit.judged_arms import apart, example
from tests.kit.stages import Stage
from tests.kit.virtual_run import DrivenRobot
from tests.kit.wire import changes

from dxlrun import RemoteRobot
from dxlrun.testing import plan_of, simulated_robot
from dxlrun_space.cartesian_controller import CartesianController

FILE = "koch_leads_open_manipulator_x"
ROBOT = Path(__file__).parents[2] / "robots" / f"{FILE}.yaml"
JOINTS = ("joint1", "joint2", "joint3", "joint4")
LEADERS = ("leader_pan", "leader_lift", "leader_elbow", "leader_wrist", "leader_roll")
FOLLOWER = example(FILE, "link1", "end_effector_link", *JOINTS)
LEADER = example(FILE, "leader_place", "leader_tip", *LEADERS)
TICK = math.tau / 4096
SIGNS = (1, 1, -1, 1, 1)


def test_an_arm_of_four_joints_follows_a_hand_at_one_of_five() -> None:
    robot = simulated_robot(ROBOT, duration_s=6.0)
    leader = next(bus for bus in robot.buses if bus.name == "koch")
    turns = (0.5, 0.3, 0.4, -0.2, 0.0)
    for number, (turn, sign) in enumerate(zip(turns, SIGNS, strict=True), 1):
        leader.at(3_000_000_000, lambda n=number, t=turn * sign: leader.servo(n).turn_shaft(t, 500_000_000))
    assert robot.run().reason == "ended"
    sent = changes(robot.ledger.entries, robot.plan, 116)
    assert not leader.servo(1).torque_on
    times = np.arange(0.5, 6.0, 0.02)
    rows = np.array([[_at(sent[servo], time) for servo in (11, 12, 13, 14)] for time in times])
    tips = np.array([FOLLOWER.matrix(row)[:3, 3] for row in rows])
    begin, end = (1.2 * LEADER.matrix(at)[:3, 3] for at in ((0.0,) * 5, turns))
    # Soft start within 3 s, then there within the acceleration limit of the tip.
    assert tips[times < 2.9][-1] == pytest.approx(begin, abs=1e-3)
    assert tips[-1] == pytest.approx(end, abs=2e-3)
    assert tips[np.searchsorted(times, 4.2)] == pytest.approx(end, abs=5e-3)
    speeds = [np.linalg.norm(after - before) / 0.02 for before, after in pairwise(tips)]
    assert max(speeds) < 0.5 + 2 * TICK * 0.4 / 0.02
    assert np.abs(np.diff(rows, axis=0)).max() / 0.02 < 4.8


@pytest.mark.parametrize("relative", [True, False])
def test_a_released_follower_stays_and_only_a_relative_one_goes_on_from_there(relative: bool) -> None:
    driven = DrivenRobot(ROBOT, 9.0, {"relative": str(relative).lower()})
    leader = next(bus for bus in driven.virtual.buses if bus.name == "koch")
    ways = (0.0, 0.1, 0.3, 0.0, 0.0), (0.4, 0.2, 0.1, -0.2, 0.0), (-0.3, -0.1, 0.0, 0.0, 0.0)
    for second, turns in zip((3.0, 4.5, 7.0), ways, strict=True):
        for number, (turn, sign) in enumerate(zip(turns, SIGNS, strict=True), 1):
            turned = partial(leader.servo(number).turn_shaft, turn * sign, 500_000_000)
            leader.at(round(second * 1e9), turned)

    def begin(robot: RemoteRobot) -> Any:
        steps = [(4.2, partial(robot.switch, deactivate=["arm"])), (5.5, partial(robot.switch, ["arm"]))]
        return lambda now: steps.pop(0)[1]() if steps and now >= steps[0][0] else None

    driven.run(begin)
    sent = changes(driven.virtual.ledger.entries, driven.virtual.plan, 116)
    times = np.arange(2.9, 9.0, 0.02)
    rows = np.array([[_at(sent[servo], time) for servo in (11, 12, 13, 14)] for time in times])
    tips = np.array([FOLLOWER.matrix(row)[:3, 3] for row in rows])
    before, released, engaged, end = (tips[np.searchsorted(times, at)] for at in (2.9, 4.3, 6.9, 8.9))
    first, second, third = (1.2 * LEADER.matrix(turns)[:3, 3] for turns in np.cumsum(ways, axis=0))
    assert np.linalg.norm(released - before) > 0.02
    assert (rows[(times > 4.3) & (times < 5.5)] == rows[np.searchsorted(times, 4.3)]).all()
    assert np.linalg.norm(second - first) > 0.05
    assert (np.linalg.norm(engaged - released) < 1e-3) == relative
    assert end - engaged == pytest.approx(third - second, abs=2e-3)


def _at(found: list[tuple[float, int]], time: float) -> float:
    return (next((value for at, value in reversed(found) if at <= time), found[0][1]) - 2048) * TICK


def staged(present: Any = (0.0, -0.3, 0.3, 0.3), **keys: Any) -> Stage:
    leader = {"joints": list(LEADERS), "base": "leader_place", "tip": "leader_tip", **keys}
    parameters = {
        "joints": list(JOINTS),
        "base": "link1",
        "tip": "end_effector_link",
        "leader": leader,
        "timeout": "100 ms",
    }
    limits = {"lower": FOLLOWER.lower, "upper": FOLLOWER.upper, "velocity": 4.8}
    return Stage(CartesianController, parameters, present, limits, urdf=plan_of(ROBOT).urdf).activate()


def led(stage: Stage, positions: Any, seconds: float, *, age_s: float = 0.01) -> Any:
    stage.context.reads[:] = *positions, *(age_s,) * len(LEADERS)
    return np.array([stage.update(stage.time_ns * 1e-9 + 0.02) for _ in range(round(seconds / 0.02))])


def test_the_tip_is_at_the_scaled_pose_with_its_offset() -> None:
    stage, lead = staged(scale=0.9, offset=["2 cm", "-1 cm", "3 cm"]), (0.3, 0.2, 0.1, 0.4, 0.0)
    rows = led(stage, lead, 5.0)
    wanted, found = LEADER.matrix(lead), FOLLOWER.matrix(rows[-1])
    assert found[:3, 3] == pytest.approx(0.9 * wanted[:3, 3] + [0.02, -0.01, 0.03], abs=1e-4)
    tips = np.array([FOLLOWER.matrix(row)[:3, 3] for row in rows])
    speeds = np.linalg.norm(np.diff(tips, axis=0), axis=1) / 0.02
    assert speeds.max() < 0.2 * 1.02
    assert np.abs(np.diff(speeds)).max() / 0.02 < 0.5 * 1.1
    turned = (*lead[:3], lead[3] + 0.3, 0.0)
    assert apart(FOLLOWER.matrix(led(stage, turned, 3.0)[-1]), found)[1] == pytest.approx(0.3, abs=0.1)


def test_a_leader_beyond_reach_is_followed_to_the_edge_and_back() -> None:
    stage, far, near = staged(scale=2.0), (0.0, -0.4, -0.3, 0.0, 0.0), (0.2, 0.4, 0.8, 0.0, 0.0)
    rows = np.vstack([led(stage, far, 4.0), led(stage, near, 2.2)])
    assert all(FOLLOWER.within(row) for row in rows)
    assert np.abs(rows[199] - rows[190]).max() < 1e-3, "it rests at the edge"
    assert FOLLOWER.matrix(rows[-1])[:3, 3] == pytest.approx(2 * LEADER.matrix(near)[:3, 3], abs=1e-3)
    assert np.abs(np.diff(rows, axis=0)).max() <= 4.8 * 0.02 * 1.01
    assert np.abs(np.diff(rows, 2, axis=0)).max() <= 20.0 * 0.02**2 * 1.01, "near the edge a joint leaps"
    tips = np.array([FOLLOWER.matrix(row)[:3, 3] for row in rows])
    assert np.linalg.norm(np.diff(tips, axis=0), axis=1).max() <= 0.2 * 0.02 + 1e-9, "the tip does not leap"


def test_a_leader_that_does_not_answer_is_waited_for() -> None:
    stage, lead = staged(), (0.5, 0.2, 0.1, 0.4, 0.0)
    held = led(stage, lead, 1.0, age_s=math.nan)
    assert np.ptp(held, axis=0).max() == 0.0
    led(stage, lead, 0.4)
    rows = led(stage, lead, 1.5, age_s=0.2)
    tips = np.array([FOLLOWER.matrix(row)[:3, 3] for row in rows])
    assert 0.0 < np.linalg.norm(tips[-1] - tips[0]) < 0.2**2 / (2 * 0.5) * 1.05
    assert np.ptp(rows[30:], axis=0).max() < 1e-9
    assert stage.said == [
        f"no reply from leader leader_pan {since}, holding" for since in ("yet", "for 0.20 s")
    ]
    assert LEADER.matrix(lead)[:3, 3] == pytest.approx(
        FOLLOWER.matrix(led(stage, lead, 4.0)[-1])[:3, 3], abs=1e-3
    )


def test_a_relative_follower_goes_on_from_where_it_is_when_the_leader_answers_again() -> None:
    stage, lead, away = staged(relative=True), (0.2, 0.2, 0.1, 0.4, 0.0), (0.4, 0.3, 0.1, 0.2, 0.0)
    begin = led(stage, lead, 0.4)[-1]
    led(stage, lead, 0.5, age_s=0.2)
    assert led(stage, away, 1.0) == pytest.approx(np.tile(begin, (50, 1)), abs=1e-6)
    moved = FOLLOWER.matrix(led(stage, lead, 3.0)[-1])[:3, 3] - FOLLOWER.matrix(begin)[:3, 3]
    assert moved == pytest.approx((LEADER.matrix(lead) - LEADER.matrix(away))[:3, 3], abs=1e-3)


def test_what_leads_takes_no_poses_and_does_not_follow() -> None:
    with pytest.raises(ValueError, match="so a pose is not accepted; send it to a cartesian_cont"):
        staged().prepare("pose", dz=0.01)
    with pytest.raises(ValidationError, match="leader_pan is leader and follower"):
        CartesianController.Parameters.model_validate(
            {"joints": ["leader_pan"], "tip": "a", "leader": {"joints": ["leader_pan"], "tip": "b"}}
        )
