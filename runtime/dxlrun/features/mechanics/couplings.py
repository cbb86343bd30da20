"""Couplings: compiles joints with several servos, and transmissions, with their limits and top speeds.

A joint with one servo is a coupling with the matrix 1.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import msgspec

from dxlrun.compile.joints.compiled_servos import CompiledServo
from dxlrun.compile.joints.limits import Interval, degrees
from dxlrun.compile.problems import Problems, RobotFile
from dxlrun.description.document import KeyPath
from dxlrun.description.joints.joint_forms import JointEntry, ServoJoint, SharedJoint
from dxlrun.description.joints.joint_mechanics import LEAST_RATIO, MOST_RATIO, SERVO_TOLERANCES
from dxlrun.description.units import plain
from dxlrun.errors import Mark, suggestion
from dxlrun.features.mechanics import form
from dxlrun.features.mechanics.form import Transmission
from dxlwire.joint_unit import ROTARY
from dxlwire.modes import Mode
from dxlwire.plan.mode_plan import can_count_turns, model_modes

MOST_CONDITION = 100.0
"""Highest condition number of a transmission's matrix: beyond it one tick of a servo moves a joint by more
than a hundred ticks. [i]"""
MOST_SPEED_RATIO = 1.5  # highest ratio between the top speeds of a joint's servos [i]
_TRIM = math.radians(1.0)
"""Angle of a servo by which limits may exceed its reach: rounding, or a trimmed reference. [i]"""
_LEAST_SHARE = 0.01  # least share of its reach for a joint without limits [i]

Rows = tuple[tuple[float, ...], ...]
MATRICES: Mapping[str, Rows] = {"differential": ((0.5, 0.5), (0.5, -0.5))}
"""Matrices of `type` in a transmission; a differential has half of the sum and half of the difference."""


class Coupling(msgspec.Struct, frozen=True, eq=False):
    """Servos that together move some joints; joint positions = matrix * servo positions (after gears)."""

    name: str
    place: KeyPath  # path of its joint or its transmission
    joints: tuple[str, ...]
    servos: tuple[CompiledServo, ...]
    matrix: Rows
    inverse: Rows
    tolerance: float  # rad or m; 0 if the servos cannot disagree
    transmission: bool

    @property
    def direct(self) -> bool:
        """True for an ordinary joint with a single servo and no transmission."""
        return not self.transmission and len(self.servos) == 1

    @property
    def modes(self) -> tuple[Mode, ...]:
        """Operating modes that all of the servos have; a transmission cannot use PWM."""
        each = [model_modes(one.table, one.described.continuous) for one in self.servos]
        # A fraction of the voltage is neither a speed nor a torque, so a matrix cannot divide it.
        left_out = {Mode.PWM} if self.transmission else set()
        return tuple(mode for mode in each[0] if mode not in left_out and all(mode in one for one in each))


def compile_couplings(file: RobotFile, servos: Mapping[str, CompiledServo]) -> list[Coupling]:
    """Return the coupling of each joint and each transmission; those with mistakes are omitted."""
    found: list[Coupling] = []
    for name, joint in file.robot.joints.items():
        if not isinstance(joint, ServoJoint):
            continue
        names, tolerance = [name], 0.0
        if isinstance(joint, SharedJoint):
            names = [f"{name}/{index + 1}" for index in range(len(joint.servos))]
            tolerance = float(joint.tolerance.servos or SERVO_TOLERANCES[joint.unit])
        known = tuple(servos[each] for each in names if each in servos)
        if len(known) == len(names):
            count = len(known)
            coupling = Coupling(
                name,
                ("joints", name),
                (name,),
                known,
                matrix=((1.0 / count,) * count,),
                inverse=((1.0,),) * count,
                tolerance=tolerance,
                transmission=False,
            )
            if _agree(file, coupling):
                found.append(coupling)
    owners: dict[str, str] = {}
    for name, transmission in form.STAGE.section_of(file.robot).items():
        good = _check_joints(file, name, transmission, owners)
        matrix = _matrix(file, name, transmission)
        known = tuple(servos[each] for key in transmission.servos if (each := f"{name}/{key}") in servos)
        if not good or matrix is None or len(known) < len(transmission.servos):
            continue
        coupling = Coupling(
            name,
            ("transmissions", name),
            transmission.joints,
            known,
            matrix=matrix[0],
            inverse=matrix[1],
            tolerance=float(transmission.tolerance or SERVO_TOLERANCES[ROTARY])
            if len(known) > len(transmission.joints)
            else 0.0,
            transmission=True,
        )
        if _agree(file, coupling):
            found.append(coupling)
    _check_moved(file, owners)
    return found


def _check_joints(file: RobotFile, name: str, transmission: Transmission, owners: dict[str, str]) -> bool:
    """Check that a transmission's joints exist, have no other servo, and agree in two of their keys."""
    robot, good = file.robot, True
    for index, joint in enumerate(transmission.joints):
        mark = file.at("transmissions", name, "joints", index)
        entry, owner = robot.joints.get(joint), owners.setdefault(joint, name)
        if entry is None:
            what = f"joint {joint} of transmission {name} is not defined"
            file.error(mark, what, suggestion(joint, tuple(robot.joints)))
        elif owner != name or joint in transmission.joints[:index]:
            what = f"{joint} is moved by transmission {owner} already"
            file.error(mark, what, "name each joint only once")
        elif isinstance(entry, ServoJoint):
            what = f"{joint} has its own servo, but transmission {name} moves it"
            file.error(mark, what, f"remove bus, id and the other servo keys from {joint}")
        else:
            continue
        good = False
    if not good:
        return False
    if name in robot.joints:
        file.error(
            file.key("transmissions", name),
            f"{name} is already the name of a joint",
            "give the transmission another name",
        )
        good = False
    entries = [robot.joints[joint] for joint in transmission.joints]
    for key in ("continuous", "torque"):
        if len({getattr(entry, key) for entry in entries}) > 1:
            one = next(j for j, entry in zip(transmission.joints, entries, strict=True) if _set(entry, key))
            file.error(
                file.at("joints", one, key),
                f"{key} of {one} differs from the other joints of transmission {name}",
                f"write the same {key} for {', '.join(transmission.joints)}",
            )
            good = False
    return good


def _set(entry: object, key: str) -> bool:
    """Return True if a joint's `continuous` or `torque` differs from its default."""
    return bool(getattr(entry, key)) is (key == "continuous")


def _check_moved(file: RobotFile, owners: Mapping[str, str]) -> None:
    """Add an error for each joint that has neither a servo nor a transmission."""
    for name, joint in file.robot.joints.items():
        if not isinstance(joint, ServoJoint) and name not in owners:
            file.error(
                file.key("joints", name),
                f"{name} has no servo, and no transmission moves it",
                "add its bus, id, model, reference and direction, or name it in a transmission",
            )


def _matrix(file: RobotFile, name: str, transmission: Transmission) -> tuple[Rows, Rows] | None:
    """Return a transmission's matrix, checked for its shape, and its pseudo-inverse; None after an error."""
    servos, joints = len(transmission.servos), len(transmission.joints)
    mark, place = file.at("transmissions", name, "matrix"), file.key("transmissions", name)
    named = MATRICES.get(transmission.type)
    matrix = transmission.matrix or named
    if matrix is None:
        file.error(place, f"{name} has no matrix", "add `matrix: [[0.5, 0.5], [0.5, -0.5]]`")
        return None
    if named is not None and transmission.matrix is not None:
        what = f"{name} is a {transmission.type} and has a fixed matrix"
        file.error(file.key("transmissions", name, "matrix"), what, "remove matrix, or write `type: matrix`")
        return None
    if named is not None and (servos, joints) != (len(named[0]), len(named)):
        what = f"{name} is a {transmission.type} with {servos} servos and {joints} joints"
        file.error(place, what, "give it two servos and two joints, or write `type: matrix`")
        return None
    widths = {len(row) for row in matrix}
    if len(matrix) != joints or widths != {servos}:
        shape = f"{len(matrix)} x {widths.pop()}" if len(widths) == 1 else f"{len(matrix)} uneven rows"
        file.error(
            mark,
            f"the matrix of {name} has {shape}, but its {joints} joints and {servos} servos need "
            f"{joints} x {servos}",
            "write one row per joint, with one number per servo",
        )
        return None
    if servos < joints:
        file.error(
            mark,
            f"{name} moves {joints} joints with {servos} servos",
            "add servos; each joint needs at least one",
        )
        return None
    return _inverted(name, matrix, mark, file)


def _inverted(name: str, matrix: Rows, mark: Mark, problems: Problems) -> tuple[Rows, Rows] | None:
    """Return a matrix and its pseudo-inverse; None, with an error, if it cannot move each joint alone."""
    import numpy as np  # imported here, because most robots have no transmission

    values = np.array(matrix, dtype=np.float64)
    most = np.abs(values).max(axis=1)  # largest factor of each joint
    wrong = most[(most > 1 / LEAST_RATIO) | (most < 1 / MOST_RATIO)]
    if wrong.size:
        problems.error(
            mark,
            f"the matrix of {name} moves a joint by {float(wrong[0]):.3g} rad per rad of a servo",
            f"correct it; the largest number of a row is {1 / MOST_RATIO:g} to {1 / LEAST_RATIO:g}",
        )
        return None
    singular = np.linalg.svd(values, compute_uv=False)
    if singular[-1] <= 1e-9 * singular[0]:
        problems.error(
            mark,
            f"the matrix of {name} is singular: its servos cannot move each joint alone",
            "correct it; its rows must not be multiples or sums of each other",
        )
        return None
    condition = float(singular[0] / singular[-1])
    if condition > MOST_CONDITION:
        problems.error(
            mark,
            f"the matrix of {name} is nearly singular (condition number {condition:.3g}): a small "
            "servo step moves a joint far",
            f"check its numbers and unit, rad per rad; the condition number is at most {MOST_CONDITION:g}",
        )
        return None
    inverse = np.linalg.pinv(values) if values.shape[0] != values.shape[1] else np.linalg.inv(values)
    # Rounding removes the numerical noise, and adding 0.0 turns -0.0 into 0.0.
    inverse = np.round(inverse, 15) + 0.0
    return matrix, tuple(tuple(float(value) for value in row) for row in inverse)


def _agree(file: RobotFile, coupling: Coupling) -> bool:
    """Check that a coupling's servos fit: equal protocol, baud rate and effort unit, and a common mode."""
    first, *others = coupling.servos
    marks, buses = file.marks, file.robot.buses
    good = True
    for other in others:
        pair = f"{_named(first)} and {_named(other)} move {_moved(coupling)} together, but"
        one, two = buses.get(first.described.bus), buses.get(other.described.bus)
        mark = other.described.mark(marks, "bus")
        model = other.described.mark(marks, "model")
        if one is not None and two is not None and one.protocol != two.protocol:
            what = f"{pair} one speaks Protocol {one.protocol}, the other {two.protocol}"
            file.error(mark, what, "put both on buses with the same protocol")
            good = False
        elif one is not None and two is not None and one.baud_rate != two.baud_rate:
            what = f"{pair} one bus runs at {one.baud_rate} baud, the other at {two.baud_rate}"
            file.error(mark, what, "put both on one bus, or use the same baud rate for both buses")
            good = False
        elif first.table.effort_unit != other.table.effort_unit:
            what = f"{pair} one measures its load, the other its current or torque"
            file.error(model, what, "use two servos of the same model")
            good = False
        else:
            speeds = sorted((first.top_speed, other.top_speed))
            if speeds[0] > 0 and speeds[1] / speeds[0] > MOST_SPEED_RATIO:
                file.warning(
                    model,
                    f"{pair} {first.table.model} and {other.table.model} differ in their top speeds, "
                    f"{speeds[0]:.3g} and {speeds[1]:.3g} rad/s",
                    "use two servos of the same model; the slower one limits the speed",
                )
    if good and not coupling.modes:
        file.error(
            others[0].described.mark(marks, "model") if others else marks.key(*coupling.place),
            f"the servos of {coupling.name} have no mode in common",
            "use servos of the same model",
        )
        return False
    return good


def _named(servo: CompiledServo) -> str:
    return f"ID {servo.described.id}"


def _moved(coupling: Coupling) -> str:
    return " and ".join(coupling.joints)


def allowed_limits(file: RobotFile, coupling: Coupling) -> tuple[Interval | None, ...]:
    """Return the position limits of each joint for the gate, within the servos' range; None: an error."""
    joints = file.robot.joints
    if not coupling.transmission:
        (name,) = coupling.joints
        reach = shared_reach(coupling)
        if reach is None:
            file.error(
                file.at("joints", name, "servos"),
                f"the servos of {name} share no joint angle: one reaches "
                f"{coupling.servos[0].position_range}, another {coupling.servos[-1].position_range}",
                "check reference and direction of each servo",
            )
            return (None,)
        return (_allowed(file, name, joints[name], reach, coupling.servos),)
    written = [
        None if limits is None else Interval(float(limits[0]), float(limits[1]))
        for limits in (joints[name].limits.position for name in coupling.joints)
    ]
    return box(file, coupling, written) or (None,) * len(written)


def _allowed(
    file: RobotFile, name: str, joint: JointEntry, reach: Interval, servos: Sequence[CompiledServo]
) -> Interval | None:
    """Return a joint's limits from the file, cut to its servos' range unless they count turns; None after an
    error."""
    limits = joint.limits.position
    if limits is None:
        return reach
    mark, model = file.at("joints", name, "limits", "position"), servos[0].table.model
    written = Interval(float(limits[0]), float(limits[1]), reach.unit)
    allowed = written.meet(reach)
    if reach.contains(written):
        return allowed
    beyond = max(reach.lower - written.lower, written.upper - reach.upper) / servos[0].described.ratio
    if beyond > _TRIM and all(servo.counts_turns_for(written) for servo in servos):
        file.warning(
            mark,
            f"{name} crosses raw 0 of its {model}, so it runs in extended position mode, which counts turns",
            "turn its horn if the servo's own position limits shall apply, or ignore this",
        )
        return written
    if allowed is None:
        file.error(
            mark,
            f"limits {written} of {name} are outside the reach of its {model}, {reach}",
            "check limits, reference and direction",
        )
        return None
    what = f"limits {written} of {name} exceed the reach of its {model}, {reach}"
    fix = f"write the effective limits {allowed}"
    if joint.continuous or beyond <= _TRIM:
        file.warning(mark, what, f"{fix}, or check reference and direction")
        return allowed
    other = "turn the servo's horn so that raw 0 is outside its travel, or"
    if all(can_count_turns(servo.table) for servo in servos):
        other = "write `continuous: true` for a joint of several turns, or"
    file.error(mark, what, f"{other} {fix}")
    return None


def shared_reach(coupling: Coupling) -> Interval | None:
    """Return the joint positions that all servos of one joint can reach; None if there are none."""
    reach: Interval | None = coupling.servos[0].position_range
    for servo in coupling.servos[1:]:
        reach = None if reach is None else reach.meet(servo.position_range)
    return reach


def joint_reaches(coupling: Coupling) -> tuple[Interval, ...]:
    """Return the widest range of each joint that its servos can reach, the others placed as needed."""
    if not coupling.transmission:
        return (shared_reach(coupling) or Interval(0.0, 0.0),)
    return tuple(_image(row, [one.position_range for one in coupling.servos]) for row in coupling.matrix)


def servo_ranges(coupling: Coupling, limits: Sequence[Interval]) -> tuple[Interval, ...]:
    """Return the range in which each servo moves while all joints stay within `limits`."""
    return tuple(_image(row, limits) for row in coupling.inverse)


def _image(row: Sequence[float], intervals: Sequence[Interval]) -> Interval:
    ends = [
        sorted((factor * one.lower, factor * one.upper)) for factor, one in zip(row, intervals, strict=True)
    ]
    return Interval(sum(low for low, _ in ends), sum(high for _, high in ends))


def box(
    file: RobotFile, coupling: Coupling, written: Sequence[Interval | None]
) -> tuple[Interval, ...] | None:
    """Return limits for a transmission's joints such that the servos reach all combinations of them.

    Limits in the file are kept or refused. The others become as wide as the servos permit, each by the same
    share of the joint's reach.
    """
    reaches = joint_reaches(coupling)
    ranges = [one.position_range for one in coupling.servos]
    middles = [
        sum(factor * (one.lower + one.upper) / 2 for factor, one in zip(row, ranges, strict=True))
        for row in coupling.matrix
    ]
    fixed = [
        Interval(middle, middle) if one is None else one for one, middle in zip(written, middles, strict=True)
    ]
    if not _fits(file, coupling, fixed, written):
        return None
    share = 1.0
    for row, needed, reach in zip(coupling.inverse, servo_ranges(coupling, fixed), ranges, strict=True):
        half = sum(
            abs(factor) * (one.upper - one.lower) / 2
            for factor, one, given in zip(row, reaches, written, strict=True)
            if given is None
        )
        slack = min(needed.lower - reach.lower, reach.upper - needed.upper)
        share = min(share, max(slack, 0.0) / half if half > 0 else 1.0)
    free = [joint for joint, one in zip(coupling.joints, written, strict=True) if one is None]
    if free and share < _LEAST_SHARE:
        file.error(
            file.key("joints", free[0]),
            f"the limits of the other joints of transmission {coupling.name} leave no range for {free[0]}",
            f"write `limits: {{position: ...}}` for {free[0]}, or narrow the other limits",
        )
        return None
    return tuple(
        one
        if one is not None
        else Interval(
            middle - share * (reach.upper - reach.lower) / 2, middle + share * (reach.upper - reach.lower) / 2
        )
        for one, middle, reach in zip(written, middles, reaches, strict=True)
    )


def _fits(
    file: RobotFile, coupling: Coupling, limits: Sequence[Interval], written: Sequence[Interval | None]
) -> bool:
    """Add an error for each servo that cannot reach a combination of the joints' limits; True if none."""
    good = True
    for row, servo, needed in zip(
        coupling.inverse, coupling.servos, servo_ranges(coupling, limits), strict=True
    ):
        reach = servo.position_range
        if reach.contains(needed):
            continue
        if None not in written and servo.counts_turns_for(needed):
            file.warning(
                file.key(*coupling.place),
                f"servo {servo.described.title} (ID {servo.described.id}) crosses raw 0 of its "
                f"{servo.table.model}, so it runs in extended position mode, which counts turns",
                "turn its horn if the servo's own position limits shall apply, or ignore this",
            )
            continue
        upper = needed.upper - reach.upper > reach.lower - needed.lower
        end = needed.upper if upper else needed.lower
        corner = " and ".join(
            f"{joint} at {ROTARY.text(one.upper if (factor > 0) is upper else one.lower, trim=True)}"
            for joint, factor, one in zip(coupling.joints, row, limits, strict=True)
            if factor
        )
        joint = next(name for name, one in zip(coupling.joints, written, strict=True) if one is not None)
        lower, higher = sorted(theta(servo, each) for each in (reach.lower, reach.upper))
        # A turned horn moves the travel, but does not make it longer.
        is_long = needed.upper - needed.lower > reach.upper - reach.lower
        horn = "" if is_long else "turn the servo's horn so that raw 0 is outside its travel, or "
        file.error(
            file.at("joints", joint, "limits", "position"),
            f"with {corner}, servo {servo.described.title} (ID {servo.described.id}) must be at "
            f"{degrees(theta(servo, end))} deg, but reaches {degrees(lower)} to {degrees(higher)} deg",
            f"{horn}narrow the limits of {' and '.join(coupling.joints)}",
        )
        good = False
    return good


def theta(servo: CompiledServo, position: float) -> float:
    """Convert a position at a servo's output (after its gear) into the servo's angle, rad from its raw 0."""
    described = servo.described
    return described.direction * position / described.ratio + described.reference


def top_speeds(coupling: Coupling) -> tuple[tuple[float | None, float | None], ...]:
    """Return two top speeds of each joint: while the others rest, and while all move equally fast."""
    speeds = [one.top_speed or None for one in coupling.servos]
    together = [
        None if speed is None else speed / sum(map(abs, row)) if any(row) else math.inf
        for speed, row in zip(speeds, coupling.inverse, strict=True)
    ]
    found = []
    for column in range(len(coupling.joints)):
        factors = [abs(row[column]) for row in coupling.inverse]
        alone = [
            None if speed is None else speed / factor
            for speed, factor in zip(speeds, factors, strict=True)
            if factor > 0
        ]
        found.append(
            (_least(alone), _least([one for one, factor in zip(together, factors, strict=True) if factor]))
        )
    return tuple(found)


def top_efforts(coupling: Coupling) -> tuple[float | None, ...]:
    """Return each joint's highest effort while the others have none; None: a servo has no effort goal."""
    most = [one.top_effort for one in coupling.servos]
    found: list[float | None] = []
    for row in coupling.matrix:
        each = [
            None if effort is None else effort / abs(factor)
            for effort, factor in zip(most, row, strict=True)
            if factor
        ]
        found.append(_least(each))
    return tuple(found)


def _least(values: Sequence[float | None]) -> float | None:
    """Return the smallest value; None if any value is None or there are none."""
    known = [value for value in values if value is not None]
    return min(known) if known and len(known) == len(values) else None


def check_together(file: RobotFile, coupling: Coupling) -> None:
    """Warn if the velocity or effort limits of coupled joints together demand more than a servo can do."""
    written = [file.robot.joints[name].limits for name in coupling.joints]
    for which, limits, rows, most, unit in (
        (
            "velocity",
            [plain(one.velocity) for one in written],
            coupling.inverse,
            [one.top_speed or None for one in coupling.servos],
            "rad/s",
        ),
        (
            "effort",
            [None if one.effort is None else float(one.effort) for one in written],
            tuple(zip(*coupling.matrix, strict=True)),
            [one.top_effort for one in coupling.servos],
            coupling.servos[0].table.effort_unit.replace("1", ""),
        ),
    ):
        if any(limit is None for limit in limits):
            continue
        for row, servo, own in zip(rows, coupling.servos, most, strict=True):
            needed = sum(abs(factor) * (limit or 0.0) for factor, limit in zip(row, limits, strict=True))
            if own is not None and needed > own * (1 + 1e-9):
                file.warning(
                    file.at("joints", coupling.joints[0], "limits", which),
                    f"with {' and '.join(coupling.joints)} at their {which} limits, servo "
                    f"{servo.described.title} (ID {servo.described.id}) needs {needed:.4g} {unit}, but "
                    f"has {own:.4g} {unit}".rstrip(),
                    f"lower the {which} limits",
                )
                break
