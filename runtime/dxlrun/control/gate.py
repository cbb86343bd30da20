"""Gate: the last hand on every command before it becomes a goal. Its law is `gate.c`."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from ctypes import c_int64, c_void_p
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from dxlrun.channels.cycle import Clamp, CycleRecord, Floats
from dxlrun.channels.events import EventCode, EventSink, Severity
from dxlrun.plan.loop_plan import JointPlan, LimitedInterface, LoopPlan, ServoLimit
from dxlrun.plan.policy_plan import SLOW_SPEED, SLOW_START_NS
from dxlwire.compiled import load_compiled, parse_structs
from dxlwire.modes import Mode

SOURCE = Path(__file__).with_name("gate.c")
STRUCTS = parse_structs(SOURCE.read_text())
BRAKING = 10.0
"""rad/s^2, at which a joint that follows efforts brakes toward a limit, unless its acceleration limit is
higher: what an XM430 of 1.2 A does with 0.2 kg m^2. A heavier one begins too late. [i]"""
LEAST_BAND = 1.0
"""rad/s; a joint that is so much too fast is braked with all its effort, or more by `brake`. [i]"""
BACK_SPEED = 0.5
"""rad/s; a joint that went beyond a limit goes back to it no faster, as ENGAGE_SPEED of `servo/modes.py`."""
_WHAT = {
    Clamp.LOWER: "raised to the lower position limit",
    Clamp.UPPER: "lowered to the upper position limit",
    Clamp.STEP: "held to the step or acceleration limit",
    Clamp.VELOCITY: "held to the velocity limit",
    Clamp.NOT_FINITE: "was not finite, the last goal is kept",
    Clamp.EFFORT: "held to the effort limit",
    Clamp.PWM: "held to the full voltage",
    Clamp.OUTWARD: "led out of the position limits",
}
_LIMITED: Mapping[Clamp, LimitedInterface] = {
    Clamp.VELOCITY: "velocity",
    Clamp.EFFORT: "effort",
    Clamp.PWM: "pwm",
}
"""Clamps by a limit that a register of the servo may be tighter than."""
CLAMP_ENDS_NS = 1_000_000_000
"""A clamp that pauses for less goes on: a joint that is pressed against a limit swings there. [i]"""
_NEUTRAL = {Mode.VELOCITY: "velocity", Mode.EFFORT: "effort", Mode.PWM: "pwm"}
"""The goal that is 0 where a joint in this mode shall not move by its own."""


@dataclass(slots=True)
class _Clamped:
    """One clamp of one joint, since it was reported."""

    what: str
    begun_ns: int
    last_ns: int
    """Newest cycle in which it was done."""


class Gate:
    """Turns merged commands into goals that are finite, inside the limits, and near the last goal.

    Each joint by the mode that it is in; one whose mode is not known has goals of NaN. Positions:

    - A position of NaN was not commanded: the last goal, position and speed, is kept. Infinity too, and is
      flagged.
    - Positions are clamped to the joint's limits. A goal that starts outside of them (the present position of
      a joint that hangs there) may stay or move toward them, never further out.
    - The step from the last goal is at most `limits.velocity * dt`, which is the servo's top speed where the
      file gives none, and at most SLOW_SPEED * dt in the first second after `ease_in`, and after the goal
      moves for the first time since `anchor`.
    - With `limits.acceleration` the step changes by at most `acceleration * dt^2` from cycle to cycle, also
      when commands are withdrawn. It is never so long that the goal could not stop at the limit.
    - The commanded speed is taken as a magnitude and clamped to `limits.velocity` and the servo's top speed.
      Where none is commanded, a limit of the steps that is lower than the servo's top speed is the goal's
      speed too, as the servo takes a step as fast as it may, however long the cycle is; else NaN stays NaN:
      as fast as the servo can. No speed outlives the command that it came with.
    - A goal outside of the limits has a speed of at most BACK_SPEED: its servo is sent to the limit.
    - A joint without torque that is not commanded has the position where it stands.

    Velocities, efforts and PWM:

    - NaN was not commanded, and infinity is flagged: the goal is 0 then. A joint without a position to hold
      goes nowhere by itself when it is not commanded any more.
    - Velocities are cut to the speed that positions have, efforts to `limits.effort`, PWM to full voltage;
      all of them to what the servo has, and to its own registers: see `take_servo_limits`.
    - With `limits.acceleration` a velocity changes by at most `acceleration * dt` a cycle, also when it is
      not commanded any more; faster only at a position limit, for a joint that did not follow its goals.
    - Within position limits: a velocity that leads outward becomes smaller toward the limit and is 0 there,
      in proportion to what is left, and with an acceleration limit so that it can brake; an effort or a PWM
      becomes smaller, and pulls back against a joint that is too fast to stop at the limit, whatever is
      commanded. Where the position is not known, each of them is 0. A wheel (a joint that is not `bounded`)
      has none of this.
    - In mode EFFORT_POSITION the effort is a limit: its magnitude counts, NaN keeps the last one.

    `record.clamped` has what was done, bits of Clamp; an event reports when it begins, and one when it has
    ended. `counts`, shape (joints, 8), counts cycles by joint and bit.
    """

    def __init__(self, plan: LoopPlan, record: CycleRecord, events: EventSink) -> None:
        count = len(plan.joints)
        self._plan = plan
        self._limited = plan.joints
        """The joints with the registers that limit their servos."""
        self._record = record
        self._events = events
        self._sources = SourceGate(plan, record, events)
        self._joints = _laid_out(plan.joints)
        self.counts: NDArray[np.int64] = self._joints["counts"]
        self._begun, self._before = np.zeros((2, count), dtype=np.uint8)
        self._now_ns = 0  # Sum of the times between cycles
        self._clamps: dict[tuple[Clamp, int], _Clamped] = {}
        """What was reported to have begun and not to have ended, by bit and row."""
        states, commands, goals = record.states, record.commands, record.goals
        self._gate = STRUCTS["Gate"](
            joints=self._joints.ctypes.data,
            commands=tuple(row.ctypes.data for row in commands.values),
            goals=tuple(row.ctypes.data for row in goals.values),
            position=states.position.ctypes.data,
            velocity=states.velocity.ctypes.data,
            torque=states.torque.ctypes.data,
            clamped=record.clamped.ctypes.data,
            begun=self._begun.ctypes.data,
            before=self._before.ctypes.data,
            count=count,
            accelerates=any(joint.acceleration is not None for joint in plan.joints),
        )
        self._law = load_compiled(SOURCE, ctypes.PyDLL).gate_apply
        self._law.argtypes = (c_void_p, c_int64)
        self._address = ctypes.addressof(self._gate)
        self.modes = b""
        """The joints' modes, as they were entered last."""
        self._take_modes()

    def take_servo_limits(self, limits: Mapping[int, Sequence[ServoLimit]]) -> None:
        """Hold goals to the registers of the servos, too, as read at the start and of a servo that returned.

        A servo refuses a goal beyond its register as a whole. One event for each joint whose limits changed
        has them as data, for a replay; it is a warning where a register is tighter than the file's limit.

        Args:
            limits: by row of the joint.
        """
        joints = list(self._limited)
        for row, found in sorted(limits.items()):
            before, joint = joints[row], replace(joints[row], servo_limits=tuple(found))
            joints[row] = joint
            binding = joint.binding_servo_limits
            if joint.servo_limits == before.servo_limits or not (binding or before.binding_servo_limits):
                continue
            warns = any(joint.exceeds_file_limit(own.interface) for own in binding)
            severity = Severity.WARNING if warns else Severity.INFO
            data = msgspec.json.encode(joint.servo_limits)
            text = "; ".join(joint.describe_servo_limit(own) for own in binding)
            text = text or "registers of its servo no longer limit goals"
            self._events.emit(EventCode.SERVO_LIMITS, severity, joint.name, f"{joint.label}: {text}", data)
        self._limited = tuple(joints)
        for name, values in _speeds_and_efforts(joints).items():
            self._joints[name] = values

    def begin(self) -> None:
        """Take the joints' modes and goals as they are: they belong together, and the goals are at rest."""
        self._take_modes()
        self._rest(np.ones(len(self._joints), dtype=np.bool_))

    def _take_modes(self) -> None:
        self._joints["mode"] = self._record.states.mode
        self._joints["fence"] = np.inf
        self.modes = self._record.states.mode.tobytes()

    def _rest(self, rows: NDArray[np.bool_]) -> None:
        """Take the goals of these joints as at rest."""
        self._joints["moving"][rows] = 0.0
        for known in ("target", "left"):
            self._joints[known][rows] = self._record.goals.position[rows]

    def enter_modes(self) -> None:
        """Give the joints whose mode has changed goals that move nothing in the new one; after a read.

        They follow their next commands slowly.
        """
        changed = self._record.states.mode != self._joints["mode"]
        self._take_modes()
        self._hold_still(changed)

    def anchor(self, rows: NDArray[np.bool_]) -> None:
        """Give joints goals that move nothing; the first second after they move again is slow.

        `rows`: shape (joints,).
        """
        self._hold_still(rows)
        self._joints["anchored"][rows] = np.nan_to_num(self._record.goals.position[rows])

    def _hold_still(self, rows: NDArray[np.bool_]) -> None:
        """Give these joints goals at rest: the measured position, or 0, by their mode."""
        states, goals = self._record.states, self._record.goals
        goals.values[:, rows] = np.nan
        led = np.isin(states.mode, (Mode.POSITION, Mode.EFFORT_POSITION))
        np.copyto(goals.position, states.position, where=rows & led)
        for mode, interface in _NEUTRAL.items():
            getattr(goals, interface)[rows & (states.mode == mode)] = 0.0
        self._rest(rows)
        self.ease_in(np.flatnonzero(rows).tolist())

    def ease_in(self, rows: Sequence[int] | None = None) -> None:
        """Limit the steps of the coming second to SLOW_SPEED, of all joints or of these rows.

        Torque was just switched on, or the joints were not commanded for a while.
        """
        self._joints["slow_ns"][slice(None) if rows is None else list(rows)] = SLOW_START_NS

    def apply(self, dt_ns: int) -> None:
        """Move the goals toward the commands in place; `dt_ns` is the time since the cycle before."""
        self._now_ns += dt_ns
        if self._law(self._address, dt_ns):
            self._report_begun()
        if self._clamps:
            self._report_ended()
        if self._sources.commands.size:
            self._sources.apply()

    def _report_begun(self) -> None:
        for bit, what in _WHAT.items():
            for row in np.flatnonzero(self._begun & np.uint8(bit)).tolist():
                if (bit, row) in self._clamps:
                    continue
                name = self._plan.joints[row].name
                # what commands it now may stand in for the controller whose fault this is, which has an event
                by = "" if bit is Clamp.NOT_FINITE else f", {self._owner(name)}"
                own = self._limited[row].find_servo_limit(_LIMITED[bit]) if bit in _LIMITED else None
                what_by = f"clamped by register {own.text}" if own else what
                self._clamps[bit, row] = _Clamped(what_by, self._now_ns, self._now_ns)
                self._events.emit(EventCode.GATE, Severity.WARNING, name, f"{name}{by}: {what_by}")

    def _report_ended(self) -> None:
        for (bit, row), clamped in tuple(self._clamps.items()):
            if self._record.clamped[row] & bit:
                clamped.last_ns = self._now_ns
            elif self._now_ns - clamped.last_ns >= CLAMP_ENDS_NS:
                del self._clamps[bit, row]
                name, lasted_s = self._plan.joints[row].name, (clamped.last_ns - clamped.begun_ns) * 1e-9
                text = f"{name}: {clamped.what}; this ended after {lasted_s:.1f} s"
                self._events.emit(EventCode.GATE, Severity.INFO, name, text)

    def _owner(self, joint: str) -> str:
        """Return the controller that commands a servo, with those above it that command its references."""
        active = self._record.active
        plans = [plan for index, plan in enumerate(self._plan.controllers) if active >> index & 1]
        for plan in plans:
            if plan.commands_servos and joint in plan.joints:
                uppers = [one.name for one in plans if plan.name in one.into and joint in one.joints]
                by = f", commanded by {' and '.join(uppers)}" if uppers else ""
                return f"controller {plan.name}{by}"
        return "no controller"


def _speeds_and_efforts(joints: Sequence[JointPlan]) -> Mapping[str, Sequence[float]]:
    """Return the fields of gate.c that registers of the servos may lower."""
    return {
        "speed": [joint.step_speed for joint in joints],
        "highest_speed": [joint.highest_speed for joint in joints],
        "effort": [joint.highest_effort for joint in joints],
        "pwm": [joint.highest_pwm for joint in joints],
    }


def _laid_out(joints: Sequence[JointPlan]) -> NDArray[np.void]:
    """Return the structs of gate.c for the joints, which begin slowly."""
    laid: NDArray[np.void] = np.zeros(len(joints), dtype=np.dtype(STRUCTS["Joint"]))
    # what a speed of 1 rad/s is for each joint: for a linear one as many m/s as its slow start is
    share = np.array([joint.slow_speed / SLOW_SPEED for joint in joints])
    acceleration = _limits([joint.acceleration for joint in joints])
    for name, values in {
        "lower": [joint.lower for joint in joints],
        "upper": [joint.upper for joint in joints],
        "bounded": [joint.bounded for joint in joints],
        **_speeds_and_efforts(joints),
        "own_speed": _limits([joint.top_speed for joint in joints]),
        "slow_speed": [joint.slow_speed for joint in joints],
        "acceleration": acceleration,
        "back_speed": BACK_SPEED * share,
        "least_band": LEAST_BAND * share,
        "brakes_at": np.fmax(BRAKING * share, np.where(np.isfinite(acceleration), acceleration, 0.0)),
        "slow_ns": SLOW_START_NS,
        "anchored": np.nan,
    }.items():
        laid[name] = values
    return laid


def _limits(limits: Sequence[float | None]) -> Floats:
    return np.array([np.inf if limit is None else limit for limit in limits])


class SourceGate:
    """Keeps the commands of sources inside their ranges; NaN was not commanded and stays."""

    def __init__(self, plan: LoopPlan, record: CycleRecord, events: EventSink) -> None:
        ranges = [each for source in plan.sources for each in source.ranges]
        self._names = [(source, name) for source in plan.sources for name in source.commands]
        self._lowest, self._highest = np.array(ranges, dtype=np.float64).reshape(-1, 2).T
        self._events = events
        self.commands: Floats = record.source_commands
        """Of the robot's sources."""
        self._outside = np.zeros(len(ranges), dtype=np.bool_)
        self._held = np.zeros(len(ranges), dtype=np.bool_)
        """What is at an end of its range because it was commanded beyond."""

    def apply(self) -> None:
        """Clamp in place; an event reports when it begins."""
        commands, outside, held = self.commands, self._outside, self._held
        at_end = (commands == self._lowest) | (commands == self._highest)
        np.logical_or(commands < self._lowest, commands > self._highest, out=outside)
        if np.count_nonzero(outside):
            for index in np.flatnonzero(outside & ~held).tolist():
                source, name = self._names[index]
                ends = f"{self._lowest[index]:.6g}..{self._highest[index]:.6g}"
                text = f"{source.label}: {name} was commanded {commands[index]:.6g}, held to {ends}"
                self._events.emit(EventCode.GATE, Severity.WARNING, source.name, text)
            np.copyto(commands, np.clip(commands, self._lowest, self._highest), where=outside)
        # what does not change is not commanded anew, so it is still held
        np.logical_or(outside, held & at_end, out=held)
