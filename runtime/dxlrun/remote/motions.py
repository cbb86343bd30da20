"""Motions for a robot that runs: checked as before a start, begun softly from where the joints are."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import msgspec
import numpy as np
from msgspec import structs

from dxlrun.channels.cycle import CycleRecord
from dxlrun.compile.controller_entry import CompiledController
from dxlrun.compile.joints.limits import PEAK_OVER_MEAN, check_samples
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
from dxlrun.compile.samples import Sample, SampledTarget
from dxlrun.contract.controller import SpeedPeak
from dxlrun.control.controllers.goals import PlayedPart
from dxlrun.control.steering import Play
from dxlrun.description.motion import MotionDescription
from dxlrun.errors import InputError, Problem, suggestion
from dxlrun.plan.loop_plan import SETTLE_NS, JointPlan, ScheduledCommand
from dxlrun.remote.preparation import Known, Prepared, travel_s

SOFT_SPEED = 0.5
"""rad/s on the way to the first pose; or the joint's limit, if that is lower."""
LEAST_SPEED, MOST_SPEED = 0.01, 10.0
"""Factors on a motion's speed."""
_STILL = 0.005
"""rad; a joint that is nearer to its first position is there."""
_LEAST_NS = 200_000_000
"""Of a way to a first pose."""
_SLOWEST = 0.05
"""rad/s on that way, of joints that have almost none: a servo at 0 rad/s would not come to rest there."""
_RAMP_NS = 20_000_000
_MOST_STEPS = 500
"""Between two commands of positions on that way; so many at most."""


@dataclass(frozen=True, slots=True)
class Running:
    """The robot as it is now, for a motion that is to be played."""

    controllers: Mapping[str, CompiledController]
    """All that are loaded; `plan.active` as it is now."""
    joints: Mapping[str, JointPlan]
    record: CycleRecord
    """The newest cycle."""

    def position(self, joint: str) -> float:
        """Return where a joint is sent, or where it is; NaN when neither is known, rad."""
        row = self.record.layout.joints.index(joint)
        goal = float(self.record.goals.position[row])
        return goal if math.isfinite(goal) else float(self.record.states.position[row])

    def way(self, joint: str, position: float) -> float:
        """Return the signed way of a joint to a position."""
        return self.joints[joint].way(self.position(joint), position)


class Played(msgspec.Struct, frozen=True, tag="played"):
    """A motion, ready for the loop."""

    data: bytes
    """Of the loop's command `play`."""
    request: bytes
    """What it was prepared from, see `Command.request`."""
    seconds: float
    """Until all parts have ended."""


def goal_of(prepared: Prepared, known: Known, record: CycleRecord) -> Played | None:
    """Return a command of positions as a goal of the loop; None where the command has no positions.

    Its motion has ended when each joint may be there, at its highest speed or the commanded one.
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
        if commanded:  # at 0 the servo goes as fast as it can
            speed = min(speed, abs(commanded))
        if math.isfinite(way) and math.isfinite(speed):
            starting_s = 0.0 if joint.acceleration is None else speed / joint.acceleration
            longest_s = max(longest_s, travel_s(joint, way, speed) + starting_s)
    sizes = (len(prepared.data) // 8,)
    end_ns, name = round(longest_s * 1e9), prepared.controller
    part = PlayedPart(name, prepared.kind, (0,), sizes, end_ns, tuple(positions))
    data = msgspec.json.encode(Play((part,))) + b"\n" + prepared.data
    return Played(data, b"[" + prepared.request + b"]", (end_ns + SETTLE_NS) * 1e-9)


@dataclass(frozen=True, slots=True)
class _Part:
    """What one controller shall do, by the time of the motion, at its final speed."""

    controller: CompiledController
    kind: str
    samples: tuple[Sample, ...]


def play(motion: MotionDescription, running: Running, speed: float) -> Played:
    """Return a motion as it is played now, `speed` times as fast; raises InputError with all that is wrong.

    What is beyond the limits of a joint is refused, as in a command. All controllers begin in one cycle, and
    lead their joints to their first poses; the motion itself begins when the slowest is there.
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
    problems.refuse()
    data = msgspec.json.encode(Play(tuple(played))) + b"\n" + b"".join(arrays)
    request = f"[{','.join(requests)}]".encode()
    return Played(data, request, (max(part.end_ns for part in played) + SETTLE_NS) * 1e-9)


def _parts(motion: MotionDescription, running: Running, speed: float, problems: Problems) -> list[_Part]:
    """Return one part for each controller, which has all parts of the file for it."""
    by_name: dict[tuple[str, str], list[tuple[int, Sequence[Sample]]]] = {}
    for index, part in enumerate(motion.motion.motions):
        controller = _controller(motion, index, running, problems)
        kind, samples = playable(motion, index, controller, running.joints, problems)
        if samples:
            by_name.setdefault((part.controller, kind), []).append((part.start, samples))
    found = []
    for (name, kind), pieces in by_name.items():
        if samples := _joined(sorted(pieces, key=lambda piece: piece[0]), speed, problems):
            found.append(_Part(running.controllers[name], kind, samples))
    return found


def _controller(
    motion: MotionDescription, index: int, running: Running, problems: Problems
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


def _switch(name: str, running: Running) -> str:
    """Return the command that activates a controller, and deactivates those that have its joints."""
    own = running.controllers[name].plan
    others = [
        plan.name
        for plan in (one.plan for one in running.controllers.values())
        if plan.active and plan.command and not set(plan.joints).isdisjoint(own.joints)
    ]
    leaving = f" --deactivate {' '.join(others)}" if others else ""
    return f"`dxlrun switch --activate {name}{leaving}` activates it"


def _joined(
    pieces: Iterable[tuple[int, Sequence[Sample]]], speed: float, problems: Problems
) -> tuple[Sample, ...]:
    """Return the samples of several parts on the time of the motion, `speed` times as fast."""
    joined: list[Sample] = []
    for start_ns, samples in pieces:
        for sample in samples:
            t_ns = round((start_ns + sample.t_ns) / speed)
            if joined and t_ns <= joined[-1].t_ns:
                if sample is samples[0]:
                    problems.error(
                        sample.mark,
                        "this part begins before the one before of its controller has ended",
                        "start it later; one controller plays one part at a time",
                    )
                return ()
            targets = {joint: _faster(target, speed) for joint, target in sample.targets.items()}
            joined.append(Sample(t_ns, targets, sample.mark))
    return tuple(joined)


def _faster(target: SampledTarget, speed: float) -> SampledTarget:
    velocity, acceleration = target.velocity, target.acceleration
    return structs.replace(
        target,
        velocity=None if velocity is None else velocity * speed,
        acceleration=None if acceleration is None else acceleration * speed**2,
    )


def _check(part: _Part, running: Running, problems: Problems) -> None:
    peaks: Sequence[SpeedPeak] = ()
    with suppress(InputError):  # a command that cannot be given is reported when it is made
        commands = commands_of(part.controller, part.kind, part.samples, 0, 0)
        peaks = speed_peaks(part.controller, commands, part.samples[0].mark)
    check_samples(part.samples, 0, running.joints, problems, peaks)
    for joint, target in part.samples[0].targets.items():
        if target.position is None:
            continue
        problem, position = running.joints[joint].immovable, running.position(joint)
        if problem and abs(target.position - position) > _STILL:
            problems.error(target.mark, problem, "write a value above 0 there")
        elif not math.isfinite(position):
            problems.error(target.mark, f"{joint} has not answered yet", "play the motion when it has")


def _refused(warning: Problem) -> Problem:
    """Return the error for what a start of a robot only warns of; there the gate would hold the joint."""
    return replace(warning, severity="error", fix=warning.fix.rpartition("; ")[2])


def _way_ns(part: _Part, running: Running) -> int:
    """Return how long the way to the first pose takes."""
    ways = (
        (abs(running.way(joint, target.position)), running.joints[joint].highest_speed)
        for joint, target in part.samples[0].targets.items()
        if target.position is not None
    )
    smooth = any(target.velocity is not None for target in part.samples[0].targets.values())
    peak = PEAK_OVER_MEAN if smooth and part.kind == TRAJECTORY else 1.0  # else the way has one speed
    longest = max(
        (way / min(speed / peak, SOFT_SPEED) for way, speed in ways if way > _STILL and speed), default=0.0
    )
    return max(_LEAST_NS, round(longest * 1e9)) if longest else 0


def _commands(part: _Part, running: Running, lead_ns: int) -> tuple[ScheduledCommand, ...]:
    """Return the commands of a part and when each is given; raises InputError."""
    first_ns = lead_ns + part.samples[0].t_ns
    if part.kind == TRAJECTORY:
        return commands_of(
            part.controller, part.kind, _moved(part.samples, -part.samples[0].t_ns), 0, first_ns
        )
    samples = (*_ramp(part, running, first_ns), *_moved(part.samples, lead_ns))
    return commands_of(part.controller, part.kind, samples, 0, 0)


def _moved(samples: Iterable[Sample], by_ns: int) -> tuple[Sample, ...]:
    return tuple(Sample(sample.t_ns + by_ns, sample.targets, sample.mark) for sample in samples)


def _ramp(part: _Part, running: Running, first_ns: int) -> Iterable[Sample]:
    """Yield what leads the joints to the first pose until that time: positions in small steps, or one
    position with the speed to get there."""
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
        yield Sample(0, targets, first.mark)
        return
    for at_ns in np.arange(0, first_ns, max(_RAMP_NS, first_ns // _MOST_STEPS)).tolist():
        share = at_ns / first_ns
        targets = {
            joint: structs.replace(
                target, position=running.position(joint) + share * ways[joint], velocity=None
            )
            for joint, target in known.items()
        }
        yield Sample(at_ns, targets, first.mark)
