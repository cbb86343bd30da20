"""Motions: prepare a motion file or a position command as goals of a running robot's loop.

A motion is checked as at start-up and begins with a slow approach from the present positions.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass

import msgspec
import numpy as np
from msgspec import structs

from dxlrun.channels.cycle import CycleRecord
from dxlrun.compile.controller_entry import CompiledController
from dxlrun.compile.joints.limits import PEAK_OVER_MEAN, check_samples
from dxlrun.compile.motion_samples import MotionSample, SampledTarget
from dxlrun.compile.motions import (
    TRAJECTORY,
    affordable,
    commands_of,
    last_arrival_ns,
    last_positions,
    playable,
    speed_peaks,
)
from dxlrun.compile.problems import Problems
from dxlrun.contract.controller import SpeedPeak
from dxlrun.control.controllers.goal_registry import PlayedPart
from dxlrun.control.steering import Play
from dxlrun.description.motion import MotionDescription
from dxlrun.errors import InputError, Problem, suggestion, what_and_fix
from dxlrun.plan.loop_plan import SETTLE_NS, JointPlan, ScheduledCommand
from dxlrun.remote.preparation import PreparedCommand, ResolvedController, travel_s

SOFT_SPEED = 0.5
"""Speed of the approach to the first pose, rad/s or m/s; slower joints use their highest speed."""
LEAST_SPEED, MOST_SPEED = 0.01, 10.0
"""Limits of the factor by which a client can change a motion's speed."""
_STILL = 0.005
"""Distance from its first position, rad or m, within which a joint needs no approach."""
_LEAST_NS = 200_000_000
"""Shortest duration of an approach, ns."""
_SLOWEST = 0.05
"""Lowest speed that an approach commands, rad/s: a servo takes 0 rad/s as unlimited."""
# ns; shortest step between two position commands of an approach (50 Hz).
_RAMP_NS = 20_000_000
_MOST_STEPS = 500
"""Upper limit of the position commands into which an approach is split."""


@dataclass(frozen=True, slots=True)
class RunSnapshot:
    """The robot's present controllers, joints and states, against which a motion is checked."""

    controllers: Mapping[str, CompiledController]
    """All loaded controllers by name; `plan.active` is their present state."""
    joints: Mapping[str, JointPlan]
    record: CycleRecord
    """Record of the newest cycle."""

    def joint_position(self, joint: str) -> float:
        """Return a joint's newest goal position, else its measured position, rad or m; NaN when both are
        unknown.
        """
        row = self.record.layout.joints.index(joint)
        goal = float(self.record.goals.position[row])
        return goal if math.isfinite(goal) else float(self.record.states.position[row])

    def way(self, joint: str, position: float) -> float:
        """Return the signed distance that a joint must move from its present position, rad or m."""
        return self.joints[joint].way(self.joint_position(joint), position)


class PreparedMotion(msgspec.Struct, frozen=True, tag="played"):
    """A motion or a command that was checked and encoded for the loop's command `play`."""

    data: bytes
    """Payload of the loop's command `play`: JSON of the parts, then their samples."""
    request: bytes
    """JSON of the commands from which the payload was made, for the log."""
    seconds: float
    """Duration until all parts have ended and settled, s."""


def goal_of(
    prepared: PreparedCommand, known: ResolvedController, record: CycleRecord
) -> PreparedMotion | None:
    """Return a prepared position command as a goal for the loop; None when it has no position for each joint.

    The goal's time ends when each joint can have arrived at the lower of its highest and its commanded speed.
    """
    content = msgspec.json.decode(prepared.request)
    positions = content.get("positions") if isinstance(content, dict) else None
    if not isinstance(positions, list) or len(positions) != len(known.joints):
        return None
    speeds = content.get("velocities") or [math.inf] * len(positions)
    longest_s = 0.0
    for joint, position, commanded in zip(known.joints, positions, speeds, strict=True):
        row = record.layout.joints.index(joint.name)
        way, speed = abs(joint.way(float(record.states.position[row]), position)), joint.highest_speed
        # A velocity of 0 means no limit (e-Manual, Profile Velocity).
        if commanded:
            speed = min(speed, abs(commanded))
        if math.isfinite(way) and math.isfinite(speed):
            starting_s = 0.0 if joint.acceleration is None else speed / joint.acceleration
            longest_s = max(longest_s, travel_s(joint, way, speed) + starting_s)
    sizes = (len(prepared.data) // 8,)
    end_ns, name = round(longest_s * 1e9), prepared.controller
    part = PlayedPart(name, prepared.kind, (0,), sizes, end_ns, tuple(positions))
    data = msgspec.json.encode(Play((part,))) + b"\n" + prepared.data
    return PreparedMotion(data, b"[" + prepared.request + b"]", (end_ns + SETTLE_NS) * 1e-9)


@dataclass(frozen=True, slots=True)
class _ControllerSamples:
    """Samples of a motion for one controller; times are those of the motion after the change of speed."""

    controller: CompiledController
    kind: str
    samples: tuple[MotionSample, ...]


def schedule_motion(motion: MotionDescription, running: RunSnapshot, speed: float) -> PreparedMotion:
    """Return a motion prepared for playing now, `speed` times as fast; raises InputError with all problems.

    Values beyond the limits of a joint are refused, as in a command. All controllers begin in one cycle and
    move their joints to the first poses. The motion begins when the slowest joint has arrived.
    """
    problems = Problems()
    parts = _parts(motion, running, speed, problems) if affordable(motion, problems) else []
    for part in parts:
        _check(part, running, problems)
    wrong = [*problems.errors, *(_refused(warning) for warning in problems.warnings)]
    if wrong:
        raise InputError(sorted(wrong, key=lambda problem: problem.mark))
    lead_ns = max((_way_ns(part, running) - part.samples[0].t_ns for part in parts), default=0)
    lead_ns = max(0, lead_ns)
    played: list[PlayedPart] = []
    arrays: list[bytes] = []
    requests: list[str] = []
    for part in parts:
        try:
            commands = _commands(part, running, lead_ns)
        except InputError as error:
            problems.extend(error.problems)
            continue
        times = tuple(command.at_ns for command in commands)
        sizes = tuple(len(command.data) // 8 for command in commands)
        end_ns = lead_ns + part.samples[-1].t_ns
        if part.kind not in part.controller.offer.controller.Goals:
            end_ns = lead_ns + last_arrival_ns(part.samples, running.joints)
        positions = last_positions(part.controller.plan.joints, part.samples)
        played.append(PlayedPart(part.controller.plan.name, part.kind, times, sizes, end_ns, positions))
        arrays += (command.data for command in commands)
        requests += (command.request for command in commands)
    problems.raise_errors()
    data = msgspec.json.encode(Play(tuple(played))) + b"\n" + b"".join(arrays)
    request = f"[{','.join(requests)}]".encode()
    return PreparedMotion(data, request, (max(part.end_ns for part in played) + SETTLE_NS) * 1e-9)


def _parts(
    motion: MotionDescription, running: RunSnapshot, speed: float, problems: Problems
) -> list[_ControllerSamples]:
    """Return one part for each controller and command, joined from all parts of the motion file for them.

    Adds a problem for a controller that is unknown or not active, and for parts that overlap.
    """
    by_name: dict[tuple[str, str], list[tuple[int, Sequence[MotionSample]]]] = {}
    for index, part in enumerate(motion.motion.motions):
        controller = _controller(motion, index, running, problems)
        kind, samples = playable(motion, index, controller, running.joints, problems)
        if samples:
            by_name.setdefault((part.controller, kind), []).append((part.start, samples))
    found = []
    for (name, kind), pieces in by_name.items():
        if samples := _joined(sorted(pieces, key=lambda piece: piece[0]), speed, problems):
            found.append(_ControllerSamples(running.controllers[name], kind, samples))
    return found


def _controller(
    motion: MotionDescription, index: int, running: RunSnapshot, problems: Problems
) -> CompiledController | None:
    name = motion.motion.motions[index].controller
    mark = motion.marks.value("motions", index, "controller")
    controller = running.controllers.get(name)
    if controller is None:
        problems.error(
            mark, f"the robot has no controller {name}", suggestion(name, tuple(running.controllers))
        )
        return None
    if not controller.plan.active:
        problems.error(mark, f"controller {name} is not active", _switch(name, running))
        return None
    return controller


def _switch(name: str, running: RunSnapshot) -> str:
    """Return the CLI command that activates a controller and deactivates those that command its joints."""
    own = running.controllers[name].plan
    others = [
        plan.name
        for plan in (one.plan for one in running.controllers.values())
        if plan.active and plan.command and not set(plan.joints).isdisjoint(own.joints)
    ]
    leaving = f" --deactivate {' '.join(others)}" if others else ""
    return f"activate it by `dxlrun switch --activate {name}{leaving}`"


def _joined(
    pieces: Iterable[tuple[int, Sequence[MotionSample]]], speed: float, problems: Problems
) -> tuple[MotionSample, ...]:
    """Return the samples of a controller's parts as one sequence, `speed` times as fast; empty if they
    overlap.
    """
    joined: list[MotionSample] = []
    for start_ns, samples in pieces:
        for sample in samples:
            t_ns = round((start_ns + sample.t_ns) / speed)
            if joined and t_ns <= joined[-1].t_ns:
                if sample is samples[0]:
                    problems.error(
                        sample.mark,
                        "this part begins before the end of the previous part of the same controller",
                        "start it later",
                    )
                return ()
            targets = {joint: _faster(target, speed) for joint, target in sample.targets.items()}
            joined.append(MotionSample(t_ns, targets, sample.mark))
    return tuple(joined)


def _faster(target: SampledTarget, speed: float) -> SampledTarget:
    velocity, acceleration = target.velocity, target.acceleration
    return structs.replace(
        target,
        velocity=None if velocity is None else velocity * speed,
        acceleration=None if acceleration is None else acceleration * speed**2,
    )


def _check(part: _ControllerSamples, running: RunSnapshot, problems: Problems) -> None:
    peaks: Sequence[SpeedPeak] = ()
    # An invalid command is reported by `_commands`.
    with suppress(InputError):
        commands = commands_of(part.controller, part.kind, part.samples, 0, 0)
        peaks = speed_peaks(part.controller, commands, part.samples[0].mark)
    check_samples(part.samples, 0, running.joints, problems, peaks)
    for joint, target in part.samples[0].targets.items():
        if target.position is None:
            continue
        problem, position = running.joints[joint].immovable, running.joint_position(joint)
        if problem and abs(target.position - position) > _STILL:
            problems.error(target.mark, problem, "set the register above 0")
        elif not math.isfinite(position):
            problems.error(target.mark, f"{joint} has not answered yet", "wait for its first reply")


def _refused(warning: Problem) -> Problem:
    """Return a warning of the start-up check as an error: in a run, the loop would hold the joint instead."""
    return warning._replace(severity="error", fix=what_and_fix(warning.fix)[1])


def _way_ns(part: _ControllerSamples, running: RunSnapshot) -> int:
    """Return the duration of a part's approach from the present positions to its first pose, ns; 0 if it is
    there.
    """
    ways = (
        (abs(running.way(joint, target.position)), running.joints[joint].highest_speed)
        for joint, target in part.samples[0].targets.items()
        if target.position is not None
    )
    smooth = any(target.velocity is not None for target in part.samples[0].targets.values())
    # Other approaches have a constant speed.
    peak = PEAK_OVER_MEAN if smooth and part.kind == TRAJECTORY else 1.0
    longest = max(
        (way / min(speed / peak, SOFT_SPEED) for way, speed in ways if way > _STILL and speed), default=0.0
    )
    return max(_LEAST_NS, round(longest * 1e9)) if longest else 0


def _commands(part: _ControllerSamples, running: RunSnapshot, lead_ns: int) -> tuple[ScheduledCommand, ...]:
    """Return a part's commands with their times, approach included; `lead_ns` is the delay of the motion.

    Raises InputError for an invalid command.
    """
    first_ns = lead_ns + part.samples[0].t_ns
    if part.kind == TRAJECTORY:
        return commands_of(
            part.controller, part.kind, _moved(part.samples, -part.samples[0].t_ns), 0, first_ns
        )
    samples = (*_ramp(part, running, first_ns), *_moved(part.samples, lead_ns))
    return commands_of(part.controller, part.kind, samples, 0, 0)


def _moved(samples: Iterable[MotionSample], by_ns: int) -> tuple[MotionSample, ...]:
    return tuple(MotionSample(sample.t_ns + by_ns, sample.targets, sample.mark) for sample in samples)


def _ramp(part: _ControllerSamples, running: RunSnapshot, first_ns: int) -> Iterable[MotionSample]:
    """Yield the samples that move the joints to a part's first pose, which they reach at `first_ns`.

    A command with velocities needs one sample: the position and the speed to arrive in time. Other commands
    get positions in small steps.
    """
    first = part.samples[0]
    known = {joint: target for joint, target in first.targets.items() if target.position is not None}
    if not known or first_ns <= 0:
        return
    fields = part.controller.offer.controller.Commands[part.kind].model_fields
    ways = {joint: running.way(joint, target.position or 0.0) for joint, target in known.items()}
    if "velocities" in fields:
        seconds = first_ns * 1e-9
        targets = {
            joint: structs.replace(target, velocity=max(_SLOWEST, abs(ways[joint]) / seconds))
            for joint, target in known.items()
        }
        yield MotionSample(0, targets, first.mark)
        return
    for at_ns in np.arange(0, first_ns, max(_RAMP_NS, first_ns // _MOST_STEPS)).tolist():
        share = at_ns / first_ns
        targets = {
            joint: structs.replace(
                target, position=running.joint_position(joint) + share * ways[joint], velocity=None
            )
            for joint, target in known.items()
        }
        yield MotionSample(at_ns, targets, first.mark)
