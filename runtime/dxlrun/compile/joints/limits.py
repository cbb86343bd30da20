"""Limits of joints: intervals of positions, and what motions and commands ask of a joint beyond them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import msgspec

from dxlrun.compile.problems import Problems
from dxlrun.contract.controller import CommandModel
from dxlrun.errors import Mark
from dxlrun.plan.loop_plan import JointPlan, LimitedInterface

if TYPE_CHECKING:
    from dxlrun.compile.samples import Sample  # not at run time: formulas are parsed for motions alone

_TOLERANCE = 1e-6  # rad; far below a tick (5e-3 rad on an AX-12), far above the rounding of degrees


_ROUNDING = 1e-9  # Part of a speed that differences of positions and times may be off


class Interval(msgspec.Struct, frozen=True):
    """Closed interval of joint positions, rad, or m of a linear joint."""

    lower: float
    upper: float
    linear: bool = False

    def contains(self, other: Interval) -> bool:
        """Return whether `other` lies inside, but for rounding."""
        return other.lower >= self.lower - _TOLERANCE and other.upper <= self.upper + _TOLERANCE

    def meet(self, other: Interval) -> Interval | None:
        """Return what both have in common; None when that is not more than a point."""
        lower, upper = max(self.lower, other.lower), min(self.upper, other.upper)
        return Interval(lower, upper, self.linear) if lower < upper else None

    def scaled(self, ratio: float, *, linear: bool) -> Interval:
        """Return the interval of what moves by `ratio`, above 0, while this moves by 1."""
        return Interval(self.lower * ratio, self.upper * ratio, linear)

    def __str__(self) -> str:
        unit = "mm" if self.linear else "deg"
        return f"{number(self.lower, self.linear)}..{number(self.upper, self.linear)} {unit}"


def limits_of(joint: JointPlan) -> Interval:
    """Return where the gate lets a joint go."""
    return Interval(joint.lower, joint.upper, joint.linear)


def degrees(angle: float, *, signed: bool = False) -> str:
    """Write an angle of `angle` rad in degrees, with as many digits as it needs, at most two."""
    return _digits(math.degrees(angle), signed=signed)


def number(position: float, linear: bool) -> str:
    """Write a position in degrees, or mm of a linear joint, with its sign and at most two digits."""
    return _digits(position * 1e3 if linear else math.degrees(position), signed=True)


def position_text(position: float, linear: bool) -> str:
    """Write a position, rad or m, with its unit."""
    return f"{number(position, linear)} {'mm' if linear else 'deg'}"


def speed_unit(linear: bool) -> str:
    """Return the SI unit of a joint's speed."""
    return "m/s" if linear else "rad/s"


def _digits(value: float, *, signed: bool) -> str:
    value = round(value, 2) + 0.0  # + 0.0: no minus sign before zero
    text = f"{value:.2f}".rstrip("0").rstrip(".")
    return f"+{text}" if signed and value > 0 else text


def check_samples(
    samples: Sequence[Sample],
    start_ns: int,
    joints: Mapping[str, JointPlan],
    problems: Problems,
    *,
    interpolated: bool,
) -> None:
    """Check the targets of joints against their limits: once for each joint, with the worst of them.

    Warn of positions beyond the limits, and of speeds beyond the file's; refuse speeds above the top speed of
    a servo. The speeds are the targets', and with `interpolated`, where a controller moves from sample to
    sample, the mean speed between two samples, which every path through both reaches.
    """
    farthest, fastest = _worst(samples, joints, interpolated)
    for joint, (_, sample, position) in farthest.items():
        where = position_text(position, joints[joint].linear).removeprefix("+")
        problems.warning(
            sample.targets[joint].mark,
            f"{joint} is sent to {where} at {(start_ns + sample.t_ns) * 1e-9:.3f} s, outside its limits "
            f"{limits_of(joints[joint])}",
            "the gate will hold it at the limit; change the motion or the limits",
        )
    for joint, (speed, t_ns, mark) in fastest.items():
        plan = joints[joint]
        if speed <= plan.highest_speed * (1 + _ROUNDING):
            continue
        unit = speed_unit(plan.linear)
        asked = f"{joint} is asked for {speed:.4g} {unit} at {(start_ns + t_ns) * 1e-9:.3f} s"
        if plan.top_speed is not None and speed > plan.top_speed * (1 + _ROUNDING):
            problems.error(
                mark,
                f"{asked}, more than {plan.top_speed:.4g} {unit}, the top speed of its servo",
                "give it more time, or a shorter way",
            )
        else:
            problems.warning(
                mark,
                f"{asked}, more than {plan.highest_speed:.4g} {unit}, its velocity limit",
                "the gate will hold it at the limit, so it comes late; give it more time, or raise the limit",
            )


def _worst(
    samples: Sequence[Sample], joints: Mapping[str, JointPlan], interpolated: bool
) -> tuple[dict[str, tuple[float, Sample, float]], dict[str, tuple[float, int, Mark]]]:
    """Return by joint the position that is farthest beyond its limits, and the highest speed, with places."""
    farthest: dict[str, tuple[float, Sample, float]] = {}
    fastest: dict[str, tuple[float, int, Mark]] = {}

    def note(joint: str, speed: float, t_ns: int, mark: Mark) -> None:
        if abs(speed) > fastest.get(joint, (0.0, 0, mark))[0]:
            fastest[joint] = abs(speed), t_ns, mark

    before: dict[str, tuple[int, float]] = {}
    for sample in samples:
        for joint, target in sample.targets.items():
            if joint not in joints:
                continue
            if target.velocity is not None:
                note(joint, target.velocity, sample.t_ns, target.mark)
            if target.position is None:
                continue
            excess = max(joints[joint].lower - target.position, target.position - joints[joint].upper)
            if excess > farthest.get(joint, (_TOLERANCE, sample, 0.0))[0]:
                farthest[joint] = (excess, sample, target.position)
            t_ns, position = before.get(joint, (sample.t_ns, 0.0))
            if interpolated and sample.t_ns > t_ns:
                speed = (target.position - position) / ((sample.t_ns - t_ns) * 1e-9)
                note(joint, speed, sample.t_ns, target.mark)
            before[joint] = sample.t_ns, target.position
    return farthest, fastest


class BeyondLimit(NamedTuple):
    """A value of a command that its joint cannot follow."""

    joint: str
    text: str


def beyond_limits(joints: Sequence[JointPlan], command: CommandModel) -> list[BeyondLimit]:
    """Return each value of a command that its joint cannot follow.

    `joints`: those of the controller, in its order. Positions (rad) are compared with the position limits,
    velocities (rad/s) and efforts with the lower one of the file's limit and the servo's own; between two
    points of a trajectory the mean speed, which every path through both reaches. Of a command that names its
    `joints`, the values are theirs. A field that has not one number a joint is for the controller's `prepare`
    to judge.
    """
    values = command.model_dump()
    named = values.get("joints")
    if isinstance(named, list | tuple):
        known = {joint.name: joint for joint in joints}
        joints = [known[name] for name in named if name in known]
    points = values.get("points")
    if isinstance(points, Sequence) and all(isinstance(point, Mapping) for point in points):
        return list(_beyond_in_points(joints, points))
    return list(_beyond(joints, values, ""))


def _beyond(joints: Sequence[JointPlan], values: Mapping[str, object], where: str) -> Iterator[BeyondLimit]:
    for joint, position in zip(joints, _row(joints, values, "positions"), strict=False):
        if not joint.lower - _TOLERANCE <= position <= joint.upper + _TOLERANCE:
            written = f"{position * 1e3:.6g} mm" if joint.linear else f"{math.degrees(position):.6g} deg"
            text = f"{joint.name} is sent to {written}{where}, outside its limits {limits_of(joint)}"
            yield BeyondLimit(joint.name, text)
    for joint, speed in zip(joints, _row(joints, values, "velocities"), strict=False):
        yield from _too_fast(joint, speed, where)
    for joint, effort in zip(joints, _row(joints, values, "efforts"), strict=False):
        if abs(effort) > joint.highest_effort:
            most, own = joint.highest_effort, joint.highest_effort != joint.effort
            limit = "the highest goal of its servo" if own else "its effort limit"
            limit = _register_limit(joint, "effort") or limit
            text = f"{joint.name} is asked for {effort:.6g}{where}, more than {most:.6g}, {limit}"
            yield BeyondLimit(joint.name, text)
    for joint, pwm in zip(joints, _row(joints, values, "pwm"), strict=False):
        if abs(pwm) > joint.highest_pwm:
            most, limit = joint.highest_pwm, _register_limit(joint, "pwm") or "the full voltage"
            text = f"{joint.name} is asked for {pwm:.6g}{where}, more than {most:.6g}, {limit}"
            yield BeyondLimit(joint.name, text)


def _beyond_in_points(
    joints: Sequence[JointPlan], points: Sequence[Mapping[str, object]]
) -> Iterator[BeyondLimit]:
    before: tuple[float, Sequence[float]] | None = None
    for number, point in enumerate(points, 1):
        yield from _beyond(joints, point, f" in point {number}")
        time, positions = point.get("time"), _row(joints, point, "positions")
        if not isinstance(time, int | float) or not positions:
            before = None
            continue
        if before is not None and time > before[0]:
            where = f" from point {number - 1} to {number}"
            for joint, start, end in zip(joints, before[1], positions, strict=True):
                yield from _too_fast(joint, (end - start) / (time - before[0]), where)
        before = time, positions


def _too_fast(joint: JointPlan, speed: float, where: str) -> Iterator[BeyondLimit]:
    if abs(speed) > joint.highest_speed * (1 + _ROUNDING):
        own = joint.highest_speed != joint.velocity
        limit = "the top speed of its servo" if own else "its velocity limit"
        limit = _register_limit(joint, "velocity") or limit
        unit = speed_unit(joint.linear)
        yield BeyondLimit(
            joint.name,
            f"{joint.name} is asked for {speed:.6g} {unit}{where}, more than {joint.highest_speed:.6g} "
            f"{unit}, {limit}",
        )


def _register_limit(joint: JointPlan, interface: LimitedInterface) -> str:
    """Return the register of a joint's servo that is its limit, as sentences name it; empty: none is."""
    own = joint.find_servo_limit(interface)
    return "" if own is None else f"{own.text}, a register of its servo"


def _row(joints: Sequence[JointPlan], values: Mapping[str, object], name: str) -> Sequence[float]:
    """Return a field with one number a joint, else nothing."""
    row = values.get(name)
    if not isinstance(row, list | tuple) or len(row) != len(joints):
        return ()
    return row if all(isinstance(value, int | float) for value in row) else ()
