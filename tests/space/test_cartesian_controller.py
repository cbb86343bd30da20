"""cartesian_controller on a stage: poses, frames, twists, cancels, lost joints, and what is refused."""

import math
import random
import re
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace
from tests.kit.campaigns import campaign
from tests.kit.judged_arms import apart, arms
from tests.kit.stages import Stage

from dxlrun import ROTARY, RobotModel
from dxlrun.channels.cycle import Torque
from dxlrun_space.cartesian_controller import CartesianController
from dxlrun_space.reach import dexterity

all_arms = cache(arms)
ARM = ("joint1", "joint2", "joint3", "joint4")
READY = (0.2, -0.6, 0.6, 0.5)
SPEED = 4.0


def staged(name: str = "open_manipulator_x", present: Any = READY, **keys: Any) -> Stage:
    """Return an active controller of an arm, and the other joints at 0."""
    arm = all_arms()[name]
    limits = {"lower": arm.lower, "upper": arm.upper, "velocity": SPEED, "acceleration": 20.0}
    parameters = {"joints": list(arm.joints), "tip": arm.tip, "base": arm.base, **keys}
    stage = Stage(CartesianController, parameters, present, limits, urdf=arm.urdf, others=("gripper",))
    stage.context.reads[:] = 0.0
    return stage.activate()


def played(stage: Stage, seconds: float) -> Any:
    """Update for a time with servos that follow; return the commands, one row a cycle."""
    rows = []
    for _ in range(round(seconds / 0.02)):
        rows.append(stage.update(stage.time_ns * 1e-9 + 0.02))
    return np.array(rows)


def assert_smooth(rows: Any) -> None:
    assert np.abs(np.diff(rows, axis=0)).max() <= SPEED * 0.02 * 1.05
    assert np.abs(np.diff(rows, 2, axis=0)).max() <= 20.0 * 0.02**2 * 1.05


def tip(stage: Stage, name: str = "open_manipulator_x") -> Any:
    return all_arms()[name].matrix(stage.commands.position)


def test_a_pose_is_planned_at_rest_then_played_and_judged() -> None:
    stage, begin = staged(), all_arms()["open_manipulator_x"].matrix(READY)
    stage.send(0.0, "pose", dz="5 cm")
    rows = played(stage, 3.0)
    assert_smooth(rows)
    assert rows[0] == pytest.approx(READY)
    assert [outcome for outcome, *_ in stage.goal.ended] == ["reached"]
    assert tip(stage)[:3, 3] == pytest.approx(begin[:3, 3] + [0, 0, 0.05], abs=1e-4)


@pytest.mark.parametrize(
    ("pose", "expected"),
    [
        ({"x": 0.2, "y": 0.03, "z": 0.12}, [0.2, 0.03, 0.12]),
        ({"z": "12 cm"}, [None, None, 0.12]),
        ({"x": 0.18, "dy": -0.02}, [0.18, -0.02, None]),
    ],
)
def test_coordinates_that_are_not_given_are_kept(pose: dict[str, Any], expected: list[Any]) -> None:
    stage, begin = staged(), all_arms()["open_manipulator_x"].matrix(READY)[:3, 3]
    stage.send(0.0, "pose", **pose)
    played(stage, 5.0)
    wanted = [now if goal is None else goal for goal, now in zip(expected, begin, strict=True)]
    if "dy" in pose:
        wanted[1] = begin[1] - 0.02
    assert stage.goal.ended[0][0] == "reached", stage.goal.ended
    assert tip(stage)[:3, 3] == pytest.approx(wanted, abs=1e-4)


def test_distances_are_along_the_axes_of_a_frame_at_the_start() -> None:
    for frame in ("end_effector_link", "link3", "left_finger"):
        stage, begin = staged(), all_arms()["open_manipulator_x"].matrix(READY)
        axes = (
            begin if frame != "link3" else all_arms()["open_manipulator_x"].matrix((READY[0], READY[1], 0, 0))
        )
        stage.send(0.0, "pose", dx=-0.03, frame=frame)
        played(stage, 4.0)
        assert stage.goal.ended[0][0] == "reached", (frame, stage.goal.ended)
        assert tip(stage)[:3, 3] == pytest.approx(begin[:3, 3] - 0.03 * axes[:3, 0], abs=1e-4), frame


def test_an_arm_of_six_joints_turns_its_tip_as_asked() -> None:
    present = (0.2, -0.4, 0.8, 0.3, 0.6, -0.2)
    arm = all_arms()["six"]
    for pose in ({"drpy": "0, 0, 20 deg"}, {"rpy": [0.1, 0.9, 0.3]}, {"quaternion": [0.0, 0.6, 0.0, 0.8]}):
        stage = staged("six", present)
        stage.send(0.0, "pose", **pose)
        assert_smooth(played(stage, 4.0))
        assert stage.goal.ended[0][0] == "reached", (pose, stage.goal.ended)
        found, begin = tip(stage, "six"), arm.matrix(present)
        assert found[:3, 3] == pytest.approx(begin[:3, 3], abs=1e-4)
        if "quaternion" in pose:
            assert found[:3, 0] == pytest.approx([1 - 2 * 0.36, 0.0, -2 * 0.6 * 0.8], abs=1e-3)
        elif "drpy" in pose:
            assert apart(found, begin)[1] == pytest.approx(math.radians(20), abs=1e-3)


def test_an_orientation_that_the_arm_lacks_is_reported() -> None:
    stage = staged()
    stage.send(0.0, "pose", dz=0.02, rpy=(0.0, 0.3, 1.5))
    played(stage, 5.0)
    ((outcome, text, *_),) = stage.goal.ended
    assert outcome == "reached"
    assert "deg from the orientation, which the arm cannot reach" in text
    exact = staged(orientation="exact")
    exact.send(0.0, "pose", dz=0.02, rpy=(0.0, 0.3, 1.5))
    rows = played(exact, 9.0)
    assert exact.goal.ended[0][:2][0] == "aborted"
    assert rows == pytest.approx(np.tile(READY, (len(rows), 1)))


@pytest.mark.parametrize(("name", "keys"), [("six", {}), ("seven", {"posture": {"j0": "30 deg"}})])
def test_a_named_pose_is_reached_by_its_own_joints(name: str, keys: dict[str, Any]) -> None:
    arm, chance = all_arms()[name], random.Random(3)
    for _ in range(5):
        stage, positions = staged(name, arm.drawn(chance), **keys), arm.drawn(chance)
        named = dict(zip(arm.joints, positions, strict=True))
        stage.send(0.0, "pose", pose={**named, "gripper": 0.0})
        assert played(stage, 9.0)[-1] == pytest.approx(positions, abs=1e-9)
        assert stage.goal.ended[0][0] == "reached"
    stage.send(None, "pose", pose={**named, arm.joints[1]: 99.0})
    assert played(stage, 1.0)[-1] == pytest.approx(positions, abs=1e-9)
    assert stage.goal.ended[0][:2] == ("aborted", f"the pose has {arm.joints[1]} outside its limits")
    with pytest.raises(ValueError, match="the pose has no position of "):
        stage.prepare("pose", pose={arm.joints[2]: 0.1})
    with pytest.raises(
        ValueError, match="the pose is far off; name another pose, or write `orientation: near"
    ):
        staged(name, orientation="exact").prepare("pose", pose={"positions": named, "remark": "far off"})


def test_a_duration_is_kept() -> None:
    stage = staged()
    stage.send(0.0, "pose", dz=0.05, seconds=3.0)
    rows = played(stage, 5.0)
    moving = np.flatnonzero(np.abs(np.diff(rows, axis=0)).max(axis=1) > 0)
    assert (moving[-1] - moving[0]) * 0.02 == pytest.approx(3.0, abs=0.05)


def test_a_plan_is_published_and_moves_nothing() -> None:
    stage, arm = staged(), all_arms()["open_manipulator_x"]
    for pose, text in (
        ({"dz": 0.05}, ""),
        ({"x": 0.9}, "the pose is out of reach"),
        ({"dx": 0, "frame": "no"}, "frame no"),
    ):
        stage.give("plan", **pose)
        rows = played(stage, 9.0)
        assert rows == pytest.approx(np.tile(READY, (len(rows), 1)))
        _, plan = stage.messages[-1]
        assert plan.text.startswith(text)
        assert np.isnan(plan.positions).all() == math.isnan(plan.duration) == bool(text)
    assert len(stage.messages) == 3
    _, plan = stage.messages[0]
    assert arm.matrix(plan.positions)[:3, 3] == pytest.approx([plan.x, plan.y, plan.z], abs=1e-4)
    assert plan.z == pytest.approx(arm.matrix(READY)[2, 3] + 0.05)
    stage.send(None, "pose", dz=0.05)
    played(stage, 0.6)
    stage.give("plan", dz=-0.05)
    assert stage.messages[-1][1].text == "the arm moves; ask again when it rests"
    played(stage, 3.0)
    assert stage.goal.ended[0][0] == "reached"
    count = len(stage.messages)
    for _ in range(2):
        stage.give("plan", rpy=(0, 0, 1.5), path="joints")  # sought in many cycles
        played(stage, 0.02)
    stage.give("twist")  # of 0
    played(stage, 9.0)
    stage.give("plan", rpy=(0, 0, 1.5), path="joints")
    stage.send(None, "pose", dz=-0.05)
    texts = [plan.text for _, plan in stage.messages[count:]]
    assert texts[::2] == ["replaced by a newer request", "the arm moves; ask again when it rests"]
    assert texts[1].endswith("deg from the orientation, which the arm cannot reach")


def test_each_plan_is_answered_with_its_own_coordinates() -> None:
    """Also in the cycle in which it arrived, while the arm moves, and if its controller is reactivated."""
    stage = staged()
    stage.give("plan", x=0.15, y=0.0, z=0.2)
    stage.give("plan", x=0.16, y=0.0, z=0.2)
    stage.give("plan", x=0.2, frame="no")
    played(stage, 1.0)
    stage.give("plan", x=0.17, y=0.0, z=0.2)
    stage.activate()
    stage.give("plan", x=0.18, y=0.0, z=0.2)
    stage.controller.on_deactivate(stage.time_ns)
    stage.activate().send(None, "pose", dz=0.05)
    stage.give("plan", x=0.19, y=0.0, z=0.2)
    played(stage, 3.0)
    assert [f"{plan.x:g} {plan.text:.20}" for _, plan in stage.messages] == [
        "0.15 replaced by a newer ",
        "0.16 replaced by a newer ",
        "nan frame no not found; ",
        "0.17 the controller was a",
        "0.18 the controller was d",
        "0.19 the arm moves; ask a",
    ]


def test_a_cancel_brakes_on_the_line() -> None:
    stage, begin = staged(), all_arms()["open_manipulator_x"].matrix(READY)
    stage.send(0.0, "pose", x=0.9)
    stage.cancel()  # while it is planned
    assert stage.goal.ended[0][0] == "cancelled"
    stage.send(None, "pose", dz=0.1)
    first = played(stage, 0.6)
    stage.cancel()
    rows = np.vstack([first, played(stage, 1.0)])
    assert_smooth(rows)
    assert stage.goal.ended[0][0] == "cancelled"
    off = tip(stage)[:3, 3] - begin[:3, 3]
    assert off[:2] == pytest.approx([0, 0], abs=1e-4)
    assert 0.01 < off[2] < 0.09


def test_a_new_goal_brakes_first_and_hostile_ones_do_no_harm() -> None:
    stage, chance = staged(), random.Random(5)
    stage.send(0.0, "pose", dz=0.1)
    rows = [*played(stage, 0.6)]
    for _ in range(100):
        stage.send(None, "pose", **{name: chance.uniform(-0.5, 0.5) for name in ("dx", "y", "dz")})
        rows += [*played(stage, 0.02)]
    stage.send(None, "pose", dz=-0.02)
    rows += [*played(stage, 4.0)]
    assert_smooth(np.array(rows))
    assert stage.goal.ended[0][0] == "reached"
    assert {goal.ended[0][0] for goal in stage.goals[:-1]} <= {"preempted", "aborted"}


@pytest.mark.parametrize(
    ("sent", "progress", "text"),
    [
        ((), 0.0, ""),
        ((0.02,), 0.0, "; held 100 mm before the pose"),
        ((0.6,), 0.505, "; held 49 mm before the pose"),
        ((0.6, 0.0), 0.0, ""),
    ],
)
def test_a_lost_joint_aborts_the_goal_with_the_distance(
    sent: tuple[float, ...], progress: float, text: str
) -> None:
    """Also before the motion, where an end would be a refusal, and while the tip brakes for the goal."""
    stage = staged()
    for seconds in sent or (0.0,):
        stage.send(None, "pose", dz=0.1)
        played(stage, seconds)
    moves = sum(sent) > 0.5
    stage.sent.position[:] -= 1e-4 * moves  # a limit of the runtime held them back
    held = stage.sent.position.copy() if moves else READY
    stage.states.torque[1] = Torque.LOST
    rows = played(stage, 0.2)
    assert rows == pytest.approx(np.tile(held, (len(rows), 1)))
    assert (stage.goal.ended[0][0], stage.goal.refusal) == ("aborted", None)
    assert stage.goal.progress == pytest.approx(progress, abs=1e-3)
    assert stage.goal.ended[0][1] == f"joint joint2 does not answer{text}"


def test_a_joint_that_has_not_answered_aborts_goals() -> None:
    stage = staged()
    stage.states.position[2] = stage.sent.position[2] = math.nan
    stage.activate()
    stage.send(0.0, "pose", dz=0.1)
    played(stage, 0.02)
    assert stage.goal.ended[0][:2] == ("aborted", "joint joint3 has not answered yet")
    assert stage.goal.refusal is None
    stage.states.position[2] = READY[2]  # but no update yet
    stage.send(None, "pose", dz=0.02)
    played(stage, 3.0)
    assert stage.goal.ended[0][0] == "reached"
    stage.states.position[:] = READY
    stage.states.position[2] = stage.sent.position[2] = math.nan
    stage.activate()
    stage.give("twist", vz=0.1, frame="link5")  # has no effect


def test_only_frames_that_a_silent_joint_moves_are_refused() -> None:
    for age, since in ((math.nan, "yet"), (0.21, "for 0.21 s")):
        stage, text = staged(), f"no reply from gripper {since}, which moves frame left_finger"
        stage.context.reads[1] = age
        stage.send(0.0, "pose", dz=0.01, frame="left_finger")
        assert played(stage, 0.2) == pytest.approx(np.tile(READY, (10, 1)))
        assert (*stage.goal.ended[0][:2], stage.goal.refusal) == ("aborted", text, None)
        streamed(stage, 0.5, vz=0.05)
        rows = streamed(stage, 1.0, vz=0.05, frame="left_finger")
        assert stage.warned == [f"twist ignored: {text}"]
        assert np.abs(rows[-1] - rows[-2]).max() == 0.0
        stage.send(None, "pose", dz=0.01, frame="link3")
        stage.context.reads[1] = 0.19
        played(stage, 2.0)
        stage.send(None, "pose", dz=-0.01, frame="left_finger")
        played(stage, 2.0)
        assert [goal.ended[0][0] for goal in stage.goals] == ["aborted", "reached", "reached"]


def test_frames_that_a_joint_without_a_servo_moves_are_refused() -> None:
    model = RobotModel(ARM, (None,) * 4, (None,) * 4, (ROTARY,) * 4, all_arms()["open_manipulator_x"].urdf)
    given = CartesianController.Parameters.model_validate({"joints": ARM, "tip": "end_effector_link"})
    for kind in ("pose", "twist", "plan"):

        def check(frame: str, robot: RobotModel, kind: str = kind) -> None:
            command = {"frame": frame} | ({} if kind == "twist" else {"dz": 0.1})
            sent = CartesianController.Commands[kind].model_validate(command)
            CartesianController.check_command(kind, sent, given, robot)

        with pytest.raises(ValueError, match="frame left_finger moves with joint gripper, which is omitted"):
            check("left_finger", model)
        with pytest.raises(ValueError, match="frame link33 not found; known: end_eff"):
            check("link33", model)
        check("link3", model)
        check("left_finger", replace(model, others=("gripper",)))


def streamed(stage: Stage, seconds: float, **twist: Any) -> Any:
    rows = []
    for _ in range(round(seconds / 0.02)):
        stage.give("twist", **twist)
        rows += [*played(stage, 0.02)]
    return np.array(rows)


def test_a_twist_moves_the_tip_and_ends_with_its_timeout() -> None:
    stage, begin = staged(), all_arms()["open_manipulator_x"].matrix(READY)
    rows = streamed(stage, 1.0, vz=0.05)
    at = tip(stage)[:3, 3] - begin[:3, 3]
    assert at == pytest.approx([0, 0, 0.0475], abs=2e-3)
    rows = np.vstack([rows, played(stage, 1.0)])
    assert_smooth(rows)
    assert np.abs(rows[-1] - rows[-10]).max() == 0.0
    off = tip(stage)[:3, 3] - begin[:3, 3]
    assert off[2] < 0.0475 + 0.05 * 0.2 + 0.005


def test_a_twist_in_the_axes_of_the_tip_turns_with_it() -> None:
    stage = staged("six", (0.2, -0.4, 0.8, 0.3, 0.6, -0.2))
    begin = tip(stage, "six") if not np.isnan(stage.commands.position).any() else None
    rows = streamed(stage, 1.0, wx=0.5, frame="tip")
    assert_smooth(rows)
    found = tip(stage, "six")
    assert begin is not None
    assert found[:3, 3] == pytest.approx(begin[:3, 3], abs=2e-3)
    assert found[:3, 0] == pytest.approx(begin[:3, 0], abs=0.02)
    assert apart(found, begin)[1] == pytest.approx(0.48, abs=0.05)


@pytest.mark.parametrize("name", ["open_manipulator_x", "six"])
def test_twists_into_singularities_and_limits_are_held(name: str) -> None:
    """Out to the stretched arm, and on: within all limits, at rest there, and back again."""
    present = READY if name == "open_manipulator_x" else (0.2, -0.4, 0.8, 0.3, 0.6, -0.2)
    arm, stage = all_arms()[name], staged(name, present)
    rows = np.vstack(
        [streamed(stage, 4.0, vx=0.2), streamed(stage, 2.0, vx=-0.2), streamed(stage, 4.0, vz=-0.2)]
    )
    assert_smooth(rows)
    assert all(arm.within(row) for row in rows)
    assert np.abs(np.diff(rows[180:200], axis=0)).max() < 2e-3, "stretched out, it rests"


@pytest.mark.parametrize("name", ["open_manipulator_x", "koch", "six", "op3", "sliding"])
@campaign(ci=2, night=20, release=200)
def test_all_limits_hold_for_twists_beside_singularities(
    name: str, number: int, chance: random.Random
) -> None:
    """An elbow or a shoulder is stretched, or the axes of a wrist are in line."""
    arm, twist, rows = all_arms()[name], {}, []
    draws = [arm.drawn(chance, 0.8) for _ in range(50)]
    start = [*draws[dexterity(arm.chain, draws)[1].argmin()]]
    if number % 2:
        start[-2] = chance.uniform(-0.1, 0.1)
    stage = staged(name, start)
    for cycle in range(300):
        if cycle % 50 == 0 or chance.random() < 0.02:
            names = ("vx", "vy", "vz", "wx", "wy", "wz")
            twist = {each: chance.uniform(-1, 1) * 10 ** chance.uniform(-2, 1) for each in names}
        rows += [*streamed(stage, 0.02, **twist)]
    assert_smooth(np.array(rows))
    assert all(arm.within(row) for row in rows)
    poses = [arm.matrix(row) for row in rows]
    ways, turns = np.array([apart(*pair) for pair in pairwise(poses)]).T / 0.02
    assert ways.max() <= 0.2 + 1e-9
    assert turns.max() <= 1.5 + 1e-6
    rates = np.linalg.norm(np.diff([pose[:3, 3] for pose in poses], 2, axis=0), axis=1) / 0.02**2
    assert np.quantile(rates, 0.95) <= 0.5 * 1.6, "limits of joints and of velocity come first"
    assert rates.max() <= 0.5 * 10


@pytest.mark.parametrize(
    ("joint", "end", "beyond"), [(0, "lower", 0.0), (2, "lower", 0.0), (3, "upper", 0.05)]
)
def test_a_joint_at_or_beyond_its_limit_does_not_hold_the_others(joint: int, end: str, beyond: float) -> None:
    arm, present = all_arms()["open_manipulator_x"], [*READY]
    present[joint] = getattr(arm, end)[joint] + beyond
    rows = streamed(staged(present=present), 1.0, vz=0.05)
    assert_smooth([present, *rows])
    assert arm.lower[joint] - 1e-3 <= rows[-1][joint] <= arm.upper[joint] + 1e-3
    way = arm.matrix(rows[-1])[:3, 3] - arm.matrix(present)[:3, 3]
    assert way[2] > 0.02
    assert np.abs(way[:2]).max() < 2e-3


def test_a_pose_follows_a_twist_and_a_twist_ends_a_pose() -> None:
    stage = staged()
    rows = [*streamed(stage, 0.5, vz=0.1)]
    stage.send(None, "pose", dz=-0.02)
    rows += [*played(stage, 0.5)]
    rows += [*streamed(stage, 0.5, vx=0.05)]
    assert stage.goal.ended[0][:2] == ("preempted", "replaced by a twist")
    rows += [*played(stage, 1.0)]
    stage.send(None, "pose", dz=0.05)
    rows += [*played(stage, 0.4)]
    stage.cancel()
    stage.give("twist", vx=-0.05)
    rows += [*played(stage, 1.0)]
    assert tip(stage)[0, 3] < all_arms()["open_manipulator_x"].matrix(rows[-51])[0, 3] - 5e-4
    assert_smooth(np.array(rows))


def test_the_joint_that_holds_a_twist_is_reported_once() -> None:
    stage = staged(present=(0.2, -0.6, 0.6, 2.03))
    streamed(stage, 2.0, wy=1.0)
    assert len([text for text in stage.said if text.startswith("held: joint ")]) <= 2
    assert stage.said[0].startswith("held: joint joint")


def test_no_module_of_linear_algebra_is_needed() -> None:
    """A replay elsewhere is exact because no library that depends on the processor decides."""
    for name in ("chain", "solver", "path", "stream"):
        text = Path(__file__).parents[2].joinpath("plugins", "dxlrun_space", f"{name}.py").read_text()
        assert not re.search(r"linalg|matmul|einsum|\bdot\b|\.sum\(", text), name
        assert name == "chain" or " @ " not in text, name  # there it is of transforms, in plain Python
