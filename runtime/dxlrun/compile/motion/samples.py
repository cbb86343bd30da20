"""Samples: the points of one part of a motion, whether a person listed them or a formula gives them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from dxlrun.compile.checks.problems import Problems
from dxlrun.compile.joint.reach import Interval, degrees
from dxlrun.compile.motion.formula import Formula as Expression
from dxlrun.control.loop_plan import JointPlan
from dxlrun.description import MotionDescription
from dxlrun.description.motion import Formula, FormulaPart, PointsPart
from dxlrun.errors import Mark

Quantity = Literal["position", "velocity", "acceleration"]
QUANTITIES: tuple[Quantity, ...] = ("position", "velocity", "acceleration")


@dataclass(frozen=True, slots=True)
class Target:
    """Where a joint shall be, rad, and how, rad/s and rad/s^2; None = not said."""

    position: float | None
    velocity: float | None
    acceleration: float | None
    mark: Mark

    def get(self, quantity: Quantity) -> float | None:
        """Return the value of a quantity."""
        if quantity == "position":
            return self.position
        return self.velocity if quantity == "velocity" else self.acceleration


@dataclass(frozen=True, slots=True)
class Sample:
    """The targets of one moment."""

    t_ns: int
    """Since the part's start."""
    targets: dict[str, Target]
    mark: Mark


def listed_samples(
    motion: MotionDescription, index: int, part: PointsPart, problems: Problems
) -> tuple[Sample, ...]:
    """Return the points that a person listed; their times must grow."""
    samples: list[Sample] = []
    for number, point in enumerate(part.points):
        path = ("motions", index, "points", number)
        if samples and point.time <= samples[-1].t_ns:
            problems.error(
                motion.marks.value(*path, "time"),
                f"time {point.time / 1e9:g} s is not after that of the point before, "
                f"{samples[-1].t_ns / 1e9:g} s",
                "sort the points by time",
            )
        targets = {
            joint: Target(
                target.position,
                target.velocity,
                target.acceleration,
                motion.marks.key(*path, "joints", joint),
            )
            for joint, target in point.joints.items()
        }
        samples.append(Sample(point.time, targets, motion.marks.value(*path)))
    return tuple(samples)


def formula_texts(part: FormulaPart) -> tuple[str, ...]:
    """Return every formula of a part."""
    texts = (_text(formula, quantity) for formula in part.joints.values() for quantity in QUANTITIES)
    return tuple(text for text in texts if text is not None)


def formula_samples(
    motion: MotionDescription, index: int, part: FormulaPart, problems: Problems
) -> tuple[Sample, ...]:
    """Return the formulas' values at `samples` moments over `duration`, both ends included."""
    count = part.samples
    times = [round(part.duration * i / max(1, count - 1)) for i in range(count)]
    columns: dict[str, dict[Quantity, list[float]]] = {}
    good = True
    for joint, formula in part.joints.items():
        columns[joint] = {}
        for quantity in QUANTITIES:
            text = _text(formula, quantity)
            if text is None:
                continue
            mark = motion.marks.value("motions", index, "joints", joint, quantity)
            values = _values(mark, text, times, problems)
            good = good and values is not None
            columns[joint][quantity] = values or []
    if not good:
        return ()
    marks = {joint: motion.marks.value("motions", index, "joints", joint, "position") for joint in columns}
    part_mark = motion.marks.value("motions", index)
    return tuple(
        Sample(t_ns, {joint: _target(columns[joint], row, marks[joint]) for joint in columns}, part_mark)
        for row, t_ns in enumerate(times)
    )


def _target(column: Mapping[Quantity, Sequence[float]], row: int, mark: Mark) -> Target:
    values = {quantity: column[quantity][row] for quantity in column}
    return Target(values.get("position"), values.get("velocity"), values.get("acceleration"), mark)


def _text(formula: Formula, quantity: Quantity) -> str | None:
    if quantity == "position":
        return formula.position
    return formula.velocity if quantity == "velocity" else formula.acceleration


def _values(mark: Mark, text: str, times: Sequence[int], problems: Problems) -> list[float] | None:
    """Return a formula's values at the times; None when it is wrong."""
    try:
        formula = Expression(text)
    except ValueError as error:
        problems.error(mark, f"formula {text!r} cannot be read: {error}", "correct the formula")
        return None
    values: list[float] = []
    for t_ns in times:
        try:
            values.append(formula.at(t_ns * 1e-9))
        except ValueError as error:
            problems.error(
                mark,
                f"formula {text!r} has no value at t = {t_ns * 1e-9:.6g} s: {error}",
                "correct the formula",
            )
            return None
    return values


def check_limits(
    samples: Sequence[Sample], start_ns: int, limits: dict[str, Interval], problems: Problems
) -> None:
    """Warn once for each joint whose targets leave its limits, with the worst of them."""
    worst: dict[str, tuple[float, Sample, float]] = {}
    for sample in samples:
        for joint, target in sample.targets.items():
            allowed = limits.get(joint)
            if allowed is None or target.position is None:
                continue
            excess = max(allowed.lower - target.position, target.position - allowed.upper)
            if excess > worst.get(joint, (1e-6, sample, 0.0))[0]:
                worst[joint] = (excess, sample, target.position)
    for joint, (_, sample, position) in worst.items():
        problems.warning(
            sample.targets[joint].mark,
            f"{joint} is sent to {degrees(position)} deg at {(start_ns + sample.t_ns) * 1e-9:.3f} s, "
            f"outside its limits {limits[joint]}",
            "the gate will hold it at the limit; change the motion or the limits",
        )


def check_speeds(
    samples: Sequence[Sample],
    start_ns: int,
    joints: Mapping[str, JointPlan],
    problems: Problems,
    *,
    interpolated: bool,
) -> None:
    """Refuse once for each joint a speed above the top speed of its servo; warn above the file's limit.

    The speeds are the targets', and with `interpolated`, where a controller moves from sample to sample, the
    mean speed between two samples, which every way through both reaches.
    """
    fastest: dict[str, tuple[float, int, Mark]] = {}

    def note(joint: str, speed: float, t_ns: int, mark: Mark) -> None:
        if abs(speed) > fastest.get(joint, (0.0, 0, mark))[0]:
            fastest[joint] = abs(speed), t_ns, mark

    before: dict[str, tuple[int, float]] = {}
    for sample in samples:
        for joint, target in sample.targets.items():
            if target.velocity is not None:
                note(joint, target.velocity, sample.t_ns, target.mark)
            if target.position is None:
                continue
            t_ns, position = before.get(joint, (sample.t_ns, 0.0))
            if interpolated and sample.t_ns > t_ns:
                speed = (target.position - position) / ((sample.t_ns - t_ns) * 1e-9)
                note(joint, speed, sample.t_ns, target.mark)
            before[joint] = sample.t_ns, target.position
    for joint, (speed, t_ns, mark) in fastest.items():
        plan = joints.get(joint)
        if plan is None or speed <= plan.highest_speed * (1 + 1e-9):
            continue
        asked = f"{joint} is asked for {speed:.4g} rad/s at {(start_ns + t_ns) * 1e-9:.3f} s"
        if plan.top_speed is not None and speed > plan.top_speed * (1 + 1e-9):
            problems.error(
                mark,
                f"{asked}, more than {plan.top_speed:.4g} rad/s, the top speed of its servo",
                "give it more time, or a shorter way",
            )
        else:
            problems.warning(
                mark,
                f"{asked}, more than {plan.highest_speed:.4g} rad/s, its velocity limit",
                "the gate will hold it at the limit, so it comes late; give it more time, or raise the limit",
            )
