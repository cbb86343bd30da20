"""Frames of logs for training: what observes, what acts, and the moments of an episode at a constant rate.

A frame has the values of the newest cycle that began at or before its time: states that were read in that
cycle, and the goals that were computed from them. So no frame has a state that was measured after its action.
A state without a reply is held, as the controllers held it, but not longer than HOLD_NS.

A goal of a joint without torque is its measured position, so a limp joint acts by where it is moved.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dxlrun import InputError, Log, LogReader
from dxlrun.tooling.files import suggestion
from dxlrun.tooling.records import Torque
from dxlrun_analysis.plan_excerpt import plan_of
from dxlwire import COMMAND_INTERFACES

FPS = 30
"""Frames per second unless the loop is slower: LeRobot's default for its own recordings."""
HOLD_NS = 100_000_000
"""Longest time that a state is held: so long a leader_follower follows a leader that does not reply."""
HOLD_PERIODS = 3
"""Longest time that a state is held in a slow loop, periods."""
_ROUNDING = 100
"""Part of a period by which a cycle may begin after its frame: periods are rounded to ns."""
_LEADER = "leader_follower"

Values = NDArray[np.float32]
Rows = NDArray[np.int64]


class Choice(NamedTuple):
    """Options of a data set. Joints can be named by groups; nothing is the default."""

    observation: tuple[str, ...] = ()
    """Joints that observe: all but leaders by default"""
    action: tuple[str, ...] = ()
    """Joints that act: all with goals but leaders by default"""
    fps: int | None = None
    task: str = ""


class Columns(NamedTuple):
    """Columns of the frames of a data set."""

    observation: tuple[str, ...]
    """Joints with their positions"""
    action: Mapping[str, str]
    """Command interface of each joint that acts"""
    environment: tuple[str, ...]
    """Measured efforts, `JOINT/effort`, and states of sources, `SOURCE/STATE`"""


class EpisodeFrames(NamedTuple):
    """Some consecutive frames of an episode."""

    values: Values
    """Shape (frames, columns): observation, action, environment"""
    begins: bool
    """True if an episode begins with them"""
    held: int
    """Number of frames with a value that is not of their own period"""


class Survey(NamedTuple):
    """A log, with the joints and values that its cycles have."""

    reader: LogReader
    about: Log
    heard: set[str]
    """Joints that ever replied"""
    goals: Mapping[str, set[str]]
    """Interfaces in which each joint ever had a goal"""
    measured: set[str]
    """Efforts and states of sources that were ever known"""

    @property
    def path(self) -> Path:
        """Path of the log, for messages."""
        return self.reader.path

    @property
    def leaders(self) -> set[str]:
        """Joints that a leader_follower follows."""
        return {
            read.partition("/")[0]
            for one in plan_of(self.about).loop.controllers
            if one.type == _LEADER
            for read in one.reads
        }

    def joints_of(self, names: Sequence[str]) -> list[str]:
        """Return the joints that an option names, groups as their joints."""
        groups = plan_of(self.about).groups
        return list(dict.fromkeys(joint for name in names for joint in groups.get(name, (name,))))

    def unknown_joints(self, option: str, names: Sequence[str]) -> Iterator[str]:
        """Yield a sentence for each name of an option that is neither a joint nor a group."""
        known = {*self.about.joints, *plan_of(self.about).groups}
        for name in names:
            if name not in known:
                what = f"{self.path}: {option} {name}: the robot has no joint or group of this name"
                yield f"{what}; {suggestion(name, known)}"


def survey(reader: LogReader) -> Survey:
    """Read which values the cycles of a log have. Raises LogError."""
    heard: set[str] = set()
    goals: dict[str, set[str]] = {}
    measured: set[str] = set()
    for log in reader.slices(packets=False):
        cycles, is_heard = log.cycles, log.cycles["age_ns"] >= 0
        heard |= _named(log.joints, is_heard)
        for name in COMMAND_INTERFACES:
            for joint in _named(log.joints, np.isfinite(cycles[f"goal_{name}"])):
                goals.setdefault(joint, set()).add(name)
        efforts = tuple(f"{joint}/effort" for joint in log.joints)
        measured |= _named(efforts, np.isfinite(cycles["effort"]) & is_heard)
        measured |= _named(log.header.layout.source_states, np.isfinite(cycles["source_state"]))
    return Survey(reader, reader.about, heard, goals, measured)


def _named(names: Sequence[str], known: NDArray[np.bool_]) -> set[str]:
    return {names[int(column)] for column in np.flatnonzero(known.any(axis=0))}


def columns_of(surveys: Sequence[Survey], choice: Choice) -> Columns:
    """Return the columns that all logs have.

    Raises:
        InputError: All logs of another robot or with other joints, and all joints without values.
    """
    first = surveys[0]
    _refuse([one for other in surveys[1:] for one in _differences(first, other)])
    problems = [*first.unknown_joints("--observation", choice.observation)]
    _refuse([*problems, *first.unknown_joints("--action", choice.action)])
    own = [joint for joint in first.about.joints if joint not in first.leaders]
    goals: dict[str, set[str]] = {}
    for one in surveys:
        for joint, interfaces in one.goals.items():
            goals.setdefault(joint, set()).update(interfaces)
    observation = first.joints_of(choice.observation) or own
    action = first.joints_of(choice.action) or [joint for joint in own if joint in goals]
    if not action:
        _refuse(
            [f"{one.path}: no joint had a goal; give a log of a run that moved joints" for one in surveys]
        )
    efforts = (f"{joint}/effort" for joint in observation)
    measured = set().union(*(one.measured for one in surveys))
    columns = Columns(
        tuple(observation),
        {joint: _interface(goals.get(joint, set())) for joint in action},
        tuple(one for one in (*efforts, *first.about.header.layout.source_states) if one in measured),
    )
    _refuse([problem for one in surveys for problem in _missing(one, columns)])
    return columns


def _refuse(problems: Sequence[str]) -> None:
    if problems:
        raise InputError("\n".join(problems))


def _interface(goals: set[str]) -> str:
    return next((one for one in COMMAND_INTERFACES if one in goals), COMMAND_INTERFACES[0])


def _differences(first: Survey, other: Survey) -> Iterator[str]:
    """Yield a sentence if a log is of another robot, or has other joints, than the first one."""
    ours, theirs = first.about, other.about
    fix = "give logs of one robot"
    if theirs.header.robot != ours.header.robot:
        what = f"a log of {theirs.header.robot}, but {first.path} is one of {ours.header.robot}"
        yield f"{other.path}: {what}; {fix}"
    elif theirs.joints != ours.joints:
        odd = ", ".join(sorted({*theirs.joints} ^ {*ours.joints})) or "their order"
        yield f"{other.path}: joints differ from those of {first.path}: {odd}; {fix}"


def _missing(one: Survey, columns: Columns) -> Iterator[str]:
    """Yield a sentence for the values that a log does not have."""
    fix = "omit this log, or name other joints by --observation and --action"
    if silent := [joint for joint in columns.observation if joint not in one.heard]:
        yield f"{one.path}: no reply of {', '.join(silent)}; {fix}"
    for interface in COMMAND_INTERFACES:
        acting = [joint for joint, wanted in columns.action.items() if wanted == interface]
        if idle := [joint for joint in acting if interface not in one.goals.get(joint, ())]:
            yield f"{one.path}: no {interface} goal of {', '.join(idle)}; {fix}"
    if unknown := [name for name in columns.environment if name not in one.measured]:
        yield f"{one.path}: no value of {', '.join(unknown)}, which another log has; omit this log"


class _Cycles(NamedTuple):
    """Consecutive cycles of a log, with the values of their columns."""

    values: Values
    number: Rows
    skipped: Rows
    begin_ns: Rows
    age_ns: Rows
    """Age of the oldest state in the values"""
    fresh: NDArray[np.bool_]
    """True if every state is of this cycle"""

    def following(self, before: _Cycles | None) -> _Cycles:
        """Return the cycles after the last one of some others, in which each unknown value is the last known
        one."""
        joined = self
        if before is not None:
            joined = _Cycles(
                np.concatenate((before.values[-1:], self.values)),
                np.concatenate((before.number[-1:], self.number)),
                np.concatenate((before.skipped[-1:], self.skipped)),
                np.concatenate((before.begin_ns[-1:], self.begin_ns)),
                np.concatenate((before.age_ns[-1:], self.age_ns)),
                np.concatenate((before.fresh[-1:], self.fresh)),
            )
        rows = np.where(np.isfinite(joined.values), np.arange(len(joined.values))[:, None], 0)
        np.maximum.accumulate(rows, axis=0, out=rows)
        return joined._replace(values=np.take_along_axis(joined.values, rows, axis=0))


def frames_of(one: Survey, columns: Columns, fps: int) -> Iterator[EpisodeFrames]:
    """Yield the frames of a log, slice by slice.

    An episode begins with the first cycle in which all values are known, and ends where cycles are lost, and
    where a state would be held too long: by a silent servo, a pause or skipped periods.
    """
    period_ns = one.about.period_ns
    longest_ns, rounding_ns = max(HOLD_NS, HOLD_PERIODS * period_ns), period_ns // _ROUNDING
    before: _Cycles | None = None
    origin_ns = count = 0
    for log in one.reader.slices(packets=False):
        if not len(log.cycles):
            continue
        known = before is not None
        cycles = before = _cycles_of(log, columns).following(before)
        whole = np.isfinite(cycles.values).all(axis=1) & (cycles.age_ns <= longest_ns)
        times = cycles.begin_ns
        apart = np.diff(times) > longest_ns
        apart |= np.diff(cycles.number) != cycles.skipped[1:] + 1
        apart |= whole[1:] != whole[:-1]
        cuts = [0, *(np.flatnonzero(apart) + 1).tolist(), len(times)]
        for first, end in itertools.pairwise(cuts):
            if not whole[first]:
                continue
            # The first row is of the preceding slice, whose episode continues.
            begins = not (known and first == 0)
            if begins:
                origin_ns, count = int(times[first]), 0
            last = (int(times[end - 1]) + rounding_ns - origin_ns) * fps // 10**9
            due = origin_ns + np.arange(count, last + 1, dtype=np.int64) * 10**9 // fps
            count = max(count, last + 1)
            rows = first + np.searchsorted(times[first:end], due + rounding_ns, side="right") - 1
            if len(rows):
                old = due - times[rows] >= period_ns
                yield EpisodeFrames(cycles.values[rows], begins, int(np.sum(old | ~cycles.fresh[rows])))


def _cycles_of(log: Log, columns: Columns) -> _Cycles:
    cycles, joints = log.cycles, log.joints
    observing = [joints.index(joint) for joint in columns.observation]
    acting = [joints.index(joint) for joint in columns.action]
    ages = cycles["age_ns"]
    heard = np.where(ages >= 0, 1.0, np.nan)
    values = [(cycles["position"] * heard)[:, observing]]
    values += [
        cycles[f"goal_{interface}"][:, [row]]
        for row, interface in zip(acting, columns.action.values(), strict=True)
    ]
    states = log.header.layout.source_states
    for name in columns.environment:
        joint, _, _ = name.partition("/")
        if name in states:
            values.append(cycles["source_state"][:, [states.index(name)]])
        else:
            row = joints.index(joint)
            values.append((cycles["effort"] * heard)[:, [row]])
    # A limp joint acts by its measured position.
    limp = np.isin(cycles["torque"], (Torque.OFF, Torque.RELEASED))
    counted = np.hstack((ages[:, observing], np.where(limp, ages, 0)[:, acting]))
    fresh: NDArray[np.bool_] = np.hstack(
        (cycles["valid"][:, observing], (cycles["valid"] | ~limp)[:, acting])
    )
    is_fresh: NDArray[np.bool_] = np.logical_and.reduce(fresh, axis=1)
    return _Cycles(
        np.hstack(values).astype(np.float32),
        cycles["cycle"].astype(np.int64),
        cycles["skipped"].astype(np.int64),
        cycles["scheduled_ns"].astype(np.int64),
        counted.max(axis=1),
        is_fresh,
    )
