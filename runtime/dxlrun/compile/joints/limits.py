"""Limits: checks of positions, speeds and efforts in motions and commands against the limits of joints."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

import msgspec

from dxlrun.compile.problems import Problems
from dxlrun.contract.controller import CommandModel, SpeedPeak
from dxlrun.errors import Mark
from dxlrun.plan.loop_plan import JointPlan, LimitedInterface
from dxlwire.joint_unit import ROTARY, JointUnit

if TYPE_CHECKING:
    from dxlrun.compile.motion_samples import (
        MotionSample,
    )  # not at run time: only motions need the parser of formulas

_TOLERANCE = 1e-6  # rad; far below a tick (5e-3 rad on an AX-12), far above the rounding of degrees


_ROUNDING = 1e-9  # relative rounding error of speeds from differences of positions and times
_MOST_LONGER = 1000  # largest suggested extension of the time; beyond it a number is wrong
PEAK_OVER_MEAN = 15 / 8
"""Ratio of highest to mean speed of a quintic from rest to rest; for a cubic it is lower."""


class Interval(msgspec.Struct, frozen=True):
    """Closed range of positions, rad, or m for a linear joint."""

    lower: float
    upper: float
    unit: JointUnit = ROTARY

    def contains(self, other: Interval) -> bool:
        """Return True if `other` is inside this range, allowing for rounding."""
        return other.lower >= self.lower - _TOLERANCE and other.upper <= self.upper + _TOLERANCE

    def meet(self, other: Interval) -> Interval | None:
        """Return the overlap of two ranges; None if they do not overlap by more than a point."""
        lower, upper = max(self.lower, other.lower), min(self.upper, other.upper)
        return Interval(lower, upper, self.unit) if lower < upper else None

    def scaled(self, ratio: float, unit: JointUnit) -> Interval:
        """Return the range multiplied by a ratio, in another unit, as at the other side of a gear."""
        lower, upper = sorted((self.lower * ratio, self.upper * ratio))
        return Interval(lower, upper, unit)

    def plus(self, other: Interval) -> Interval:
        """Return the range of all sums of one position from each of two ranges."""
        return Interval(self.lower + other.lower, self.upper + other.upper, self.unit)

    def __str__(self) -> str:
        lower, upper = (self.unit.number(end, signed=True) for end in (self.lower, self.upper))
        return f"{lower}..{upper} {self.unit.shown}"


def limits_of(joint: JointPlan) -> Interval:
    """Return the range of positions to which the gate limits a joint's goals."""
    return Interval(joint.lower, joint.upper, joint.unit)


def degrees(angle: float) -> str:
    """Format an angle in rad as degrees, with at most two decimals."""
    return ROTARY.number(angle)


def check_samples(
    samples: Sequence[MotionSample],
    start_ns: int,
    joints: Mapping[str, JointPlan],
    problems: Problems,
    peaks: Iterable[SpeedPeak] = (),
) -> None:
    """Check the positions and speeds of a motion against the joints' limits; report each joint's worst only.

    Positions beyond the limits and speeds beyond the file's limit are warnings. Speeds above the servo's top
    speed are errors. The speeds are those of the targets and the `peaks` between them.
    """
    farthest, fastest = _worst(samples, joints, peaks)
    for joint, (_, sample, position) in farthest.items():
        where = joints[joint].unit.text(position, trim=True)
        problems.warning(
            sample.targets[joint].mark,
            f"{joint} is sent to {where} at {(start_ns + sample.t_ns) * 1e-9:.3f} s, outside its limits "
            f"{limits_of(joints[joint])}",
            "the gate holds the joint at the limit; change the motion or the limits",
        )
    for joint, (speed, t_ns, mark, stated) in fastest.items():
        where = f" at {(start_ns + t_ns) * 1e-9:.3f} s"
        report_speed(joints[joint], speed, where, mark, problems, stated=stated)


def report_speed(
    joint: JointPlan, speed: float, where: str, mark: Mark, problems: Problems, *, stated: bool = False
) -> None:
    """Add a problem if a file asks a joint for too much speed: an error above the servo's top speed.

    Above the joint's limit alone it is a warning: the gate limits the speed, so the joint is late.
    """
    excess = excess_speed(joint, speed, where, stated=stated)
    if excess is None:
        return
    if excess.beyond_servo:
        problems.error(mark, excess.text, excess.fix if stated else f"{excess.fix}, or shorten the way")
    else:
        fix = f"the gate limits the speed, so the joint is late; {excess.fix}, or raise the limit"
        problems.warning(mark, excess.text, fix)


class ExcessSpeed(msgspec.Struct, frozen=True):
    """Explanation that a requested speed is above the highest speed of a joint, with the fix."""

    text: str
    fix: str
    beyond_servo: bool
    """True if the speed is above the servo's own top speed, not only above the file's limit."""


def excess_speed(joint: JointPlan, speed: float, where: str, *, stated: bool = False) -> ExcessSpeed | None:
    """Compare a speed, rad/s or m/s, with a joint's highest; None if the joint can reach it.

    All speeds in files and in clients' requests are compared here. More time does not lower a `stated` speed,
    which is a number in a file.
    """
    most, top = joint.highest_speed, joint.top_speed
    if abs(speed) <= most * (1 + _ROUNDING):
        return None
    beyond_servo = top is not None and abs(speed) > top * (1 + _ROUNDING)
    register = _register_limit(joint, "velocity")
    own = beyond_servo or most != joint.velocity
    limit = register or ("the top speed of its servo" if own else "its velocity limit")
    shown = top if beyond_servo and top is not None and not register else most
    unit = joint.unit.speed
    text = f"{joint.name} is commanded to {speed:.4g} {unit}{where}, more than {shown:.4g} {unit}, {limit}"
    if stated:
        allowed = math.floor(most * 1000 + 1e-6) / 1000  # Rounded to the nearest it could be refused again
        return ExcessSpeed(text, f"lower the velocity to at most {allowed:g} {unit}", beyond_servo)
    fix = "allow more time"
    if 0 < abs(speed) < _MOST_LONGER * most:
        fix += f", {math.ceil(100 * abs(speed) / most - 1e-6) / 100:g} times as long"
    return ExcessSpeed(text, fix, beyond_servo)


def _worst(
    samples: Sequence[MotionSample], joints: Mapping[str, JointPlan], peaks: Iterable[SpeedPeak]
) -> tuple[dict[str, tuple[float, MotionSample, float]], dict[str, tuple[float, int, Mark, bool]]]:
    """Return by joint the target farthest outside the limits, and the highest speed with its time.

    The last value of a speed is True if the file states it.
    """
    farthest: dict[str, tuple[float, MotionSample, float]] = {}
    fastest: dict[str, tuple[float, int, Mark, bool]] = {}

    def note_speed(joint: str, speed: float, t_ns: int, mark: Mark, *, stated: bool) -> None:
        if abs(speed) > fastest.get(joint, (0.0, 0, mark, stated))[0]:
            fastest[joint] = abs(speed), t_ns, mark, stated

    for sample in samples:
        for joint, target in sample.targets.items():
            if joint not in joints:
                continue
            if target.velocity is not None:
                note_speed(joint, target.velocity, sample.t_ns, target.mark, stated=True)
            if target.position is None:
                continue
            excess = max(joints[joint].lower - target.position, target.position - joints[joint].upper)
            if excess > farthest.get(joint, (_TOLERANCE, sample, 0.0))[0]:
                farthest[joint] = (excess, sample, target.position)
    times = [sample.t_ns for sample in samples]
    for peak in peaks:
        t_ns = round(peak.time * 1e9)
        # Report a peak at the target toward which the joint moves.
        aimed = samples[min(bisect_left(times, t_ns), len(times) - 1)].targets.get(peak.joint)
        if peak.joint in joints and aimed is not None:
            note_speed(peak.joint, peak.speed, t_ns, aimed.mark, stated=False)
    return farthest, fastest


class LimitViolation(msgspec.Struct, frozen=True):
    """Message for one value of a command that is beyond a limit of its joint."""

    joint: str
    text: str


def beyond_limits(
    joints: Sequence[JointPlan], command: CommandModel, peaks: Iterable[SpeedPeak] = ()
) -> list[LimitViolation]:
    """Return a message for each position, speed, effort or PWM of a command beyond its joint's limits.

    Positions (rad) are compared with the position limits. Velocities (rad/s), the `peaks` and efforts are
    compared with the lower one of the file's limit and the servo's own. In a command that names its `joints`,
    the values belong to these. A field without one number per joint is left to the controller's `prepare`.

    Args:
        joints: Joints of the controller, in its order.
        command: The command.
        peaks: Highest speeds between its points.
    """
    values = command.model_dump()
    known = {joint.name: joint for joint in joints}
    named = values.get("joints")
    if isinstance(named, list | tuple):
        joints = [known[name] for name in named if name in known]
    points = values.get("points")
    if isinstance(points, Sequence) and all(isinstance(point, Mapping) for point in points):
        found = [
            beyond
            for number, point in enumerate(points, 1)
            for beyond in _beyond(joints, point, f" in point {number}")
        ]
    else:
        found = list(_beyond(joints, values, ""))
    for peak in peaks:
        joint = known.get(peak.joint)
        where = f" at {peak.time:.3f} s, {peak.where}"
        if joint is not None and (excess := excess_speed(joint, peak.speed, where)) is not None:
            found.append(LimitViolation(joint.name, f"{excess.text}: {excess.fix}"))
    return found


def _beyond(
    joints: Sequence[JointPlan], values: Mapping[str, object], where: str
) -> Iterator[LimitViolation]:
    for joint, position in zip(joints, _row(joints, values, "positions"), strict=False):
        if not joint.lower - _TOLERANCE <= position <= joint.upper + _TOLERANCE:
            sent = joint.unit.exact_text(position)
            text = f"{joint.name} is sent to {sent}{where}, outside its limits {limits_of(joint)}"
            yield LimitViolation(joint.name, text)
    for joint, speed in zip(joints, _row(joints, values, "velocities"), strict=False):
        if (excess := excess_speed(joint, speed, where)) is not None:
            yield LimitViolation(joint.name, excess.text)
    for joint, effort in zip(joints, _row(joints, values, "efforts"), strict=False):
        if abs(effort) > joint.highest_effort:
            most, own = joint.highest_effort, joint.highest_effort != joint.effort
            limit = "the highest goal of its servo" if own else "its effort limit"
            limit = _register_limit(joint, "effort") or limit
            text = f"{joint.name} is commanded to {effort:.6g}{where}, more than {most:.6g}, {limit}"
            yield LimitViolation(joint.name, text)
    for joint, pwm in zip(joints, _row(joints, values, "pwm"), strict=False):
        if abs(pwm) > joint.highest_pwm:
            most, limit = joint.highest_pwm, _register_limit(joint, "pwm") or "the full voltage"
            text = f"{joint.name} is commanded to {pwm:.6g}{where}, more than {most:.6g}, {limit}"
            yield LimitViolation(joint.name, text)


def _register_limit(joint: JointPlan, interface: LimitedInterface) -> str:
    """Return the name of the servo register that limits a joint, for messages; empty if none does."""
    own = joint.find_servo_limit(interface)
    return "" if own is None else f"servo register {own.text}"


def _row(joints: Sequence[JointPlan], values: Mapping[str, object], name: str) -> Sequence[float]:
    """Return a field of a command as numbers, one per joint; empty if it does not have that form."""
    row = values.get(name)
    if not isinstance(row, list | tuple) or len(row) != len(joints):
        return ()
    return row if all(isinstance(value, int | float) for value in row) else ()
