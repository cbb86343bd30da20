"""Gate: the last hand on every command before it becomes a goal; vectorised over the joints."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from dxlrun.channels.cycle import LIMP, Clamp, Commands, CycleRecord, Floats, States
from dxlrun.channels.events import EventCode, EventSink, Severity
from dxlrun.control.acceleration import Ramps, braking_speed
from dxlrun.description.modes import Mode
from dxlrun.plan.loop_plan import JointPlan, LoopPlan
from dxlrun.plan.policy_plan import SLOW_SPEED, SLOW_START_NS

BRAKING_S = 0.1
"""A joint in velocity mode may come nearer to a position limit by as much of the way that is left in this
time, so it comes to rest there, and with an acceleration limit this is how long a velocity counts to act
until the next one; [i] several times what a servo takes to follow (XM430: some 20 ms)."""
BRAKING = 10.0
"""rad/s^2, at which a joint that follows efforts brakes toward a limit, unless its acceleration limit is
higher: what an XM430 of 1.2 A does with 0.2 kg m^2. A heavier one begins too late. [i]"""
LEAST_BAND = 1.0
"""rad/s; a joint that is so much too fast is braked with all its effort, or more by `_brake`. [i]"""
FADING_S = 0.5
"""How long a measured change of velocity counts."""
BACK_SPEED = 0.5
"""rad/s; a joint that went beyond a limit goes back to it no faster, as ENGAGE_SPEED of `servo/modes.py`."""
LAG_S = 0.15
"""How long a servo in velocity mode goes on as before, an XM430 with 0.06 kg m^2 by its integral gain. [i]"""
FULL_PWM = 1.0
_SEEN = 1e-9
"""rad; a goal that is less behind its command was not held back: what a sum of steps is off by rounding."""

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
_NEUTRAL = {Mode.VELOCITY: "velocity", Mode.EFFORT: "effort", Mode.PWM: "pwm"}
"""The goal that is 0 where a joint in this mode shall not move by its own."""
_DRIVEN = tuple(_NEUTRAL)
_NOT_FINITE = np.uint8(Clamp.NOT_FINITE)

_Rows = NDArray[np.intp]


class Gate:
    """Turns merged commands into goals that are finite, inside the limits, and near the last goal.

    Each joint by the mode that it is in; one whose mode is not known has goals of NaN. Velocity, effort and
    PWM: see DriveGate. Positions:

    - A position of NaN was not commanded: the last goal, position and speed, is kept. Infinity too, and is
      flagged.
    - Positions are clamped to the joint's limits. A goal that starts outside of them (the present position of
      a joint that hangs there) may stay or move toward them, never further out.
    - The step from the last goal is at most `limits.velocity * dt`, which is the servo's top speed where the
      file gives none, and in the first second after `ease_in` at most SLOW_SPEED * dt.
    - With `limits.acceleration` the step changes by at most `acceleration * dt^2` from cycle to cycle, also
      when commands are withdrawn: see Ramps. It is never so long that the goal could not stop at the limit.
    - The commanded speed is taken as a magnitude and clamped to `limits.velocity` and the servo's top speed.
      Where none is commanded, a limit of the steps that is lower than the servo's top speed is the goal's
      speed too, as the servo takes a step as fast as it may, however long the cycle is; else NaN stays NaN:
      as fast as the servo can. No speed outlives the command that it came with.
    - A goal outside of the limits has a speed of at most BACK_SPEED: its servo is sent to the limit.
    - A joint without torque that is not commanded has the position where it stands.

    `record.clamped` has what was done, bits of Clamp; an event reports when it begins. `counts`, shape
    (joints, 8), counts cycles by joint and bit.
    """

    def __init__(self, plan: LoopPlan, record: CycleRecord, events: EventSink) -> None:
        joints, count = plan.joints, len(plan.joints)
        self.counts = np.zeros((count, len(_WHAT)), dtype=np.int64)
        self._plan = plan
        self._record = record
        self._events = events
        self._lower = _finite(joint.lower for joint in joints)  # so that infinity is beyond every limit
        self._upper = _finite(joint.upper for joint in joints)
        self._speed = np.array([_or_inf(joint.velocity) for joint in joints])
        self._slow = np.minimum(self._speed, [joint.slow_speed for joint in joints])
        self._slow_ns = np.full(count, SLOW_START_NS, dtype=np.int64)
        """For how long each joint is slow."""
        self._longest_slow_ns = SLOW_START_NS
        self._back_speed = BACK_SPEED * _share_of_speed(joints)
        self._drive = DriveGate(joints, self._flag)
        self._devices = DeviceGate(plan, record, events)
        self._ramps = Ramps(joints)
        self._own_speed = np.array([_or_inf(joint.top_speed) for joint in joints])
        """Steps at the servos' own top speed hold nothing back, so nothing is flagged."""
        self._modes = np.zeros(count, dtype=np.uint8)
        self._led = np.ones(count, dtype=np.bool_)
        """Joints that are led to positions."""
        self._any_led = True
        self._torque = b""
        """The joints' torque, as the states had it last."""
        self._limp = np.zeros(count, dtype=np.bool_)
        self._any_limp = False
        self._before = np.zeros(count, dtype=np.uint8)
        # positions in the first row, the speeds toward them in the second
        self._commanded, self._least, self._most, self._inside = (np.empty((2, count)) for _ in range(4))
        self._least[1] = 0.0
        self._most[1] = _finite(joint.highest_speed for joint in joints)
        self._given, self._cut = (np.empty((2, count), dtype=np.bool_) for _ in range(2))
        self._low, self._high = self._least[0], self._most[0]
        self._speeds, self._position_given = self._commanded[1], self._given[0]
        self._step, self._reach = np.empty(count), np.empty(count)
        self._desired = np.empty(count)
        self._take_modes()

    def begin(self) -> None:
        """Take the joints' modes and goals as they are: they belong together, and the goals are at rest."""
        self._take_modes()
        self._ramps.rest(np.ones(len(self._modes), dtype=np.bool_), self._record.goals.position)

    def _take_modes(self) -> None:
        np.copyto(self._modes, self._record.states.mode)
        np.logical_or(self._modes == Mode.POSITION, self._modes == Mode.EFFORT_POSITION, out=self._led)
        self._any_led = bool(self._led.any())
        self._drive.take(self._modes)

    def enter_modes(self) -> None:
        """Give the joints whose mode has changed goals that move nothing in the new one; after each read.

        A joint that is led to a position holds where it is, and follows its next commands slowly.
        """
        modes = self._record.states.mode
        if modes.tobytes() == self._modes.tobytes():
            return
        changed = modes != self._modes
        self._take_modes()
        record, goals = self._record, self._record.goals
        goals.values[:, changed] = np.nan
        np.copyto(goals.position, record.states.position, where=changed & self._led)
        for mode, interface in _NEUTRAL.items():
            values = getattr(goals, interface)
            values[changed & (modes == mode)] = 0.0
        self._ramps.rest(changed, goals.position)
        self.ease_in(np.flatnonzero(changed).tolist())

    def ease_in(self, rows: Sequence[int] | None = None) -> None:
        """Limit the steps of the coming second to SLOW_SPEED, of all joints or of these rows.

        Torque was just switched on, or the joints were not commanded for a while.
        """
        if rows is None or rows:
            self._slow_ns[slice(None) if rows is None else list(rows)] = SLOW_START_NS
            self._longest_slow_ns = SLOW_START_NS

    def apply(self, commands: Commands, goals: Commands, dt_ns: int) -> None:
        """Move `goals` toward `commands` in place; `dt_ns` is the time since the cycle before."""
        clamped, speed = self._record.clamped, self._speed
        if self._any_limp or self._record.states.torque.tobytes() != self._torque:
            self._follow(goals)
        np.bitwise_and(clamped, _NOT_FINITE, clamped)  # what the manager found
        if self._longest_slow_ns > 0:
            speed = np.where(self._slow_ns > 0, self._slow, self._speed)
            self._slow_ns -= dt_ns
            self._longest_slow_ns -= dt_ns
        if self._any_led:
            self._lead(commands, goals, speed, dt_ns)
        if self._drive.driven:
            self._drive.apply(commands, goals, self._record.states, speed, dt_ns)
        if self._drive.limited:
            self._drive.limit(commands.effort, goals.effort)
        if self._any_limp:
            clamped[self._limp] &= _NOT_FINITE  # what is commanded meanwhile is not followed
            self._drive.forget(self._limp)
            self._stay(self._limp, goals)
        if np.count_nonzero(clamped):  # a tenth of the time of any()
            self._report(clamped & ~self._before)
        np.copyto(self._before, clamped)
        if self._devices.commands.size:
            self._devices.apply()

    def _follow(self, goals: Commands) -> None:
        """Let the goals of limp joints be where these stand, whatever is commanded.

        So a joint that gets torque again holds where it is, and follows its commands slowly from there on.
        """
        states, limp = self._record.states, self._limp
        if (torque := states.torque.tobytes()) != self._torque:
            self._torque, before = torque, limp
            self._limp = np.isin(states.torque, LIMP)
            self._any_limp = bool(self._limp.any())
            self.ease_in(np.flatnonzero(before & ~self._limp).tolist())
            limp = before | self._limp  # those that have it again too, as they moved until now
        self._stay(limp, goals)

    def _stay(self, limp: NDArray[np.bool_], goals: Commands) -> None:
        position = self._record.states.position
        limp = limp & self._led & np.isfinite(position)
        np.copyto(goals.position, position, where=limp)
        goals.velocity[limp] = np.nan
        self._ramps.rest(limp, goals.position)

    def _lead(self, commands: Commands, goals: Commands, speed: Floats, dt_ns: int) -> None:
        """Fill position and speed of the joints that are led to positions.

        Written for few calls of numpy, of which each takes half a microsecond whatever the number of joints:
        positions and speeds go through the same ones, and what was cut is looked into only if anything was.
        """
        goal, low, high, step, reach = goals.position, self._low, self._high, self._step, self._reach
        commanded, inside, given, cut = self._commanded, self._inside, self._given, self._cut
        np.copyto(commanded, commands.values[:2])
        np.abs(self._speeds, self._speeds)
        np.equal(commanded, commanded, given)  # all but NaN
        np.logical_and(given, self._led, given)
        np.multiply(speed, max(dt_ns, 1) * 1e-9, step)
        # a goal outside of the limits is a limit, too, and one that is NaN is none
        np.fmax(np.subtract(goal, step, reach), np.fmin(self._lower, goal, out=low), out=low)
        np.fmin(np.add(goal, step, reach), np.fmax(self._upper, goal, out=high), out=high)
        np.minimum(np.maximum(commanded, self._least, out=inside), self._most, out=inside)
        np.logical_and(np.not_equal(inside, commanded, cut), given, cut)
        moved = self._position_given
        if np.count_nonzero(cut):
            self._flag_cut(goal, speed)
            moved = moved & np.isfinite(commanded[0])  # infinity keeps the last goal
        if self._ramps.any:
            moved = self._ramp(goal, moved, speed, max(dt_ns, 1) * 1e-9)
        np.copyto(goals.values[:2], inside, where=moved)
        ceiling = np.where(speed < self._own_speed, speed, np.nan)  # NaN: as fast as the servo can
        outside = (goal < self._lower) | (goal > self._upper)
        if np.count_nonzero(outside):  # its servo is sent to the limit, which it coasted over
            ceiling = np.where(outside, np.fmin(ceiling, self._back_speed), ceiling)
        np.fmin(goals.velocity, ceiling, out=goals.velocity, where=self._led)

    def _ramp(self, goal: Floats, moved: NDArray[np.bool_], speed: Floats, dt: float) -> NDArray[np.bool_]:
        """Let the goals change their velocity within the acceleration limits; return which move."""
        desired, inside, ramps = self._desired, self._inside, self._ramps
        np.copyto(desired, goal)
        np.copyto(desired, inside[0], where=moved)
        if ramps.passes(goal, desired, dt):
            return moved
        # not held to the step limit yet: the goal must know how far it is to go to begin to brake in time
        given = np.maximum(self._commanded[0], np.fmin(self._lower, goal))
        np.copyto(desired, np.minimum(given, np.fmax(self._upper, goal), out=given), where=moved)
        toward = np.where(moved, inside[1], np.nan)
        stepped = ramps.steer(goal, desired, np.minimum(speed, self._own_speed), toward, dt)
        rows = ramps.limited & self._led
        held = rows & moved & (np.abs(stepped - desired) > _SEEN)
        self._flag(held, Clamp.STEP)
        np.copyto(inside[0], stepped, where=rows)
        np.copyto(inside[1], self._record.goals.velocity, where=rows & ~moved)
        return moved | rows

    def _flag_cut(self, goal: Floats, highest: Floats) -> None:
        """Flag why commands were cut; an infinite speed becomes NaN, as if none was commanded.

        `highest`, rad/s: of each joint in this cycle.
        """
        position, speed = self._commanded
        infinite = self._position_given & np.isinf(position)
        finite = self._position_given & ~infinite
        too_fast = self._cut[1] & finite
        self._flag(infinite | (too_fast & np.isinf(speed)), Clamp.NOT_FINITE)
        self._flag(too_fast & np.isfinite(speed), Clamp.VELOCITY)
        self._inside[1, too_fast & np.isinf(speed)] = np.nan
        lower, upper = np.fmin(self._lower, goal), np.fmax(self._upper, goal)
        self._flag(finite & (position < lower), Clamp.LOWER)
        self._flag(finite & (position > upper), Clamp.UPPER)
        held = finite & (highest < self._own_speed) & ~self._ramps.limited
        if np.count_nonzero(held):
            kept = np.minimum(np.maximum(position, lower), upper)
            self._flag(held & (self._inside[0] != kept), Clamp.STEP)

    def _flag(self, rows: NDArray[np.bool_] | _Rows, bit: Clamp) -> None:
        if np.count_nonzero(rows) or rows.dtype != np.bool_:
            self._record.clamped[rows] |= np.uint8(bit)

    def _report(self, begun: NDArray[np.uint8]) -> None:
        found = int(np.bitwise_or.reduce(self._record.clamped))
        for column, (bit, what) in enumerate(_WHAT.items()):
            if not found & bit:
                continue
            self.counts[:, column] += (self._record.clamped & np.uint8(bit)) != 0
            for row in np.flatnonzero(begun & np.uint8(bit)).tolist():
                name = self._plan.joints[row].name
                # what commands it now may stand in for the controller whose fault this is, which has an event
                by = "" if bit is Clamp.NOT_FINITE else f", {self._owner(name)}"
                text = f"{name}{by}: {what}"
                self._events.emit(EventCode.GATE, Severity.WARNING, name, text)

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


def _or_inf(limit: float | None) -> float:
    return np.inf if limit is None else limit


def _finite(limits: Iterable[float]) -> Floats:
    most = np.finfo(np.float64).max
    return np.clip(np.array(list(limits), dtype=np.float64), -most, most)


def _share_of_speed(joints: Sequence[JointPlan]) -> Floats:
    """Return what a speed of 1 rad/s is for each joint: for a linear one as many m/s as its slow start is."""
    return np.array([joint.slow_speed / SLOW_SPEED for joint in joints])


class DeviceGate:
    """Keeps the commands of devices inside the ranges of their items; NaN was not commanded and stays."""

    def __init__(self, plan: LoopPlan, record: CycleRecord, events: EventSink) -> None:
        ranges = [each for source in plan.sources for each in source.ranges]
        self._names = [(source, name) for source in plan.sources for name in source.commands]
        self._lowest, self._highest = np.array(ranges, dtype=np.float64).reshape(-1, 2).T
        self._events = events
        self.commands: Floats = record.device_command
        """Of the robot's devices."""
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


class DriveGate:
    """Turns commands of velocity, effort and PWM into goals: the part of the gate for joints in these modes.

    - NaN was not commanded, and infinity is flagged: the goal is 0 then. A joint without a position to hold
      goes nowhere by itself when it is not commanded any more.
    - Velocities are cut to the speed that the gate gives, efforts to `limits.effort`, PWM to full voltage;
      all of them to what the servo has.
    - With `limits.acceleration` a velocity changes by at most `acceleration * dt` a cycle, also when it is
      not commanded any more; faster only at a position limit, for a joint that did not follow its goals.
    - Within position limits: a velocity that leads outward becomes smaller toward the limit and is 0 there,
      in proportion to what is left, and with an acceleration limit so that it can brake (`braking_speed`);
      an effort or a PWM becomes smaller, and pulls back against a joint that is too fast to stop at the
      limit, whatever is commanded (`_brake`). Where the position is not known, each of them is 0. A wheel
      (a joint that is not `bounded`) has none of this.
    - In mode EFFORT_POSITION the effort is a limit: its magnitude counts, NaN keeps the last one.
    """

    def __init__(self, joints: Sequence[JointPlan], flag: Callable[[_Rows, Clamp], None]) -> None:
        """`flag` notes what was done to the commands of some rows."""
        self.driven = False
        """True when a joint is in mode VELOCITY, EFFORT or PWM."""
        self.limited = False
        """True when one is in mode EFFORT_POSITION."""
        self._flag = flag
        self._lower = np.array([joint.lower for joint in joints], dtype=np.float64)
        self._upper = np.array([joint.upper for joint in joints], dtype=np.float64)
        self._effort = _finite(joint.highest_effort for joint in joints)  # so that infinity is beyond
        self._speed = np.array([joint.highest_speed for joint in joints])
        self._free = np.array([not joint.bounded for joint in joints], dtype=np.bool_)
        self._acceleration = np.array([_or_inf(joint.acceleration) for joint in joints])
        self._accelerates = bool(np.isfinite(self._acceleration).any())
        self._fence, self._last, self._rise = np.zeros((2, len(joints))), *np.zeros((2, len(joints)))
        """Up to where an effort may lead upward and downward, rad: the limits, for a joint that was outside
        of them where it was, infinite: not known yet; the measured velocity of the cycle before; and its
        largest change lately, rad/s^2."""
        share = _share_of_speed(joints)
        self._back_speed, self._least_band = BACK_SPEED * share, LEAST_BAND * share
        limited = np.where(np.isfinite(self._acceleration), self._acceleration, 0.0)
        self._brakes_at = np.fmax(BRAKING * share, limited)
        none = np.empty(0, dtype=np.intp)
        self._rows: dict[Mode, _Rows] = dict.fromkeys(_DRIVEN, none)
        self._limiting = none

    def take(self, modes: NDArray[np.uint8]) -> None:
        """Take the joints' modes, shape (joints,)."""
        self._rows = {mode: np.flatnonzero(modes == mode) for mode in _DRIVEN}
        self._limiting = np.flatnonzero(modes == Mode.EFFORT_POSITION)
        self._fence.fill(np.inf)
        self.driven = any(rows.size for rows in self._rows.values())
        self.limited = bool(self._limiting.size)

    def forget(self, rows: NDArray[np.bool_]) -> None:
        """Let joints that move freely be where they are: beyond a limit they are not drawn back to it."""
        self._fence[:, rows] = np.inf

    def apply(self, commands: Commands, goals: Commands, states: States, speed: Floats, dt_ns: int) -> None:
        """Fill the goals of these joints; `speed`, rad/s, is the highest of each joint in this cycle."""
        for mode, commanded, goal, most, clamp in (
            (
                Mode.VELOCITY,
                commands.velocity,
                goals.velocity,
                np.minimum(speed, self._speed),
                Clamp.VELOCITY,
            ),
            (Mode.EFFORT, commands.effort, goals.effort, self._effort, Clamp.EFFORT),
            (Mode.PWM, commands.pwm, goals.pwm, np.full_like(speed, FULL_PWM), Clamp.PWM),
        ):
            rows = self._rows[mode]
            if rows.size:
                values = self._bounded(rows, commanded[rows], most[rows], clamp)
                if mode == Mode.VELOCITY and self._accelerates:
                    values = self._ramped(rows, commanded[rows], values, goal[rows], dt_ns)
                if mode == Mode.VELOCITY:
                    goal[rows] = self._inward(rows, values, states, dt_ns)
                else:
                    goal[rows] = self._brake(rows, values, most[rows], states, dt_ns)

    def _bounded(self, rows: _Rows, commanded: Floats, most: Floats, clamp: Clamp) -> Floats:
        """Return finite values of at most this magnitude."""
        self._flag(rows[np.isinf(commanded)], Clamp.NOT_FINITE)
        values = np.where(np.isfinite(commanded), commanded, 0.0)
        beyond = np.abs(values) > most
        if clamp == Clamp.VELOCITY:  # the slow start holds it lower than the file's limit
            slow = beyond & (most < self._speed[rows])
            self._flag(rows[slow], Clamp.STEP)
            beyond &= ~slow
        self._flag(rows[beyond], clamp)
        return np.clip(values, -most, most)

    def _ramped(self, rows: _Rows, commanded: Floats, values: Floats, last: Floats, dt_ns: int) -> Floats:
        """Return the velocities that the acceleration allows from the last ones on."""
        before, change = (
            np.where(np.isnan(last), 0.0, last),
            self._acceleration[rows] * (max(dt_ns, 1) * 1e-9),
        )
        ramped: Floats = np.minimum(np.maximum(values, before - change), before + change)
        self._flag(rows[(ramped != values) & np.isfinite(commanded)], Clamp.STEP)
        return ramped

    def _inward(self, rows: _Rows, values: Floats, states: States, dt_ns: int) -> Floats:
        """Return the velocities without what leads out of the position limits.

        A servo is behind its goal by LAG_S, and goes on as long when that becomes less: with a lag of the
        first order, d - v LAG_S in place of the way d that is left comes to rest at the limit without going
        beyond, ((LAG_S s + 1) (BRAKING_S s + 1) is the characteristic polynomial).
        """
        position, velocity = states.position[rows], np.nan_to_num(states.velocity[rows])
        ahead = velocity * (LAG_S + 1e-9 * dt_ns)
        above = self._upper[rows] - position - np.fmax(ahead, 0.0)  # NaN where not known
        below = position - self._lower[rows] + np.fmin(ahead, 0.0)
        seconds = max(BRAKING_S, 2e-9 * dt_ns)  # a slow loop sees late how near it came
        up, down = np.fmax(above, 0.0), np.fmax(below, 0.0)
        if self._accelerates:
            limit = self._acceleration[rows]
            up, down = braking_speed(up, seconds, limit), braking_speed(down, seconds, limit)
        else:
            up, down = up / seconds, down / seconds
        return self._between(rows, values, -down, up)

    def _between(self, rows: _Rows, values: Floats, down: Floats, up: Floats) -> Floats:
        """Return the values within these ends, flagged where they led out; those of a wheel as they are."""
        free = self._free[rows]
        down, up = np.where(free, -np.inf, down), np.where(free, np.inf, up)
        self._flag(rows[(values > up) | (values < down)], Clamp.OUTWARD)
        return np.minimum(np.maximum(values, down), up)

    def _brake(self, rows: _Rows, values: Floats, most: Floats, states: States, dt_ns: int) -> Floats:
        """Return efforts or PWM with which joints come to rest at their limits, by measured motion alone.

        Toward a limit a joint may have `braking_speed`. What may pull it outward becomes smaller as it nears
        that speed, is 0 at it, and above it pulls back, up to the full effort: a damper that knows no
        inertia. It is as soft as the joint's measured changes of velocity need it in this period: its pull
        takes away at most half of what is too much until the next cycle. A joint that is beyond goes back as
        far as it went beyond, slowly.
        """
        dt = max(dt_ns, 1) * 1e-9
        position, velocity = states.position[rows], np.nan_to_num(states.velocity[rows])
        rise = np.abs(velocity - self._last[rows]) / dt
        self._rise[rows] = rise = np.fmax(rise, self._rise[rows] * max(0.0, 1.0 - dt / FADING_S))
        self._last[rows] = velocity
        band = np.fmax(self._least_band[rows], 2.0 * dt * rise)
        ends = []
        for side, limit in enumerate((self._upper[rows], -self._lower[rows])):
            sign = 1.0 - 2.0 * side
            fence = np.fmax(limit, np.fmin(self._fence[side, rows], sign * position))
            self._fence[side, rows] = fence
            left = fence - sign * position  # NaN where not known
            inside = braking_speed(np.fmax(left, 0.0), 2.0 * dt, self._brakes_at[rows])
            allowed = np.where(left > 0.0, inside, np.fmax(left / BRAKING_S, -self._back_speed[rows]))
            share = np.clip((allowed - sign * velocity) / band, -1.0, np.where(left > 0.0, 1.0, 0.0))
            ends.append(np.where(np.isnan(left), 0.0, share) * most)
        return self._between(rows, values, -ends[1], ends[0])

    def limit(self, commanded: Floats, goal: Floats) -> None:
        """Fill the limits of the efforts of joints in mode EFFORT_POSITION."""
        rows = self._limiting
        values, most = np.abs(commanded[rows]), self._effort[rows]
        if np.count_nonzero(beyond := values > most):  # infinity too
            infinite = np.isinf(values)
            self._flag(rows[infinite], Clamp.NOT_FINITE)
            self._flag(rows[beyond & ~infinite], Clamp.EFFORT)
            values[infinite] = np.nan
        np.copyto(values, goal[rows], where=np.isnan(values))
        goal[rows] = np.minimum(values, most)
