"""Data of one joint from a log, for the fit: commands, measured samples, voltage, and usable spans.

A span is an uninterrupted time with torque, in one mode, and with known goals. It is cut into pieces, which
are simulated in parallel. The simulation of a piece starts before the part that is compared, so that the
error of its initial state has decayed.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from dxlrun import InputError
from dxlrun.tooling.records import Torque
from dxlrun_lab.identify.known_servo import Servo
from dxlrun_lab.identify.model import STEP_S, Control, Floats, PieceBatch
from dxlwire import Mode

PIECE_S = 1.0
"""Duration of the part of a piece in which simulation and measurement are compared, s"""
LEAD_S = 0.5
"""Simulated time before the compared part, s: 7 to 30 time constants of a position controller"""
_LEAST_S = 8.0
"""Shortest duration of usable data, s"""
_LEAST_MOVED = 40
"""Shortest travel of a joint from which it can be identified, ticks"""
_SLOW = 0.1
"""Speed below which a joint counts as hardly moving, rad/s, because friction is different there"""
_EVEN = 0.2
"""Relative spread of speeds below which the joint moved at one speed only"""
_SLOPE_S = 0.03
"""Half-width of the window of positions for a velocity, s"""
_VOLTAGE_S = 10.0
"""Window of the median voltage, s. Readings are seconds apart, with a resolution of 0.1 V."""

Flags = NDArray[np.bool_]


class ModeComparison(msgspec.Struct, frozen=True):
    """Pieces of the run in one mode, and the measured samples to compare their simulation with

    Arrays have shape (samples,).
    """

    pieces: PieceBatch
    """Initial states, voltages and commands, from which the pieces are simulated"""
    control: Control
    piece: NDArray[np.intp]
    """Index in `pieces` of the piece to which each sample belongs"""
    step: NDArray[np.intp]
    """Index of the simulation's grid point before the sample"""
    part: Floats
    """Position of the sample between two grid points, 0..1"""
    position: Floats
    effort: Floats
    effort_rate: Floats
    """Rate of change of the effort, 1/s. A fast change makes the effort uncertain."""
    time_s: Floats
    """Time in the run, s"""


class JointRecording(msgspec.Struct, frozen=True):
    """Usable data of one joint from a run; arrays have shape (samples,)"""

    servo: Servo
    time_s: Floats
    """Time of each sample since the first cycle's, s"""
    position: Floats
    """Measured position, rad"""
    effort: Floats
    """Measured effort: current, A, or fraction of full voltage"""
    command: Floats
    """Command in the cycle of the sample: position, rad, or duty"""
    voltage: Floats
    """Supply voltage, V, as a median over 20 s"""
    by_position: Flags
    """True if the command is a position"""
    groups: tuple[ModeComparison, ...]
    """Pieces to simulate: those in position mode, and those in PWM mode"""
    seconds: float
    """Sum of the durations of usable spans, s"""
    lost_s: float
    """Rest of the log's duration, s: no torque, lost servo, no goal, other mode, or too short a span"""

    @property
    def moved(self) -> float:
        """Difference of highest and lowest position, rad"""
        return float(np.ptp(self.position))


def measured(
    cycles: NDArray[np.void], row: int, servo: Servo, *, voltage: float | None = None
) -> JointRecording:
    """Extract the data of one joint from the cycles of a log, and cut them into pieces.

    Args:
        cycles: Records of the log.
        row: Index of the joint in the records.
        servo: Servo of the joint.
        voltage: Supply voltage in place of the measured one, V.

    Raises:
        InputError: The log has too little motion, time with torque, or voltage for an identification.
    """
    name = servo.joint
    usable = _usable(cycles, row)
    if not usable.any():
        raise InputError(
            f"{name}: never under torque with a goal position or PWM in this log; "
            "use the log of a run with commands to this joint"
        )
    volts = _voltage(cycles, row, voltage, name)
    time_s = (cycles["read_ns"] - np.maximum(cycles["age_ns"][:, row], 0)) * 1e-9
    start_s = float(time_s[0])
    time_s, sent_s = time_s - start_s, cycles["written_ns"] * 1e-9 - start_s
    position, effort = cycles["position"][:, row], cycles["effort"][:, row]
    fresh = usable & cycles["valid"][:, row].astype(np.bool_) & np.isfinite(position)
    by_position = cycles["mode"][:, row] == Mode.POSITION
    command = _commands(cycles, row, servo, sent_s, by_position)
    spans = [
        span
        for span in _spans(usable, by_position, sent_s)
        if sent_s[span.stop - 1] - sent_s[span.start] > LEAD_S
    ]
    seconds = float(sum(sent_s[span.stop - 1] - sent_s[span.start] for span in spans))
    if seconds < _LEAST_S:
        raise InputError(
            f"{name}: only {seconds:.1f} s of this log are usable (under torque, read, with a goal); "
            f"record a run of at least {_LEAST_S:g} s"
        )
    _require_motion(name, time_s[fresh], position[fresh], servo)
    run = JointRecording(
        servo=servo,
        time_s=time_s[fresh],
        position=position[fresh],
        effort=effort[fresh],
        command=command[fresh],
        voltage=volts[fresh],
        by_position=by_position[fresh],
        groups=(),
        seconds=seconds,
        lost_s=float(time_s[-1] - time_s[0]) - seconds,
    )
    sent = _SentCommands(sent_s, command, volts)
    groups = []
    for mode in (True, False):
        chosen = [span for span in spans if bool(by_position[span.start]) is mode]
        group = _compared(run, sent, chosen, servo.control(by_position=mode))
        groups += [group] if group is not None else []
    if not groups:
        raise InputError(
            f"{name}: too few samples arrived in this log; run `dxlrun analyze` to find the cause"
        )
    return replace(run, groups=tuple(groups))


class _SentCommands(NamedTuple):
    """Commands and voltages of all cycles of the log, including those without a reply"""

    time_s: Floats
    command: Floats
    voltage: Floats


def _usable(cycles: NDArray[np.void], row: int) -> Flags:
    """Return True for each cycle in which the joint has torque, position or PWM mode, and a known goal."""
    mode, torque = cycles["mode"][:, row], cycles["torque"][:, row]
    goal = np.where(mode == Mode.PWM, cycles["goal_pwm"][:, row], cycles["goal_position"][:, row])
    known = np.isin(mode, (Mode.POSITION, Mode.PWM)) & np.isin(torque, (Torque.ON, Torque.UNKNOWN))
    usable: Flags = known & np.isfinite(goal)
    return usable


def _voltage(cycles: NDArray[np.void], row: int, given: float | None, name: str) -> Floats:
    """Return the supply voltage of each cycle, V: `given`, or medians of the servo's readings around it.
    Raises InputError if the log has no reading."""
    count = len(cycles)
    if given is not None:
        return np.full(count, given)
    read: Floats = cycles["voltage"][:, row]
    known = np.flatnonzero(np.isfinite(read))
    if not len(known):
        raise InputError(
            f"{name}: this log has no supply voltage of the servo; give the voltage, such as --voltage 12, "
            "or record with the default `slow_registers`"
        )
    t = cycles["woken_ns"] * 1e-9
    t = t - t[0]
    middles = np.arange(t[0] + _VOLTAGE_S / 2, max(t[-1], t[0] + _VOLTAGE_S), _VOLTAGE_S)
    near = [known[np.abs(t[known] - middle) <= _VOLTAGE_S] for middle in middles]
    found = [
        (middle, float(np.median(read[some])))
        for middle, some in zip(middles, near, strict=True)
        if len(some)
    ]
    if not found:
        return np.full(count, float(np.median(read[known])))
    smooth: Floats = np.interp(t, *np.array(found).T)
    return smooth


def _commands(cycles: NDArray[np.void], row: int, servo: Servo, sent_s: Floats, by_position: Flags) -> Floats:
    """Return the servo's command in each cycle: position, rad, or duty. Positions are rounded to ticks, and a
    goal with a speed is converted to a ramp."""
    goals = np.array([servo.rounded(goal) for goal in cycles["goal_position"][:, row].tolist()])
    speeds = np.abs(cycles["goal_velocity"][:, row])
    if (np.isfinite(speeds) & by_position).any():
        goals = _ramped(goals, speeds, sent_s, cycles["position"][:, row])
    command: Floats = np.where(by_position, goals, cycles["goal_pwm"][:, row])
    return command


def _ramped(goals: Floats, speeds: Floats, sent_s: Floats, position: Floats) -> Floats:
    """Return the servo's internal setpoint in each cycle, rad: a ramp to the goal at the commanded speed."""
    way = np.array(goals)
    at = float("nan")
    for index in range(len(goals)):
        if not np.isfinite(goals[index]) or not np.isfinite(speeds[index]):
            at = float("nan")
            continue
        if not np.isfinite(at):
            at = float(position[index])
        ahead_s = sent_s[index + 1] - sent_s[index] if index + 1 < len(goals) else 0.0
        reach = float(speeds[index]) * float(ahead_s)
        before, at = at, at + min(max(goals[index] - at, -reach), reach)
        way[index] = (before + at) / 2  # mean of the ramp until the next cycle
    return way


def _spans(usable: Flags, by_position: Flags, sent_s: Floats) -> list[slice]:
    """Return the spans of consecutive usable cycles in one mode, as slices. A pause of the loop ends one."""
    period = float(np.median(np.diff(sent_s))) if len(sent_s) > 1 else 0.0
    broken = np.ones(len(usable) + 1, dtype=bool)
    pause = np.diff(sent_s) > max(0.1, 5 * period)
    broken[1:-1] = (usable[1:] != usable[:-1]) | (by_position[1:] != by_position[:-1]) | pause
    edges = np.flatnonzero(broken)
    return [slice(int(first), int(last)) for first, last in itertools.pairwise(edges) if usable[first]]


def _require_motion(name: str, time_s: Floats, position: Floats, servo: Servo) -> None:
    """Raise InputError if the joint hardly moved, or moved at a single speed."""
    if not len(position) or np.ptp(position) < _LEAST_MOVED * servo.tick:
        raise InputError(
            f"{name}: never moved by {_LEAST_MOVED} ticks or more in this log; "
            f"run `dxlrun identify {name}` to move it"
        )
    velocity = _slopes(time_s, position, time_s)
    moving = np.abs(velocity[np.abs(velocity) > _SLOW])
    if len(moving) < 100:
        raise InputError(
            f"{name}: hardly moved in this log (below {_SLOW:g} rad/s), so friction hides its motor; run "
            f"`dxlrun identify {name}` to move it"
        )
    if np.std(moving) < _EVEN * np.mean(moving):
        raise InputError(
            f"{name}: moved at one speed only in this log ({np.mean(moving):.2g} rad/s), so friction, "
            f"back-EMF and inertia cannot be told apart; run `dxlrun identify {name}` to vary it"
        )


def _slopes(time_s: Floats, position: Floats, at_s: Floats) -> Floats:
    """Return velocities at given times, rad/s, as differences over 60 ms."""
    before = np.interp(at_s - _SLOPE_S, time_s, position)
    after = np.interp(at_s + _SLOPE_S, time_s, position)
    slopes: Floats = (after - before) / (2 * _SLOPE_S)
    return slopes


def _compared(
    run: JointRecording, sent: _SentCommands, spans: list[slice], control: Control
) -> ModeComparison | None:
    """Cut the spans of one mode into pieces of equal length, and find the samples of each. Returns None if no
    piece has enough samples."""
    starts: list[float] = []
    for span in spans:
        first, last = float(sent.time_s[span.start]), float(sent.time_s[span.stop - 1])
        count = int((last - first - LEAD_S) / PIECE_S)
        starts += [first + index * PIECE_S for index in range(count)]
    if not starts or len(run.time_s) < 2:
        return None
    steps = round((LEAD_S + PIECE_S) / STEP_S)
    samples = [
        np.flatnonzero((run.time_s >= start + LEAD_S) & (run.time_s < start + LEAD_S + PIECE_S))
        for start in starts
    ]
    kept = [(start, some) for start, some in zip(starts, samples, strict=True) if len(some) >= 10]
    if not kept:
        return None
    begin = np.array([start for start, _ in kept])
    grid = begin + np.arange(steps)[:, None] * STEP_S
    pieces = PieceBatch(
        start_s=begin,
        steps=steps,
        voltage=np.interp(grid, sent.time_s, sent.voltage),
        position=np.interp(begin, run.time_s, run.position),
        velocity=_slopes(run.time_s, run.position, begin),
        command_s=sent.time_s[np.isfinite(sent.command)],
        command=sent.command[np.isfinite(sent.command)],
    )
    piece = np.concatenate([np.full(len(some), index) for index, (_, some) in enumerate(kept)])
    chosen = np.concatenate([some for _, some in kept])
    along = (run.time_s[chosen] - begin[piece]) / STEP_S
    step = np.minimum(along.astype(np.intp), steps - 1)
    return ModeComparison(
        pieces=pieces,
        control=control,
        piece=piece,
        step=step,
        part=along - step,
        position=run.position[chosen],
        effort=run.effort[chosen],
        effort_rate=np.abs(np.gradient(run.effort, run.time_s))[chosen],
        time_s=run.time_s[chosen],
    )
