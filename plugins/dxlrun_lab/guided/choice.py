"""Choice of an experiment's joints, and of the range in which each may move, from the command line."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence

from msgspec.structs import replace

from dxlrun import LINEAR, InputError
from dxlrun.tooling.files import suggestion
from dxlrun.tooling.plans import JointPlan, Plan
from dxlrun.tooling.verbs import angle
from dxlrun_lab.guided.experiment import PLAYER, ExperimentJoint, Situation
from dxlrun_lab.guided.rig import TORQUED, JointNow, Rig, RunningController

DEFAULT_REACH = math.radians(30)
"""Default range to each side of the present position, rad, within the limits"""
LEAST_WIDTH = math.radians(2)
"""Narrowest range of an experiment, rad"""
OVERSHOOT = math.radians(5)
"""Allowed overshoot of a servo beyond the limits of its joint, rad"""
_FAR = 1e6
_SLACK = 1e-9


def parse_ranges(words: Sequence[str]) -> dict[str, tuple[float, float]]:
    """Parse options `--range` such as `JOINT=-30deg..30deg` to lower and upper end by joint, rad.

    Raises InputError with all mistakes.
    """
    ranges: dict[str, tuple[float, float]] = {}
    mistakes: list[str] = []
    for word in words:
        joint, sign, text = word.partition("=")
        low, dots, high = text.partition("..")
        if not (joint and sign and dots):
            mistakes.append(f"--range {word}: write JOINT=LOWEST..HIGHEST, such as elbow=-30deg..30deg")
            continue
        if joint in ranges:
            mistakes.append(f"--range {joint} is given twice; give it once")
            continue
        try:
            lower, upper = angle(low), angle(high)
        except ValueError as error:
            mistakes.append(f"--range {word}: {error}")
            continue
        ranges[joint] = (lower, upper)
        if upper - lower < LEAST_WIDTH:
            mistakes.append(
                f"--range {word}: set HIGHEST at least {math.degrees(LEAST_WIDTH):g} deg above LOWEST"
            )
    if mistakes:
        raise InputError("\n".join(mistakes))
    return ranges


def check_joints(
    names: Sequence[str], ranges: Mapping[str, tuple[float, float]], joints: Sequence[JointPlan]
) -> None:
    """Raise InputError with all mistakes in the joints and ranges of a command line.

    The check needs no run. `situation_of` makes the checks that depend on positions.
    """
    plans = {joint.name: joint for joint in joints}
    known = tuple(plans)
    mistakes = []
    if not names:
        mistakes.append(f"name the joints that may move: {', '.join(known)}")
    mistakes += [
        f"{name} is not one of the robot's joints; {suggestion(name, known)}"
        for name in dict.fromkeys((*names, *ranges))
        if name not in known
    ]
    mistakes += [f"joint {name} is named twice; name it once" for name, n in Counter(names).items() if n > 1]
    mistakes += [
        f"--range {name}: joint {name} is not in the experiment; name the joint, too"
        for name in ranges
        if name in plans and name not in names
    ]
    mistakes += [
        problem
        for name in dict.fromkeys(names)
        if name in plans and (problem := _range_problem(plans[name], ranges.get(name)))
    ]
    if mistakes:
        raise InputError("\n".join(mistakes))


def whole_situation(rig: Rig, names: Sequence[str]) -> Situation:
    """Return the situation of a motion for which the range of each joint is that of its position limits.

    A servo may overshoot a limit by up to OVERSHOOT. Raises InputError as situation_of.
    """
    ranges = {joint.name: _within_all(joint) for joint in rig.plan.loop.joints if joint.name in names}
    situation = situation_of(rig, names, ranges)
    joints = (
        replace(joint, lower=joint.lower - OVERSHOOT, upper=joint.upper + OVERSHOOT)
        for joint in situation.joints
    )
    return replace(situation, joints=tuple(joints))


def _within_all(plan: JointPlan) -> tuple[float, float]:
    """Return the position limits of a joint, rad; without limits, a range that it cannot leave."""
    lower, upper = _limits(plan)
    return max(lower, -_FAR), min(upper, _FAR)


def situation_of(rig: Rig, names: Sequence[str], ranges: Mapping[str, tuple[float, float]]) -> Situation:
    """Return the joints of an experiment with their ranges and present positions.

    Raises InputError with all reasons against it: unknown joints, active controllers, torque off, ranges.
    """
    plans = {joint.name: joint for joint in rig.plan.loop.joints}
    check_joints(names, ranges, rig.plan.loop.joints)
    servos = rig.plan.servos_by_joint
    controllers, now = rig.controllers(), rig.joints()
    mistakes = list(_taken(rig, names, controllers))
    joints = []
    for name in names:
        try:
            lower, upper, chosen = _range_of(plans[name], now[name], ranges.get(name))
        except ValueError as error:
            mistakes.append(str(error))
            continue
        mine = tuple(servo for _, servo in servos[name])
        joints.append(ExperimentJoint(name, lower, upper, chosen, now[name].position, plans[name], mine))
    if mistakes:
        raise InputError("\n".join(mistakes))
    return Situation(tuple(joints), rig.rate, rig.plan, rig.virtual)


def require_own_servos(plan: Plan, names: Sequence[str], command: str, *, gears: bool) -> None:
    """Raise InputError unless each named joint is rotary and has a single servo; `gears` allows a gear ratio.

    `command` is the name for the message.
    """
    alone = f"but `dxlrun {command}` measures one servo; describe it as a rotary joint of another robot file"
    mistakes = []
    for joint in plan.loop.joints:
        servos = plan.servos_by_joint[joint.name] if joint.name in names else ()
        if len(servos) > 1:
            mistakes.append(f"{joint.name} has {len(servos)} servos ({joint.servo}), {alone}")
        elif servos and joint.unit is LINEAR:
            mistakes.append(f"{joint.name} is linear, {alone}")
        elif servos and servos[0][1].ratio != 1.0 and not gears:
            mistakes.append(
                f"{joint.name} has a gear of {1 / servos[0][1].ratio:g} : 1, {alone} without gear_ratio"
            )
    if mistakes:
        raise InputError("\n".join(mistakes))


def _taken(rig: Rig, names: Sequence[str], controllers: Sequence[RunningController]) -> list[str]:
    """Return what prevents an experiment in the run: pause, another experiment, controllers of its joints.
    Each is a sentence with a fix."""
    robot = rig.plan.robot
    if rig.paused:
        return [f"{robot} is paused; resume it first: dxlrun resume --robot {robot}"]
    if other := [one.name for one in controllers if one.name.startswith(f"{PLAYER}_")]:
        return [
            f"another experiment uses {robot} ({other[0]} is loaded); wait for its end. "
            f"If it was killed, run `dxlrun switch --deactivate {other[0]}`, `dxlrun pause`, "
            f"`dxlrun unload {other[0]}`, `dxlrun resume`"
        ]
    if rig.own:
        return []
    return [
        f"joint {name} is commanded by {one.name}; free it first: "
        f"dxlrun switch --deactivate {one.name} --robot {robot}"
        for name in names
        for one in controllers
        if one.active and name in one.joints
    ]


def _limits(plan: JointPlan) -> tuple[float, float]:
    """Return the position limits of a joint, rad; infinite without limits."""
    return (plan.lower, plan.upper) if plan.bounded else (-math.inf, math.inf)


def _degrees(lower: float, upper: float) -> str:
    return f"{math.degrees(lower):.4g} to {math.degrees(upper):.4g} deg"


def range_text(plan: JointPlan, given: tuple[float, float] | None) -> str:
    """Describe the range of a joint before its position is known: `--range`, or the default."""
    if given is not None:
        return f"{_degrees(*given)} (--range)"
    reach = math.degrees(DEFAULT_REACH)
    return f"{reach:g} deg to each side of where it is, within its limits of {_degrees(*_limits(plan))}"


def _range_problem(plan: JointPlan, given: tuple[float, float] | None) -> str:
    """Return the problem with a joint's range (rad; None for the default), whatever its position, or ''."""
    lower, upper = _limits(plan)
    if given is None:
        if math.isfinite(lower) and math.isfinite(upper) and not plan.continuous:
            return ""
        return f"joint {plan.name} has no position limits; give --range, such as {plan.name}=-30deg..30deg"
    if given[0] >= lower - _SLACK and given[1] <= upper + _SLACK:
        return ""
    shown = f"{math.degrees(given[0]):.4g}..{math.degrees(given[1]):.4g} deg"
    return (
        f"--range {plan.name}={shown} is beyond the joint's limits of {_degrees(lower, upper)}; stay inside"
    )


def _range_of(plan: JointPlan, now: JointNow, given: tuple[float, float] | None) -> tuple[float, float, str]:
    """Return lower and upper end of a joint's range, rad, and a description of its origin. Raises ValueError
    if the joint has no torque, or is outside of the range or its limits."""
    name, position = plan.name, now.position
    if now.torque not in TORQUED:
        raise ValueError(
            f"joint {plan.label} is {now.torque}; enable its torque first: dxlrun torque on {name}"
        )
    if math.isnan(position):
        raise ValueError(f"joint {plan.label} has not answered yet")
    at, (lower, upper) = f"joint {name} is at {math.degrees(position):.4g} deg, outside of", _limits(plan)
    if given is not None and given[0] <= position <= given[1]:
        return *given, "--range"
    if given is not None and given != _within_all(plan):
        raise ValueError(f"{at} its --range; move the joint inside first")
    low, high = max(lower, position - DEFAULT_REACH), min(upper, position + DEFAULT_REACH)
    if given is not None or high - low < LEAST_WIDTH or not low <= position <= high:
        raise ValueError(f"{at} its limits of {_degrees(lower, upper)}; move the joint inside first")
    return low, high, range_text(plan, None)
