"""Motions: converts the parts of a motion file into prepared commands for controllers, by time.

The `start` of a part is the time since the loop's first deadline at which its controller gets the first
command. A controller can play motions if it has one of two commands. The first is `trajectory` (points: time
s, positions, velocities, accelerations; start_in s). The second has the fields `positions`, `velocities` or
both: values in rad and rad/s in the order of the joints. The standard controllers have such commands, and
those of plug-ins may have them.

A controller with trajectories gets one trajectory. A group controller gets one command for each point; joints
that the point does not name keep their previous targets. A trajectory whose first point is at t = 0 would be
a jump. It therefore begins 1 s after its handover, as in the thesis, and the controller leads the joints to
the first point until then.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from typing import Any

import msgspec
import numpy as np
from msgspec import structs
from pydantic import TypeAdapter, ValidationError

from dxlrun.compile.controller_entry import CompiledController
from dxlrun.compile.joints.compiled_joints import CompiledJoint
from dxlrun.compile.joints.limits import check_samples
from dxlrun.compile.joints.poses import Poses, WrongPose
from dxlrun.compile.motion_names import PLAY, FoundMotion, find_motion
from dxlrun.compile.motion_samples import (
    QUANTITIES,
    MotionSample,
    Quantity,
    SampledTarget,
    formula_samples,
    formula_texts,
    listed_samples,
)
from dxlrun.compile.problems import Problems, RobotFile
from dxlrun.contract.controller import Controller, SpeedPeak
from dxlrun.description.base_form import Name
from dxlrun.description.document import refusal
from dxlrun.description.form_problems import problems_of, sentences_of
from dxlrun.description.motion import (
    FormulaPart,
    MotionDescription,
    Point,
    PointsPart,
    Target,
    read_motion,
)
from dxlrun.description.units import Measure, Position
from dxlrun.errors import InputError, Mark, suggestion, what_and_fix
from dxlrun.plan.loop_plan import SETTLE_NS, JointPlan, ScheduledCommand, ScheduledGoal
from dxlrun.plan.robot_plan import MotionPart
from dxlwire.joint_unit import LINEAR, ROTARY, JointUnit

TRAJECTORY = "trajectory"
_FIELDS: dict[Quantity, str] = {
    "position": "positions",
    "velocity": "velocities",
    "acceleration": "accelerations",
}
_EXAMPLES: Mapping[JointUnit, Mapping[Quantity, str]] = {
    ROTARY: {"position": "30 deg", "velocity": "1 rad/s", "acceleration": "5 rad/s^2"},
    LINEAR: {"position": "20 mm", "velocity": "50 mm/s", "acceleration": "200 mm/s^2"},
}
LEAD_NS = 1_000_000_000
"""Time from the start of a trajectory command to its first point, ns, if that point is at t = 0."""
_BY_JOINT: TypeAdapter[dict[str, Measure]] = TypeAdapter(dict[Name, Position], config={"strict": True})
MOST_TARGETS = 200_000
"""Most targets that all formulas of a motion file may have: 20 joints for 100 s at 100 Hz. Each takes about
300 bytes and 5 us."""
# Characters of formulas times evaluations; each takes up to 0.5 us, so 10 s in total.
MOST_CHARACTERS = 20_000_000


def compile_motions(
    motions: Iterable[MotionDescription | str],
    controllers: Mapping[str, CompiledController],
    joints: Mapping[str, CompiledJoint],
    file: RobotFile,
    poses: Poses,
) -> tuple[list[MotionDescription], list[MotionPart]]:
    """Return the motion files of all motions, and their parts; those with mistakes are omitted.

    Motions can be names of motion files or of controllers' own motions.
    """
    names = tuple(file.robot.controllers)
    played: list[MotionDescription] = []
    parts: list[MotionPart] = []
    for one in motions:
        found = _resolve_motion(one, file, controllers) if isinstance(one, str) else one
        if isinstance(found, MotionDescription):
            played.append(found)
            try:
                found = with_poses(found, poses, file)
            except InputError as error:
                file.extend(error.problems)
                continue
            parts += compile_motion(found, controllers, names, joints, file)
        elif found is not None:
            parts += _compile_own_motion(found, file, controllers)
    return played, parts


def with_poses(motion: MotionDescription, poses: Poses, remarks: Problems) -> MotionDescription:
    """Return a motion whose points have the joints of the poses that they name; raise InputError.

    `remarks` gets a warning for each pose that the joints do not reach in full.
    """
    problems, wrong_poses = Problems(), list[WrongPose]()

    def posed(point: Point, number: int, index: int) -> Point:
        if point.pose is None:
            return point
        path = ("motions", index, "points", number, "pose")
        try:
            solved = poses.find_pose(point.pose)
            found = (
                _BY_JOINT.validate_python(point.pose)
                if solved is None
                else {
                    joint: Measure(at, poses.joints[joint].unit.si) for joint, at in solved.positions.items()
                }
            )
        except WrongPose as wrong:
            wrong_poses.append(wrong)
            for inside, *problem in wrong.problems:
                problems.error(motion.marks.value(*path, *inside), *problem)
            return point
        except ValidationError as error:
            problems.extend(problems_of(error, motion.marks, path))
            return point
        if solved is not None and solved.remark:
            fix = "give it another orientation"
            remarks.warning(motion.marks.value(*path), f"the pose is {solved.remark}", fix)
        targets = {joint: Target(position=at) for joint, at in found.items()}
        return point.model_copy(update={"joints": targets | point.joints})

    parts = [
        part.model_copy(
            update={"points": tuple(posed(one, number, index) for number, one in enumerate(part.points))}
        )
        if isinstance(part, PointsPart)
        else part
        for index, part in enumerate(motion.motion.motions)
    ]
    if wrong_poses or problems.errors:
        raise InputError(problems.errors)
    return structs.replace(motion, motion=motion.motion.model_copy(update={"motions": tuple(parts)}))


def compile_motion(
    motion: MotionDescription,
    controllers: Mapping[str, CompiledController],
    names: tuple[str, ...],
    joints: Mapping[str, CompiledJoint],
    problems: Problems,
) -> list[MotionPart]:
    """Convert a motion file into parts with commands; parts with mistakes are omitted.

    `names` are all controllers of the robot file.
    """
    plans = {name: joint.plan for name, joint in joints.items()}
    parts: list[MotionPart] = []
    if not affordable(motion, problems):
        return parts
    if motion.without:
        what = f"{motion.motion.name} is played without {', '.join(motion.without)}"
        problems.warning(motion.marks.key("motions"), what, "play another motion if it needs them")
    for index, part in enumerate(motion.motion.motions):
        controller = _controller(motion, index, controllers, names, problems)
        kind, samples = playable(motion, index, controller, plans, problems)
        if controller is None or not samples:
            continue
        lead_ns = LEAD_NS if kind == TRAJECTORY and samples[0].t_ns == 0 else 0
        commands: tuple[ScheduledCommand, ...] = ()
        peaks: Sequence[SpeedPeak] = ()
        try:
            commands = commands_of(controller, kind, samples, part.start, lead_ns)
            peaks = speed_peaks(controller, commands, samples[0].mark)
        except InputError as error:
            problems.extend(error.problems)
        check_samples(samples, part.start + lead_ns, plans, problems, peaks)
        if not commands:
            continue
        if kind == TRAJECTORY:
            warn_of_turns(samples, plans, getattr(controller.parameters, "wrap", ()), problems)
        last_ns = part.start + lead_ns + samples[-1].t_ns
        if kind not in controller.offer.controller.Goals:
            last_ns = part.start + lead_ns + last_arrival_ns(samples, plans)
            warn_of_last_velocities(samples, problems)
        goal = ScheduledGoal(last_ns, last_positions(controller.plan.joints, samples))
        commands = (structs.replace(commands[0], goal=goal), *commands[1:])
        end_ns = last_ns + _settle_ns(controller, plans)
        mark = motion.marks.value("motions", index, "controller")
        parts.append(
            MotionPart(str(motion.path), part.controller, part.start, end_ns, len(samples), commands, mark)
        )
    return parts


def _resolve_motion(
    word: str, file: RobotFile, controllers: Mapping[str, CompiledController]
) -> MotionDescription | FoundMotion | None:
    """Return the motion file or the controller's own motion that a name stands for.

    Returns None if an error was added, or if earlier errors may hide the motion.
    """
    players = {}
    for name, controller in controllers.items():
        # A plug-in whose code fails has a warning of `check_motions`.
        with suppress(Exception):
            players[name] = tuple(controller.offer.controller.motions(controller.parameters))
    try:
        found = find_motion(word, file.robot.name, file.description.path, players)
        return (
            found
            if found.player
            else read_motion(found.path, file.description.groups, file.description.omitted)
        )
    except InputError as error:
        what, fix = what_and_fix(error)
        if error.problems:
            file.extend(error.problems)
        elif len(controllers) == len(file.robot.controllers):
            file.error(file.key("controllers"), what, fix)
        return None


def _compile_own_motion(
    found: FoundMotion, file: RobotFile, controllers: Mapping[str, CompiledController]
) -> list[MotionPart]:
    """Return a part that begins a controller's own motion with the run; empty if an error was added."""
    name, controller = found.player, controllers[found.player]
    mark = file.key("controllers", name, "motions", found.name)
    if not controller.plan.active:
        _refuse_inactive(file.key("controllers", name), name, file)
        return []
    seconds = controller.offer.controller.motions(controller.parameters)[found.name]
    end_ns = round(seconds * 1e9) if math.isfinite(seconds) else None
    try:
        command = prepared(controller, PLAY, {"motion": found.name}, 0, mark)
    except InputError as error:
        file.extend(error.problems)
        return []
    origin = str(Mark(found.name, mark.line, mark.column))
    command = structs.replace(command, goal=ScheduledGoal(end_ns), origin=origin)
    return [MotionPart(found.name, name, 0, end_ns, 0, (command,), mark)]


def check_times(parts: Sequence[MotionPart], duration_ns: int | None, problems: Problems) -> None:
    """Refuse a part that starts while its controller still plays another; warn if the run ends too early."""
    by_start = sorted(parts, key=lambda part: part.start_ns)
    for index, part in enumerate(by_start):
        replaced = [
            one
            for one in by_start[:index]
            if one.controller == part.controller and _end_ns(one) > part.start_ns
        ]
        if replaced:
            last = max(replaced, key=_end_ns)
            end = "at a cancel" if last.end_ns is None else f"at {_seconds(_end_ns(last))}"
            later = f"write start: {_seconds(last.end_ns)}, or " if last.end_ns and part.points else ""
            problems.error(
                part.mark,
                f"this motion of {part.controller} starts at {_seconds(part.start_ns)}, but the motion at "
                f"{last.mark} ends {end}",
                f"{later}play the motions in two runs",
            )
    for part in parts:
        if duration_ns is not None and part.end_ns is not None and _end_ns(part) > duration_ns:
            problems.warning(
                part.mark,
                f"the motion of {part.controller} ends at {_seconds(_end_ns(part))}, but the run ends "
                f"at {_seconds(duration_ns)}",
                "omit --duration",
            )


def _end_ns(part: MotionPart) -> float:
    return math.inf if part.motion_end_ns is None else part.motion_end_ns


def _seconds(time_ns: float) -> str:
    return f"{time_ns / 1e9:.4g} s"


def affordable(motion: MotionDescription, problems: Problems) -> bool:
    """Return True if the formulas of a motion file are few and short enough to evaluate; else add errors."""
    values: dict[int, int] = {}
    characters: dict[int, int] = {}
    for index, part in enumerate(motion.motion.motions):
        if isinstance(part, FormulaPart):
            values[index] = part.samples * len(part.joints)
            characters[index] = part.samples * sum(map(len, formula_texts(part)))
    good = True
    for what, per_part, most in (
        ("targets (samples x joints, of all parts)", values, MOST_TARGETS),
        (
            "characters of formulas (samples x length, of all parts)",
            characters,
            MOST_CHARACTERS,
        ),
    ):
        total = sum(per_part.values())
        if total > most:
            good = False
            longest = max(per_part, key=lambda index: per_part[index])
            problems.error(
                motion.marks.value("motions", longest, "samples"),
                f"{motion.motion.name} has {total} {what}; {most} are allowed",
                "lower samples: a trajectory controller interpolates between them"
                if per_part is values
                else "lower samples, or shorten the formulas",
            )
    return good


def samples_of(motion: MotionDescription, index: int, problems: Problems) -> tuple[MotionSample, ...]:
    """Return the samples of one part of a motion, from its points or from its formulas."""
    part = motion.motion.motions[index]
    if isinstance(part, PointsPart):
        return listed_samples(motion, index, part, problems)
    return formula_samples(motion, index, part, problems)


def _controller(
    motion: MotionDescription,
    index: int,
    controllers: Mapping[str, CompiledController],
    names: tuple[str, ...],
    problems: Problems,
) -> CompiledController | None:
    """Return the compiled controller of a part; None if it is unknown, inactive or has mistakes."""
    name = motion.motion.motions[index].controller
    mark = motion.marks.value("motions", index, "controller")
    if name not in names:
        problems.error(mark, f"the robot has no controller {name}", suggestion(name, names))
        return None
    controller = controllers.get(name)
    if controller is not None and not controller.plan.active:
        _refuse_inactive(mark, name, problems)
        return None
    return controller


def _refuse_inactive(mark: Mark, name: str, problems: Problems) -> None:
    what = f"controller {name} is not active at start"
    problems.error(mark, what, "write active: true in the robot file, or choose an active controller")


def playable(
    motion: MotionDescription,
    index: int,
    controller: CompiledController | None,
    joints: Mapping[str, JointPlan],
    problems: Problems,
) -> tuple[str, tuple[MotionSample, ...]]:
    """Return the name of the command that plays a part, and the part's samples; empty if it has mistakes."""
    samples = samples_of(motion, index, problems)
    if controller is None or not _names_own_joints(motion, index, controller, problems):
        return "", ()
    kind = command_kind(controller.offer.controller)
    if kind is None:
        problems.error(
            motion.marks.value("motions", index, "controller"),
            f"{controller.plan.name} ({controller.plan.type}) cannot play motions",
            "choose a group controller or a trajectory controller",
        )
    if kind is None or not _right_units(motion, index, joints, problems):
        return "", ()
    return kind, samples


def _names_own_joints(
    motion: MotionDescription, index: int, controller: CompiledController, problems: Problems
) -> bool:
    """Return True if the part's controller moves every joint that the part names; else add errors."""
    part = motion.motion.motions[index]
    paths: list[tuple[str | int, ...]]
    if isinstance(part, PointsPart):
        paths = [
            ("points", number, "joints", joint)
            for number, point in enumerate(part.points)
            for joint in point.joints
        ]
    else:
        paths = [("joints", joint) for joint in part.joints]
    own = controller.plan.joints
    wrong = [path for path in paths if path[-1] not in own]
    for path in wrong:
        joint = str(path[-1])
        problems.error(
            motion.marks.key("motions", index, *path),
            f"{part.controller} does not move {joint}",
            suggestion(joint, own),
        )
    return not wrong


def _right_units(
    motion: MotionDescription, index: int, joints: Mapping[str, JointPlan], problems: Problems
) -> bool:
    """Return True if the targets of linear joints are lengths and those of others angles; else add errors."""
    part, good = motion.motion.motions[index], True
    for number, point in enumerate(part.points if isinstance(part, PointsPart) else ()):
        for joint, target in point.joints.items():
            if joint not in joints:
                continue
            for quantity, value in zip(QUANTITIES, target.quantities, strict=True):
                unit = joints[joint].unit
                if value is not None and value.joint_unit is not unit:
                    problems.error(
                        motion.marks.value("motions", index, "points", number, "joints", joint, quantity),
                        f"{joint} {unit.verb}, so its {quantity} cannot be in {value.unit}",
                        f"write {unit.shown} or {unit.si}, as in {_EXAMPLES[unit][quantity]}",
                    )
                    good = False
    return good


def _settle_ns(controller: CompiledController, joints: Mapping[str, JointPlan]) -> int:
    """Return the time, ns, that the joints have after the last target to reach it."""
    tolerances = getattr(controller.parameters, "tolerances", controller.parameters)
    goal_time = getattr(tolerances, "goal_time", None)
    if isinstance(goal_time, int) and goal_time > 0:
        return goal_time
    own = [joints[name].settle_ns for name in controller.plan.joints if name in joints]
    return max(own, default=0) or SETTLE_NS


def warn_of_turns(
    samples: Sequence[MotionSample],
    joints: Mapping[str, JointPlan],
    wrap: Collection[str],
    problems: Problems,
) -> None:
    """Warn of each continuous joint that turns by more than half a turn between two samples."""
    longest: dict[str, tuple[float, Mark]] = {}
    before: dict[str, float] = {}
    for sample in samples:
        for joint, target in sample.targets.items():
            if target.position is None:
                continue
            step = abs(target.position - before.get(joint, target.position))
            # Exactly half a turn has no shorter way; 1e-9 allows for rounding.
            if step > longest.get(joint, (math.pi * (1 + 1e-9), target.mark))[0]:
                longest[joint] = step, target.mark
            before[joint] = target.position
    for joint, (step, mark) in longest.items():
        if (
            joint in joints
            and joints[joint].continuous
            and joints[joint].unit is ROTARY
            and joint not in wrap
        ):
            problems.warning(
                mark,
                f"{joint} turns by {math.degrees(step):.4g} deg from one point to the next",
                f"write wrap: true for {joint} to take the shorter way",
            )


def warn_of_last_velocities(samples: Sequence[MotionSample], problems: Problems) -> None:
    """Warn of joints with a velocity but no position whose last velocity is not 0."""
    last: dict[str, SampledTarget] = {}
    for sample in samples:
        last.update(sample.targets)
    for joint, target in last.items():
        if target.position is None and target.velocity:
            problems.warning(
                target.mark,
                f"{joint} still moves at the end of the motion and reaches no goal",
                f"end with a velocity of 0 for {joint}",
            )


def last_positions(joints: Sequence[str], samples: Sequence[MotionSample]) -> tuple[float | None, ...]:
    """Return the last position of each joint, rad or m; None for a joint that only has velocities."""
    held: dict[str, float] = {}
    for sample in samples:
        for joint, target in sample.targets.items():
            if target.position is not None:
                held[joint] = target.position
    return tuple(held.get(joint) for joint in joints)


def last_arrival_ns(samples: Sequence[MotionSample], joints: Mapping[str, JointPlan]) -> int:
    """Return when the joints reach their last positions at the earliest, ns since the part's start.

    A joint moves to a position at the speed commanded with it, else at its highest speed.
    """
    arrival_ns = samples[-1].t_ns
    held: dict[str, float] = {}
    for sample in samples:
        for name, target in sample.targets.items():
            if target.position is None or (joint := joints.get(name)) is None:
                continue
            speed = min(joint.highest_speed, abs(target.velocity or math.inf))
            if 0 < speed < math.inf:
                way_s = abs(joint.way(held.get(name, target.position), target.position)) / speed
                # Acceleration and braking each add half of speed / acceleration.
                starting_s = 0.0 if joint.acceleration is None else speed / joint.acceleration
                arrival_ns = max(arrival_ns, sample.t_ns + round((way_s + starting_s) * 1e9))
            held[name] = target.position
    return arrival_ns


def commands_of(
    controller: CompiledController, kind: str, samples: tuple[MotionSample, ...], start_ns: int, lead_ns: int
) -> tuple[ScheduledCommand, ...]:
    """Return a part's commands with their times: one trajectory, or one command per sample for a group."""
    joints = controller.plan.joints
    if kind == TRAJECTORY:
        payload = trajectory_command(joints, samples, lead_ns)
        return (prepared(controller, kind, payload, start_ns, samples[0].mark),)
    commands: list[ScheduledCommand] = []
    held = samples[0]
    for sample in samples:
        held = MotionSample(sample.t_ns, {**held.targets, **sample.targets}, sample.mark)
        payload = group_command(controller.offer.controller, kind, joints, held)
        commands.append(prepared(controller, kind, payload, start_ns + sample.t_ns, sample.mark))
    return tuple(commands)


def prepared(
    controller: CompiledController, kind: str, payload: dict[str, object], at_ns: int, mark: Mark
) -> ScheduledCommand:
    """Let the controller validate and prepare a command; return it with its time; raise InputError."""
    cls = controller.offer.controller
    try:
        data = cls.prepare(kind, cls.Commands[kind].model_validate(payload), controller.parameters)
        flat = np.ascontiguousarray(data, dtype="<f8").tobytes()
    except ValidationError as error:
        (reason,) = sentences_of(error, kind, cls.Commands[kind], 1)
    except Exception as error:
        reason = str(error) or type(error).__name__
    else:
        return ScheduledCommand(
            at_ns=at_ns,
            controller=controller.plan.name,
            kind=kind,
            data=flat,
            origin=str(mark),
            request=msgspec.json.encode(payload).decode(),
        )
    raise refusal(mark, f"{controller.plan.name} refuses this: {reason}", "change the motion")


def speed_peaks(
    controller: CompiledController, commands: Sequence[ScheduledCommand], mark: Mark
) -> list[SpeedPeak]:
    """Return the highest speeds of joints within a trajectory, as the controller's class computes them.

    A group controller has no path between its targets. Raises InputError.
    """
    if len(commands) != 1 or commands[0].kind != TRAJECTORY:
        return []
    (command,) = commands
    data = np.frombuffer(command.data, "<f8")
    try:
        return list(controller.offer.controller.speed_peaks(command.kind, data, controller.parameters))
    except Exception as error:
        reason = str(error) or type(error).__name__
        what = f"{controller.plan.name}: speed_peaks() failed: {reason}"
        raise refusal(mark, what, f"report this to the author of {controller.offer.distribution}") from error


def command_kind(controller: type[Controller[Any]]) -> str | None:
    """Return the name of a controller's command that can play motions; None if it has none."""
    if TRAJECTORY in controller.Commands:
        return TRAJECTORY
    for kind, model in controller.Commands.items():
        if model.model_fields and set(model.model_fields) <= {"positions", "velocities"}:
            return kind
    return None


def group_command(
    controller: type[Controller[Any]], kind: str, joints: Sequence[str], sample: MotionSample
) -> dict[str, object]:
    """Return the fields of a group command for one sample, with one value per joint.

    Raises:
        InputError: The controller does not take a quantity of the sample, or a joint has no value for one.
    """
    fields = controller.Commands[kind].model_fields
    quantities = [quantity for quantity, name in _FIELDS.items() if name in fields]
    for joint, target in sample.targets.items():
        for quantity in _FIELDS:
            if quantity not in quantities and target.value_of(quantity) is not None:
                raise refusal(
                    target.mark,
                    f"{joint} has a target {quantity}, but this controller does not support it",
                    f"remove the {quantity}, or choose another controller",
                )
    return {
        _FIELDS[quantity]: [_value(sample, joint, quantity) for joint in joints] for quantity in quantities
    }


def trajectory_command(
    joints: Sequence[str], samples: Sequence[MotionSample], lead_ns: int
) -> dict[str, object]:
    """Return the fields of a trajectory command through all samples; raise InputError for a missing value."""
    quantities: list[Quantity] = ["position"]
    derivatives: tuple[Quantity, ...] = ("velocity", "acceleration")
    for quantity in derivatives:
        if any(
            target.value_of(quantity) is not None for sample in samples for target in sample.targets.values()
        ):
            quantities.append(quantity)
    points: list[dict[str, object]] = [
        {
            "time": sample.t_ns * 1e-9,
            **{
                _FIELDS[quantity]: [_value(sample, joint, quantity) for joint in joints]
                for quantity in quantities
            },
        }
        for sample in samples
    ]
    return {"points": points, "start_in": lead_ns * 1e-9}


def _value(sample: MotionSample, joint: str, quantity: Quantity) -> float:
    """Return one joint's target value in a sample; raise InputError if it is missing."""
    target = sample.targets.get(joint)
    value = None if target is None else target.value_of(quantity)
    if value is None:
        raise refusal(
            sample.mark if target is None else target.mark,
            f"{joint} has no target {quantity} at {sample.t_ns * 1e-9:g} s",
            f"add the {quantity} here or, for a group controller, in an earlier point",
        )
    return value
