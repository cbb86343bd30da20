"""Gate: limit the controllers' commands and turn them into the servos' goals.

`gate.c` has the computation.
"""

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
from dxlrun.channels.event_records import CommandOutside, EventSink
from dxlrun.control import texts
from dxlrun.plan.loop_plan import JointPlan, LimitedInterface, LoopPlan, ServoLimit
from dxlrun.plan.policy_plan import SLOW_SPEED, SLOW_START_NS
from dxlwire.compiled import load_compiled, parse_structs
from dxlwire.modes import Mode

SOURCE = Path(__file__).with_name("gate.c")
STRUCTS = parse_structs(SOURCE.read_text())
BRAKING = 10.0
"""Deceleration toward a position limit in effort and PWM modes, rad/s^2. A higher acceleration limit replaces
it. An XM430 at 1.2 A reaches this with 0.2 kg m^2. A heavier joint brakes too late. [i]"""
LEAST_BAND = 1.0
"""Smallest excess over the permitted speed near a limit, rad/s, that is braked with full effort; `brake` in
gate.c may widen this band. [i]
"""
BACK_SPEED = 0.5
"""Highest speed of a joint that returns from beyond a position limit, rad/s; same as ENGAGE_SPEED of
`servo/modes.py`.
"""
_WHAT = {
    Clamp.LOWER: "raised to the lower position limit",
    Clamp.UPPER: "lowered to the upper position limit",
    Clamp.STEP: "held to the step or acceleration limit",
    Clamp.VELOCITY: "held to the velocity limit",
    Clamp.NOT_FINITE: "not finite; the last goal is kept",
    Clamp.EFFORT: "held to the effort limit",
    Clamp.PWM: "held to the full voltage",
    Clamp.OUTWARD: "stopped at the position limit",
}
_POSITION_LIMITS = (Clamp.LOWER, Clamp.UPPER)
_LIMITED: Mapping[Clamp, LimitedInterface] = {
    Clamp.VELOCITY: "velocity",
    Clamp.EFFORT: "effort",
    Clamp.PWM: "pwm",
}
"""Clamps whose limit a register of the servo may tighten, with the command interface of that register."""
CLAMP_ENDS_NS = 1_000_000_000
"""Time without a clamp after which its end is reported. A joint pressed against a limit oscillates there.
[i]"""
_NEUTRAL = {Mode.VELOCITY: "velocity", Mode.EFFORT: "effort", Mode.PWM: "pwm"}
"""Command interface whose goal is set to 0 to keep a joint in this mode at rest."""


@dataclass(slots=True)
class _ReportedClamp:
    """A clamp of one joint whose begin was reported in an event and whose end was not."""

    what: str
    begun_ns: int
    last_ns: int
    """Time of the newest cycle in which the clamp was active."""


class Gate:
    """Converts merged commands to goals that are finite, inside the limits, and near the last goal.

    The mode of each joint decides which goals it gets. A joint whose mode is not known has goals of NaN.

    Positions:

    - NaN means "not commanded" and keeps the last goal, position and speed. Infinity does the same and is
      flagged.
    - Positions are clamped to the joint's limits. A goal that starts outside of them, at the measured
      position of a joint that hangs there, may stay or move toward the limits. It never moves further out.
    - The step from the last goal is at most `limits.velocity * dt`. Without that limit in the file, the
      servo's top speed applies. The step is at most SLOW_SPEED * dt in the first second after `ease_in`, and
      in the first second in which the goal moves after `anchor`.
    - With `limits.acceleration`, the step changes by at most `acceleration * dt^2` from cycle to cycle, also
      when commands are withdrawn. It is always short enough for the goal to stop at the limit.
    - The magnitude of the commanded speed is clamped to `limits.velocity` and the servo's top speed. If no
      speed is commanded and the step limit is below the servo's top speed, the goal gets that limit as its
      speed, because a servo executes a step as fast as it may, even in a long cycle. Otherwise NaN stays NaN:
      the servo's top speed. A speed is valid only together with the command that it came with.
    - A goal outside of the limits has a speed of at most BACK_SPEED, because the servo returns to the limit.
    - A joint without torque has its measured position as the goal.

    Velocities, efforts and PWM:

    - The goal is 0 for NaN, which means "not commanded", and for infinity, which is flagged. A joint without
      a position to hold must not move without commands.
    - Velocities are clamped to the speed limit of positions, efforts to `limits.effort`, PWM to full voltage.
      The limits and registers of the servo apply to all of them: see `take_servo_limits`.
    - With `limits.acceleration`, a velocity changes by at most `acceleration * dt` a cycle, also after the
      last command. It changes faster only near a position limit, for a joint that lags its goals.
    - Near a position limit, an outward velocity decreases in proportion to the remaining distance and is 0 at
      the limit; with an acceleration limit, it decreases so that the joint can brake. An outward effort or
      PWM decreases too, and is reversed if the joint is too fast to stop at the limit. If the position is
      not known, these goals are 0. A wheel (a joint that is not `bounded`) has no position limits.
    - In mode EFFORT_POSITION the magnitude of the effort is a limit. NaN keeps the last one.

    `record.clamped` has the clamps of the cycle, as bits of Clamp. Events report the begin and the end of a
    clamp. `counts`, shape (joints, 8), counts cycles by joint and bit.
    """

    def __init__(self, plan: LoopPlan, record: CycleRecord, events: EventSink) -> None:
        count = len(plan.joints)
        self._plan = plan
        self._limited = plan.joints
        """Plans of the joints, with the limits from the registers of their servos."""
        self._record = record
        self._events = events
        self._sources = SourceGate(plan, record, events)
        self._joints = _laid_out(plan.joints)
        self.counts: NDArray[np.int64] = self._joints["counts"]
        self._begun, self._before = np.zeros((2, count), dtype=np.uint8)
        self._outside: dict[int, tuple[float, float]] = {}
        """Farthest position command outside of the limits, by row: distance from them, and command."""
        self._now_ns = 0  # Sum of the times between cycles
        self._clamps: dict[tuple[int, int], _ReportedClamp] = {}
        """Clamps whose begin was reported and whose end was not, by clamp bit and row of the joint."""
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
        """Modes of the joints, as bytes of `states.mode`, that the gate last set its goals for."""
        self._take_modes()

    def take_servo_limits(self, limits: Mapping[int, Sequence[ServoLimit]]) -> None:
        """Apply the limits in the registers of the servos, as read at start-up and after a servo returned.

        A servo rejects a goal beyond its register as a whole instead of clamping it. An event reports each
        joint whose limits changed, with the limits as data for a replay. It is a warning if a register is
        tighter than the file's limit.

        Args:
            limits: Limits by row of the joint.
        """
        joints = list(self._limited)
        for row, found in sorted(limits.items()):
            before, joint = joints[row], replace(joints[row], servo_limits=tuple(found))
            joints[row] = joint
            binding = joint.binding_servo_limits
            if joint.servo_limits == before.servo_limits or not (binding or before.binding_servo_limits):
                continue
            warns = any(joint.exceeds_file_limit(own.interface) for own in binding)
            text = texts.servo_limits_tighter_than_file if warns else texts.servo_limits_found
            described = "; ".join(joint.describe_servo_limit(own) for own in binding)
            event = text(joint.label, described) if binding else texts.servo_limits_gone(joint.label)
            self._events.emit_event(joint.name, event, msgspec.json.encode(joint.servo_limits))
        self._limited = tuple(joints)
        for name, values in _speeds_and_efforts(joints).items():
            self._joints[name] = values

    def initialize_goals(self) -> None:
        """Take over the modes and goals in the record as the starting point, before the first cycle.

        The goals must match the modes and be at rest.
        """
        self._take_modes()
        self._rest(np.ones(len(self._joints), dtype=np.bool_))

    def _take_modes(self) -> None:
        self._joints["mode"] = self._record.states.mode
        self._joints["fence"] = np.inf
        self.modes = self._record.states.mode.tobytes()

    def _rest(self, rows: NDArray[np.bool_]) -> None:
        """Mark the current goals of these joints as at rest: no speed, no remaining target."""
        self._joints["moving"][rows] = 0.0
        for known in ("target", "left"):
            self._joints[known][rows] = self._record.goals.position[rows]

    def enter_modes(self) -> None:
        """Hold joints whose mode has changed: goal at the measured position, or 0 velocity, effort or PWM.

        Called after a read. These joints follow their next commands with a slow start.
        """
        changed = self._record.states.mode != self._joints["mode"]
        self._take_modes()
        self._hold_still(changed)

    def anchor(self, rows: NDArray[np.bool_]) -> None:
        """Hold joints at their measured positions. Their slow start begins when their goals move again.

        Args:
            rows: Mask of the joints, shape (joints,).
        """
        self._hold_still(rows)
        self._joints["anchored"][rows] = np.nan_to_num(self._record.goals.position[rows])

    def _hold_still(self, rows: NDArray[np.bool_]) -> None:
        """Set the goals of these joints to the measured position or 0, depending on their modes."""
        states, goals = self._record.states, self._record.goals
        goals.values[:, rows] = np.nan
        led = np.isin(states.mode, (Mode.POSITION, Mode.EFFORT_POSITION))
        np.copyto(goals.position, states.position, where=rows & led)
        for mode, interface in _NEUTRAL.items():
            getattr(goals, interface)[rows & (states.mode == mode)] = 0.0
        self._rest(rows)
        self.ease_in(np.flatnonzero(rows).tolist())

    def ease_in(self, rows: Sequence[int] | None = None) -> None:
        """Limit the goal speed of joints to SLOW_SPEED for the next second.

        Called when torque was just enabled, or after a time without commands.

        Args:
            rows: Rows of the joints; None: all joints.
        """
        self._joints["slow_ns"][slice(None) if rows is None else list(rows)] = SLOW_START_NS

    def move_goals(self, dt_ns: int) -> None:
        """Move the goals in the record toward the commands, within all limits, and report clamps.

        Called each cycle.

        Args:
            dt_ns: Time since the previous cycle.
        """
        self._now_ns += dt_ns
        if self._law(self._address, dt_ns):
            self._report_begun()
        if self._clamps:
            self._report_ended()
        if self._sources.commands.size:
            self._sources.clamp_commands()

    def _report_begun(self) -> None:
        for bit, what in _WHAT.items():
            for row in np.flatnonzero(self._begun & np.uint8(bit)).tolist():
                if (bit.value, row) in self._clamps:
                    continue
                name = self._plan.joints[row].name
                # A fallback may command the joint by now. The fault's own event names the controller.
                owner = "" if bit is Clamp.NOT_FINITE else self._owner(name)
                own = self._limited[row].find_servo_limit(_LIMITED[bit]) if bit in _LIMITED else None
                what_by = f"clamped by register {own.text}" if own else what
                self._clamps[bit.value, row] = _ReportedClamp(what_by, self._now_ns, self._now_ns)
                self._events.emit_event(name, texts.goal_clamped(name, owner, what_by))

    @property
    def outside(self) -> tuple[CommandOutside, ...]:
        """Joints with position commands outside of their limits."""
        cycles = self.counts[:, [bit.bit_length() - 1 for bit in _POSITION_LIMITS]].sum(axis=1)
        return tuple(CommandOutside(row, far, cycles.item(row)) for row, (_, far) in self._outside.items())

    def _report_ended(self) -> None:
        bits = self._record.clamped
        for (bit, row), clamped in tuple(self._clamps.items()):
            if bits.item(row) & bit:
                clamped.last_ns = self._now_ns
                if bit in _POSITION_LIMITS:
                    joint, at = self._plan.joints[row], self._record.commands.position.item(row)
                    beyond = max(joint.lower - at, at - joint.upper), at
                    self._outside[row] = max(beyond, self._outside.get(row, beyond))
            elif self._now_ns - clamped.last_ns >= CLAMP_ENDS_NS:
                del self._clamps[bit, row]
                name, lasted_ns = self._plan.joints[row].name, clamped.last_ns - clamped.begun_ns
                self._events.emit_event(name, texts.clamp_ended(name, clamped.what, lasted_ns))

    def _owner(self, joint: str) -> str:
        """Return text that names the active controller that commands a joint, and those above it."""
        active = self._record.active
        plans = [plan for index, plan in enumerate(self._plan.controllers) if active >> index & 1]
        for plan in plans:
            if plan.commands_servos and joint in plan.joints:
                uppers = [one.name for one in plans if plan.name in one.into and joint in one.joints]
                by = f", commanded by {' and '.join(uppers)}" if uppers else ""
                return f"controller {plan.name}{by}"
        return "no controller"


def _speeds_and_efforts(joints: Sequence[JointPlan]) -> Mapping[str, Sequence[float]]:
    """Return the limits of all joints that servo registers may lower, by `Joint` field of gate.c."""
    return {
        "speed": [joint.step_speed for joint in joints],
        "highest_speed": [joint.highest_speed for joint in joints],
        "effort": [joint.highest_effort for joint in joints],
        "pwm": [joint.highest_pwm for joint in joints],
    }


def _laid_out(joints: Sequence[JointPlan]) -> NDArray[np.void]:
    """Return the array of `Joint` structs for gate.c, filled from the plans; all joints start slowly."""
    laid: NDArray[np.void] = np.zeros(len(joints), dtype=np.dtype(STRUCTS["Joint"]))
    # The constants are in rad/s. They are scaled for linear joints by the ratio of the slow speeds.
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
    """Clamps the commands for sources, such as devices, to their ranges. NaN, "not commanded", stays NaN."""

    def __init__(self, plan: LoopPlan, record: CycleRecord, events: EventSink) -> None:
        ranges = [each for source in plan.sources for each in source.ranges]
        self._names = [(source, name) for source in plan.sources for name in source.commands]
        self._lowest, self._highest = np.array(ranges, dtype=np.float64).reshape(-1, 2).T
        self._events = events
        self.commands: Floats = record.source_commands
        """Commands for all sources of the robot, in the record."""
        self._outside = np.zeros(len(ranges), dtype=np.bool_)
        self._held = np.zeros(len(ranges), dtype=np.bool_)
        """Mask of the commands that are at an end of their range because they were clamped."""

    def clamp_commands(self) -> None:
        """Clamp the source commands in the record to their ranges.

        An event reports the begin of each clamp.
        """
        commands, outside, held = self.commands, self._outside, self._held
        at_end = (commands == self._lowest) | (commands == self._highest)
        np.logical_or(commands < self._lowest, commands > self._highest, out=outside)
        if np.count_nonzero(outside):
            for index in np.flatnonzero(outside & ~held).tolist():
                source, name = self._names[index]
                value, lowest, highest = commands[index], self._lowest[index], self._highest[index]
                event = texts.source_command_clamped(source.label, name, value, lowest, highest)
                self._events.emit_event(source.name, event)
            np.copyto(commands, np.clip(commands, self._lowest, self._highest), where=outside)
        # The clamped value stays in the array until the next command, so it still counts as clamped.
        np.logical_or(outside, held & at_end, out=held)
