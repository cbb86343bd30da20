"""Experiment: plays tables of goals (segments) on joints of a run, and evaluates their recordings.

At the end, the controllers, their activity and the loop rate of the run are always restored.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from functools import partial
from typing import Final, Protocol, TypeVar

import msgspec
import numpy as np

from dxlrun import DxlrunError, Refused
from dxlrun.tooling.live import RunGone
from dxlrun.tooling.plans import JointPlan, Plan
from dxlrun_lab.guided.rig import TORQUED, JointNow, Rig
from dxlrun_lab.guided.segment import Guard, Interface, Segment, SegmentRecording
from dxlwire import Mode, ServoPlan, mode_of

APPROACH_RAD_S: Final = 0.5
"""Highest speed of joints that are moved to the start of a segment, rad/s"""
_NEAR_RAD: Final = 0.005
"""Distance within which a joint counts as at its start, rad"""
_APPROACH_PERIOD_S: Final = 0.02
_PIECE_NUMBERS: Final = 2000
"""Numbers of a table in one command: 16 KiB, which gateway and loop process without being late"""
_EXTRA_S: Final = 5.0
"""Time beyond its duration after which a segment is cancelled, s"""
PLAYER: Final = "experiment"
"""Prefix of the names of the sample_players that an experiment loads; the interface follows. Two experiments
cannot run at once, because the names would be the same."""

Procedure = Generator[Segment, SegmentRecording, None]
Abort = Callable[[], str | None]
"""Function that returns the reason to abort an experiment, one sentence, or None"""
R_co = TypeVar("R_co", covariant=True)


class ExperimentJoint(msgspec.Struct, frozen=True):
    """Joint of an experiment, with its range and its start"""

    name: str
    lower: float
    """Lower end of the range, rad. The experiment ends if the joint leaves the range."""
    upper: float
    chosen: str
    """Origin of the range: `--range`, or a description"""
    start: float
    """Position before the experiment, rad"""
    plan: JointPlan
    """Plan of the joint, with its limits"""
    servos: tuple[ServoPlan, ...]
    """Servos that move the joint"""

    @property
    def servo(self) -> ServoPlan:
        """First servo of the joint"""
        return self.servos[0]

    @property
    def inner(self) -> tuple[float, float]:
        """Range for motions that may overshoot, rad: a twentieth of the width is omitted at each end."""
        margin = (self.upper - self.lower) / 20
        return self.lower + margin, self.upper - margin

    @property
    def middle(self) -> float:
        """Middle of the range, rad"""
        return (self.lower + self.upper) / 2


class Situation(msgspec.Struct, frozen=True):
    """Joints, loop rate and plan of a run before an experiment"""

    joints: tuple[ExperimentJoint, ...]
    """Joints of the experiment, in the order of the command line"""
    rate: float
    """Loop rate, Hz"""
    plan: Plan
    virtual: bool = False
    """True on virtual time, with simulated servos"""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the experiment's joints"""
        return tuple(joint.name for joint in self.joints)


class Experiment(Protocol[R_co]):
    """Protocol of an experiment that `perform_experiment` runs. A procedure can yield any number of segments.

    If the run refuses the loop rate of a segment, or a servo lacks its mode, Refused is raised inside the
    procedure, which can then yield another segment. Any other refusal ends the experiment.
    """

    def describe_motions(self, situation: Situation) -> Sequence[str]:
        """Describe distance and speed of each motion, one sentence each, for a printout before the start."""
        ...

    def procedure(self, situation: Situation) -> Procedure:
        """Yield segments. Each `yield` returns the complete recording of its segment."""
        ...

    def evaluate_recordings(
        self, situation: Situation, recorded: Sequence[SegmentRecording], why: str
    ) -> R_co:
        """Evaluate the recordings of all segments, and return the result of the experiment.

        Args:
            situation: Initial situation.
            recorded: Recordings. The last one may be incomplete if the experiment ended early.
            why: Reason for an early end, one sentence; empty on success.
        """
        ...


class ExperimentOutcome(msgspec.Struct, frozen=True):
    """Recordings of an experiment, before their evaluation"""

    recorded: tuple[SegmentRecording, ...]
    """Recording of each segment that was played; the last one may be incomplete"""
    why: str = ""
    """Reason for an early end, one sentence; empty on success"""
    not_restored: tuple[str, ...] = ()
    """State of the run that could not be restored, one sentence each"""


class _EarlyEnd(Exception):
    """Early end of an experiment, with the reason as its text"""


class _UnfitSegment(Exception):
    """Error of a segment that the run cannot play, for the reason in `refusal`"""

    def __init__(self, refusal: Refused) -> None:
        super().__init__(str(refusal))
        self.refusal = refusal


def perform_experiment(
    rig: Rig,
    experiment: Experiment[object],
    situation: Situation,
    abort: Abort = lambda: None,
    show: Callable[[Segment, int], None] = lambda segment, number: None,
    *,
    back: bool = True,
) -> ExperimentOutcome:
    """Play and record the segments of an experiment, and always restore the run. Nothing is evaluated.

    Args:
        rig: Run of the experiment.
        experiment: Experiment.
        situation: Initial situation.
        abort: Function that returns a reason to abort.
        show: Called with each segment before it starts, and its number (from 1).
        back: Move the joints back to their start at the end.
    """
    stage = _Stage(rig, situation, abort)
    recorded: list[SegmentRecording] = []
    why = ""
    problems: tuple[str, ...] = ()
    try:
        _play_all(stage, experiment.procedure(situation), recorded, show)
        if back:
            stage.go_back()
    except _EarlyEnd as ended:
        why = str(ended)
    except DxlrunError as error:
        why = " ".join(error.sentences)
    finally:
        problems = stage.restore()
    return ExperimentOutcome(tuple(recorded), why, problems)


def _play_all(
    stage: _Stage,
    procedure: Procedure,
    recorded: list[SegmentRecording],
    show: Callable[[Segment, int], None],
) -> None:
    segment = next(procedure, None)
    while segment is not None:
        show(segment, len(recorded) + 1)
        try:
            try:
                stage.prepare_segment(segment)
            except _UnfitSegment as unfit:
                segment = procedure.throw(unfit.refusal)
                continue
            part = stage.play_segment(segment)
            recorded.append(part)
            if not part.whole:
                raise _EarlyEnd(part.text)
            segment = procedure.send(part)
        except StopIteration:
            return


class _Stage:
    """Run during an experiment: moves its joints by sample_player controllers, and restores it at the end"""

    def __init__(self, rig: Rig, situation: Situation, abort: Abort) -> None:
        self.rig, self.situation, self.abort = rig, situation, abort
        names = set(situation.names)
        self._rate = rig.rate
        """Loop rate before the experiment, Hz"""
        self._active = [one.name for one in rig.controllers() if one.active and names & set(one.joints)]
        """Controllers of the experiment's joints that were active before"""
        self._players: dict[tuple[Interface, Guard], str] = {}
        """Names of loaded sample_players by interface and guard"""
        self._player = ""
        """Name of the active sample_player; empty before the first"""

    # Forward

    def prepare_segment(self, segment: Segment) -> None:
        """Prepare a segment: move the joints to its start, set the loop rate, and activate its sample_player.

        Raises:
            _Unfit: The run refuses the loop rate, or a servo lacks the mode.
            _Ended: The user aborted, a joint has no torque, or the way to the start failed.
        """
        self._check()
        self._check_modes(segment.interface)
        start = dict(segment.begin)
        if segment.interface in ("position", "posvel"):
            start |= {joint: float(values[0]) for joint, values in segment.rows.items() if joint not in start}
        self._approach(start)
        self._check()
        rate = segment.loop_rate or self._rate
        if not math.isclose(rate, self.rig.rate, rel_tol=1e-9):
            try:
                self.rig.change_rate(rate)
            except Refused as refusal:
                raise _UnfitSegment(refusal) from refusal
        self._activate(segment.interface, segment.guard)

    def play_segment(self, segment: Segment) -> SegmentRecording:
        """Play a prepared segment to its end or an abort, and return its recording."""
        names = self.situation.names
        plan_joints = [joint.name for joint in self.situation.plan.loop.joints]
        goal = self._send(segment)
        outcome, text = "lost", ""
        try:
            outcome, text = self.rig.wait_for_goal(
                goal, self._find_abort_reason, segment.duration_s + _EXTRA_S
            )
            if outcome != "reached":
                # A goal that the runtime ended has no text, but the state of its joint may have the reason.
                text = self._find_abort_reason() or text or f"playback of the segment was {outcome}"
        except RunGone as gone:
            text = str(gone)
        cycles = self.rig.recorded(goal)
        columns = tuple(plan_joints.index(name) for name in names)
        return SegmentRecording(names, cycles, columns, segment, outcome, text)

    def go_back(self) -> None:
        """Move the joints back to their positions before the experiment."""
        if self._players:
            self._approach({joint.name: joint.start for joint in self.situation.joints})

    def _approach(self, places: Mapping[str, float]) -> None:
        """Move joints slowly to positions, from rest to rest."""
        now = self.rig.joints()
        far = {name: place for name, place in places.items() if abs(_place(now, name) - place) > _NEAR_RAD}
        if not far:
            return
        self._activate("position", Guard())
        now = self.rig.joints()
        limits = {joint.name: joint.plan.highest_speed for joint in self.situation.joints}
        speeds = {name: min(APPROACH_RAD_S, limits[name] / 2) for name in far}
        # The peak speed of a cubic from rest to rest is 1.5 times its mean speed.
        longest_s = max(1.5 * abs(place - _place(now, name)) / speeds[name] for name, place in far.items())
        part = np.linspace(0.0, 1.0, max(2, math.ceil(longest_s / _APPROACH_PERIOD_S) + 1))
        shape = part * part * (3 - 2 * part)
        rows = {name: _place(now, name) + (place - _place(now, name)) * shape for name, place in far.items()}
        segment = Segment("approach", _APPROACH_PERIOD_S, rows, settle_s=0.2)
        goal = self._send(segment)
        outcome, text = self.rig.wait_for_goal(goal, self._find_abort_reason, segment.duration_s + _EXTRA_S)
        if outcome != "reached":
            raise _EarlyEnd(text or f"the approach motion was {outcome}")

    def _send(self, segment: Segment) -> int:
        """Send a segment's table to the active sample_player, in pieces that fit into a cycle. Returns the
        number of the goal that plays it."""
        joints = self.situation.names
        now = self.rig.joints()
        still = 0.0
        columns = []
        for name in joints:
            if segment.interface in ("position", "posvel"):
                still = _place(now, name)
            columns.append(segment.rows.get(name, np.full(segment.count, still)))
        if segment.interface == "posvel":
            slow = np.full(segment.count, APPROACH_RAD_S)
            columns += [segment.speeds.get(name, slow) for name in joints]
        table = np.stack(columns, axis=1)
        size = max(1, _PIECE_NUMBERS // table.shape[1])
        pieces = [table[at : at + size].tolist() for at in range(0, len(table), size)]
        for piece in pieces[:-1]:
            self.rig.send_command(self._player, "rows", {"rows": piece})
        # The motion of the joints is the measurement, so no distance from the last row is a failure.
        last = {
            "period": segment.period_s,
            "settle": segment.settle_s,
            "tolerance": "inf",
            "rows": pieces[-1],
        }
        return self.rig.send_command(self._player, "samples", last)

    def _activate(self, interface: Interface, guard: Guard) -> None:
        """Activate the sample_player of an interface and a guard in place of the active controllers. It is
        loaded if necessary."""
        name = self._players.get((interface, guard))
        if name is not None and name == self._player:
            return
        if name is None:
            number = len(self._players)
            name = f"{PLAYER}_{interface}" + (f"_{number}" if number else "")
            self.rig.load_controller(name, self._entry(interface, guard))
            self._players[interface, guard] = name
        leaving = [self._player] if self._player else self._active
        self.rig.switch([name], leaving)
        self._player = name

    def _entry(self, interface: Interface, guard: Guard) -> dict[str, object]:
        bounds: dict[str, object] = {
            "range": {
                joint.name: [f"{joint.lower!r} rad", f"{joint.upper!r} rad"]
                for joint in self.situation.joints
            }
        }
        if guard.temperature is not None:
            bounds["temperature"] = guard.temperature
        if guard.effort is not None:
            bounds["effort"] = guard.effort
        if guard.age_s is not None:
            bounds["age"] = f"{guard.age_s!r} s"
        joints = list(self.situation.names)
        return {"type": "sample_player", "joints": joints, "command_interface": interface, "bounds": bounds}

    def _check_modes(self, interface: Interface) -> None:
        mode = Mode.POSITION if interface == "posvel" else mode_of([interface])
        for joint in self.situation.joints:
            without = [each for each in joint.servos if mode not in [plan.mode for plan in each.modes]]
            if without:
                text = f"joint {joint.plan.label} has no {interface} mode: {without[0].model} lacks the mode"
                raise _UnfitSegment(Refused(text, code="no_mode"))

    # What ends it early

    def _check(self) -> None:
        why = self._find_abort_reason()
        if why is not None:
            raise _EarlyEnd(why)

    def _find_abort_reason(self) -> str | None:
        """Return the reason to end the experiment: an abort, or a joint without torque."""
        why = self.abort()
        if why is not None:
            return why
        now = self.rig.joints()
        for joint in self.situation.joints:
            torque = now[joint.name].torque
            if torque not in TORQUED:
                return f"joint {joint.plan.label} is {torque}"
        return None

    # Back

    def restore(self) -> tuple[str, ...]:
        """Restore controllers and loop rate of the run. Return a sentence for each failure; raise nothing."""
        problems: list[str] = []
        try:
            for step in self._steps_back():
                try:
                    step()
                except RunGone:
                    raise
                except DxlrunError as error:
                    problems += error.sentences
        except RunGone as gone:
            problems.append(f"{gone}, so the run was not restored")
        return tuple(dict.fromkeys(problems))

    def _steps_back(self) -> Iterator[Callable[[], None]]:
        """Yield functions that restore the run in turn. A step that fails does not prevent the next ones."""
        now = {one.name: one for one in self.rig.controllers()}
        ours = [name for name in self._players.values() if name in now and now[name].active]
        missing = [name for name in self._active if name in now and not now[name].active]
        if ours or missing:
            try:
                self.rig.switch(missing, ours)
            except Refused:  # one controller blocks the whole switch, so switch them one by one
                if ours:
                    yield partial(self.rig.switch, [], ours)
                yield from (partial(self.rig.switch, [name], []) for name in missing)
        if not math.isclose(self.rig.rate, self._rate, rel_tol=1e-9):
            yield partial(self.rig.change_rate, self._rate)
        yield from (partial(self.rig.unload_controller, name) for name in self._players.values())


def _place(now: Mapping[str, JointNow], name: str) -> float:
    """Return the last goal position of a joint, or else its measured position, rad."""
    joint = now[name]
    return joint.position if math.isnan(joint.goal_position) else joint.goal_position
