"""Motions: the parts of a motion file become prepared commands for controllers, by time.

A part's `start` is the time since the loop's first deadline at which its controller gets the first command.
A controller that takes trajectories gets one; a group controller gets one command for each point, in which a
joint that the point does not name keeps the target of the point before. A trajectory whose first point lies
at t = 0 would be a jump, so it begins 1 s after it was handed over, as in the thesis: meanwhile the
controller leads the joints to the first point.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from pydantic import ValidationError

from dxlrun.compile.checks.problems import Problems, suggestion
from dxlrun.compile.controllers import CompiledController
from dxlrun.compile.joint.joints import CompiledJoint
from dxlrun.compile.joint.reach import Interval
from dxlrun.compile.motion.commands import (
    TRAJECTORY,
    UnfitError,
    command_kind,
    group_command,
    trajectory_command,
)
from dxlrun.compile.motion.samples import (
    Sample,
    check_limits,
    check_speeds,
    formula_samples,
    formula_texts,
    listed_samples,
)
from dxlrun.control.loop_plan import ScheduledCommand
from dxlrun.description import MotionDescription
from dxlrun.description.motion import FormulaPart, PointsPart
from dxlrun.description.source.problems import sentences_of
from dxlrun.errors import Mark

LEAD_NS = 1_000_000_000
"""From handing over a trajectory that begins at t = 0 to its first point, as in the thesis."""
MOST_TARGETS = 200_000
"""Of all formulas of a motion file: 20 joints for 100 s at 100 Hz. One takes some 300 bytes and 5 us."""
MOST_CHARACTERS = 20_000_000
"""Of formulas, as often as they are evaluated: up to 0.5 us each, so 10 s."""
SETTLE_NS = 1_000_000_000
"""From the last target to the end of the part, where the controller's `goal_time` says nothing."""


@dataclass(frozen=True, slots=True)
class CompiledPart:
    """One part of a motion, ready for the loop; times since the loop's first deadline."""

    file: str
    controller: str
    start_ns: int
    end_ns: int
    points: int
    commands: tuple[ScheduledCommand, ...]


def compile_motion(
    motion: MotionDescription,
    controllers: Mapping[str, CompiledController],
    names: tuple[str, ...],
    joints: Mapping[str, CompiledJoint],
    problems: Problems,
) -> list[CompiledPart]:
    """Return the parts that could be compiled; `names` are all controllers of the robot file."""
    limits = {name: Interval(joint.plan.lower, joint.plan.upper) for name, joint in joints.items()}
    plans = {name: joint.plan for name, joint in joints.items()}
    parts: list[CompiledPart] = []
    if not _affordable(motion, problems):
        return parts
    for index, part in enumerate(motion.motion.motions):
        samples = _samples(motion, index, problems)
        controller = _controller(motion, index, controllers, names, problems)
        if controller is None or not _own_joints(motion, index, controller, problems) or not samples:
            continue
        kind = command_kind(controller.offer.controller)
        if kind is None:
            problems.error(
                motion.marks.value("motions", index, "controller"),
                f"{part.controller} ({controller.plan.type}) takes no commands that a motion could give",
                "choose a group controller or a trajectory controller",
            )
            continue
        lead_ns = LEAD_NS if kind == TRAJECTORY and samples[0].t_ns == 0 else 0
        check_limits(samples, part.start + lead_ns, limits, problems)
        check_speeds(samples, part.start + lead_ns, plans, problems, interpolated=kind == TRAJECTORY)
        try:
            commands = _commands(controller, kind, samples, part.start, lead_ns)
        except UnfitError as error:
            problems.error(error.mark, error.what, error.mend)
            continue
        end_ns = part.start + lead_ns + samples[-1].t_ns + _settle_ns(controller)
        parts.append(
            CompiledPart(str(motion.path), part.controller, part.start, end_ns, len(samples), commands)
        )
    return parts


def _affordable(motion: MotionDescription, problems: Problems) -> bool:
    """Say whether the formulas of a motion file can be sampled in a few seconds and some 100 MB."""
    values: dict[int, int] = {}
    characters: dict[int, int] = {}
    for index, part in enumerate(motion.motion.motions):
        if isinstance(part, FormulaPart):
            values[index] = part.samples * len(part.joints)
            characters[index] = part.samples * sum(map(len, formula_texts(part)))
    good = True
    for what, per_part, most in (
        ("targets (samples x joints, of all parts)", values, MOST_TARGETS),
        ("characters of formulas to evaluate (samples x length, of all parts)", characters, MOST_CHARACTERS),
    ):
        total = sum(per_part.values())
        if total > most:
            good = False
            longest = max(per_part, key=lambda index: per_part[index])
            problems.error(
                motion.marks.value("motions", longest, "samples"),
                f"{motion.motion.name} has {total} {what}; {most} are allowed",
                "lower samples: a trajectory controller goes smoothly from one to the next"
                if per_part is values
                else "lower samples, or shorten the formulas",
            )
    return good


def _samples(motion: MotionDescription, index: int, problems: Problems) -> tuple[Sample, ...]:
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
    """Return the active controller of a part; None when there is none, or the robot file got it wrong."""
    name = motion.motion.motions[index].controller
    mark = motion.marks.value("motions", index, "controller")
    if name not in names:
        problems.error(mark, f"the robot has no controller {name}", suggestion(name, names))
        return None
    controller = controllers.get(name)
    if controller is not None and not controller.plan.active:
        problems.error(
            mark,
            f"controller {name} is not active at start",
            "write active: true in the robot file, or choose an active one",
        )
        return None
    return controller


def _own_joints(
    motion: MotionDescription, index: int, controller: CompiledController, problems: Problems
) -> bool:
    """Say whether every joint that the part names belongs to its controller."""
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


def _settle_ns(controller: CompiledController) -> int:
    """Return how long a part goes on after its last target: to when the goal must be reached, if said."""
    tolerances = getattr(controller.parameters, "tolerances", controller.parameters)
    goal_time = getattr(tolerances, "goal_time", None)
    return goal_time if isinstance(goal_time, int) and goal_time > 0 else SETTLE_NS


def _commands(
    controller: CompiledController, kind: str, samples: tuple[Sample, ...], start_ns: int, lead_ns: int
) -> tuple[ScheduledCommand, ...]:
    """Return the commands of a part; raises UnfitError with the first that cannot be given."""
    joints = controller.plan.joints
    if kind == TRAJECTORY:
        payload = trajectory_command(joints, samples, lead_ns)
        return (_prepared(controller, kind, payload, start_ns, samples[0].mark),)
    commands: list[ScheduledCommand] = []
    held = samples[0]
    for sample in samples:
        held = Sample(sample.t_ns, {**held.targets, **sample.targets}, sample.mark)
        payload = group_command(controller.offer.controller, kind, joints, held)
        commands.append(_prepared(controller, kind, payload, start_ns + sample.t_ns, sample.mark))
    return tuple(commands)


def _prepared(
    controller: CompiledController, kind: str, payload: dict[str, object], at_ns: int, mark: Mark
) -> ScheduledCommand:
    """Let the controller's own model and `prepare` judge a command; they are anybody's code."""
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
            at_ns=at_ns, controller=controller.plan.name, kind=kind, data=flat, origin=str(mark)
        )
    raise UnfitError(mark, f"{controller.plan.name} refuses this: {reason}", "change the motion")
