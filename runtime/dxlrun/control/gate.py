"""Gate: the last hand on every command before it becomes a goal; vectorised over the joints."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dxlrun.control.drive_gate import DriveGate
from dxlrun.control.loop_plan import LoopPlan
from dxlrun.control.policy_plan import SLOW_SPEED, SLOW_START_NS
from dxlrun.interfaces import Commands, Floats
from dxlrun.mode import Mode
from dxlrun.run.channels.cycle import Clamp, CycleRecord
from dxlrun.run.channels.events import EventCode, EventSink, Severity

_WHAT = {
    Clamp.LOWER: "raised to the lower position limit",
    Clamp.UPPER: "lowered to the upper position limit",
    Clamp.STEP: "held to the step limit",
    Clamp.VELOCITY: "held to the velocity limit",
    Clamp.NOT_FINITE: "was not finite, the last goal is kept",
    Clamp.EFFORT: "held to the effort limit",
    Clamp.PWM: "held to the full voltage",
    Clamp.OUTWARD: "led out of the position limits",
}
_STILL = {Mode.VELOCITY: "velocity", Mode.EFFORT: "effort", Mode.PWM: "pwm"}
"""What is 0 where a joint in this mode shall not move by its own."""
_NOT_FINITE = np.uint8(Clamp.NOT_FINITE)


class Gate:
    """Turns merged commands into goals that are finite, inside the limits, and near the last goal.

    Each joint by the mode that it is in; one whose mode is not known has goals of NaN. Velocity, effort and
    PWM: see DriveGate. Positions:

    - A position of NaN was not commanded: the last goal, position and speed, is kept. Infinity too, and is
      flagged.
    - Positions are clamped to the joint's limits. A goal that starts outside of them (the present position of
      a joint that hangs there) may stay or move toward them, never further out.
    - The step from the last goal is at most `limits.velocity * dt` where the file gives a velocity, and in
      the first second after `ease_in` at most SLOW_SPEED * dt.
    - The commanded speed is taken as a magnitude and clamped to `limits.velocity` and the servo's top speed;
      NaN stays NaN: as fast as the servo can. No speed outlives the command that it came with.

    `record.clamped` tells what was done, bits of Clamp; an event tells when it begins. `counts`, shape
    (joints, 8), counts cycles by joint and bit.
    """

    def __init__(self, plan: LoopPlan, record: CycleRecord, events: EventSink) -> None:
        count = len(plan.joints)
        self.counts = np.zeros((count, len(_WHAT)), dtype=np.int64)
        self._plan = plan
        self._record = record
        self._events = events
        self._lower = np.array([joint.lower for joint in plan.joints], dtype=np.float64)
        self._upper = np.array([joint.upper for joint in plan.joints], dtype=np.float64)
        most = np.finfo(np.float64).max
        self._first, self._last = np.maximum(self._lower, -most), np.minimum(self._upper, most)
        """The same, so that infinity is beyond them where a joint has no limits."""
        self._speed = np.array(
            [np.inf if joint.velocity is None else joint.velocity for joint in plan.joints], dtype=np.float64
        )
        self._fastest = np.array([joint.highest_speed for joint in plan.joints], dtype=np.float64)
        self._slow = np.minimum(self._speed, SLOW_SPEED)
        self._slow_ns = np.full(count, SLOW_START_NS, dtype=np.int64)
        self._longest_slow_ns = SLOW_START_NS
        self._before = np.zeros(count, dtype=np.uint8)
        self._flags = np.zeros(count, dtype=np.uint8)
        self._wanted, self._inside, self._step, self._low, self._high = (np.empty(count) for _ in range(5))
        self._finite, self._mask = (np.empty(count, dtype=np.bool_) for _ in range(2))
        self._drive = DriveGate(plan.joints, self._flag_rows)
        self._modes = np.zeros(count, dtype=np.uint8)
        self._led = np.ones(count, dtype=np.bool_)
        """Joints that are led to positions."""
        self._all_led = self._any_led = True
        self._unflagged = bytes(count)
        self._everybody = bytes([True]) * count
        self._calm: tuple[bytes, bytes] | None = None
        """Commanded speeds and speeds of the goals, where the last cycle led nobody but to positions and had
        nothing to tell."""
        self._settled = (b"", b"")
        """Commanded positions, and those of the goals, as that cycle left them."""
        self._followed = False
        """Whether every joint was commanded to a position in it."""
        self.begin()

    def begin(self) -> None:
        """Take the joints' modes as they are: their goals belong to them already."""
        np.copyto(self._modes, self._record.states.mode)
        np.logical_or(self._modes == Mode.POSITION, self._modes == Mode.EFFORT_POSITION, out=self._led)
        self._all_led, self._any_led = bool(self._led.all()), bool(self._led.any())
        self._drive.take(self._modes)
        self._calm = None

    def enter_modes(self) -> None:
        """Give the joints whose mode has changed goals that move nothing in the new one; after each read.

        Who is led to a position holds where it is, and comes slowly to what it is told then.
        """
        modes = self._record.states.mode
        if modes.tobytes() == self._modes.tobytes():
            return
        changed = modes != self._modes
        self.begin()
        record, goals = self._record, self._record.goals
        goals.values[:, changed] = np.nan
        np.copyto(goals.position, record.states.position, where=changed & self._led)
        for mode, interface in _STILL.items():
            values = getattr(goals, interface)
            values[changed & (modes == mode)] = 0.0
        self.ease_in(np.flatnonzero(changed).tolist())

    def ease_in(self, rows: Sequence[int] | None = None) -> None:
        """Limit the steps of the coming second to SLOW_SPEED, of all joints or of these rows.

        Torque was just switched on, or nobody commanded the joints for a while.
        """
        if rows is None or rows:
            self._slow_ns[slice(None) if rows is None else list(rows)] = SLOW_START_NS
            self._longest_slow_ns = SLOW_START_NS

    def apply(self, commands: Commands, goals: Commands, dt_ns: int) -> None:
        """Move `goals` toward `commands` in place; `dt_ns` is the time since the cycle before."""
        flags = self._flags
        speed = self._highest(dt_ns)
        if self._goes_on(commands, goals, speed, dt_ns):
            return
        np.bitwise_and(self._record.clamped, _NOT_FINITE, out=flags)  # what the manager found
        if self._any_led:
            self._position(commands.position, goals.position, speed, dt_ns)
            self._velocity(commands.velocity, goals.velocity)
        if self._drive.any:
            self._drive.apply(commands, goals, self._record.states, speed, dt_ns)
        np.copyto(self._record.clamped, flags)
        if np.count_nonzero(flags):
            self._note(flags & ~self._before)
        np.copyto(self._before, flags)
        self._calm = None
        if not (self._drive.any or np.count_nonzero(flags)):
            self._calm = commands.velocity.tobytes(), goals.velocity.tobytes()
            self._settled = commands.position.tobytes(), goals.position.tobytes()
            self._followed = self._all_led and self._finite.tobytes() == self._everybody

    def _goes_on(self, commands: Commands, goals: Commands, speed: Floats, dt_ns: int) -> bool:
        """Do as in a calm cycle before, if that can be; what `_position` and `_velocity` would do, in less.

        Speeds stay as they are. Positions too, where the same are commanded: a goal that no limit holds back
        has arrived in one cycle, unless its step is limited, so it is looked whether it stands. Others are
        followed, if every joint is commanded inside of its limits and within its step.
        """
        if (
            (commands.velocity.tobytes(), goals.velocity.tobytes()) != self._calm
            or self._record.clamped.tobytes() != self._unflagged  # the manager found something
        ):
            return False
        wanted, goal = commands.position, goals.position
        commanded = wanted.tobytes()
        if (commanded, goal.tobytes()) == self._settled:
            return True
        step, low, high, mask = self._step, self._low, self._high, self._mask
        np.multiply(speed, max(dt_ns, 1) * 1e-9, step)
        np.maximum(np.subtract(goal, step, low), self._first, out=low)
        np.minimum(np.add(goal, step, high), self._last, out=high)
        if not self._followed or np.less_equal(low, wanted, mask).tobytes() != self._everybody:
            return False
        if np.less_equal(wanted, high, mask).tobytes() != self._everybody:
            return False
        np.copyto(goal, wanted)
        self._settled = commanded, commanded
        return True

    def _position(self, wanted: Floats, goal: Floats, speed: Floats, dt_ns: int) -> None:
        finite, inside, step, low, high = self._finite, self._inside, self._step, self._low, self._high
        np.isfinite(wanted, out=finite)
        np.isinf(wanted, out=self._mask)
        if not self._all_led:
            np.logical_and(finite, self._led, out=finite)
            np.logical_and(self._mask, self._led, out=self._mask)
        self._flag(Clamp.NOT_FINITE)
        np.copyto(self._wanted, goal)
        np.copyto(self._wanted, wanted, where=finite)
        np.fmin(self._lower, goal, out=low)  # a goal that is NaN has no say
        np.fmax(self._upper, goal, out=high)
        np.less(self._wanted, low, out=self._mask)
        self._flag(Clamp.LOWER)
        np.greater(self._wanted, high, out=self._mask)
        self._flag(Clamp.UPPER)
        np.maximum(self._wanted, low, out=inside)
        np.minimum(inside, high, out=inside)
        np.multiply(speed, max(dt_ns, 1) * 1e-9, out=step)
        np.subtract(goal, step, out=low)
        np.add(goal, step, out=high)
        np.less(inside, low, out=self._mask)
        self._flag(Clamp.STEP)
        np.greater(inside, high, out=self._mask)
        self._flag(Clamp.STEP)
        np.fmax(inside, low, out=inside)
        np.fmin(inside, high, out=inside)
        np.copyto(goal, inside, where=finite)

    def _highest(self, dt_ns: int) -> Floats:
        """Return the speed that each goal may have in this cycle, rad/s."""
        if self._longest_slow_ns <= 0:
            return self._speed
        speed = np.where(self._slow_ns > 0, self._slow, self._speed)
        self._slow_ns -= dt_ns
        self._longest_slow_ns -= dt_ns
        return speed

    def _velocity(self, wanted: Floats, goal: Floats) -> None:
        """A speed belongs to the position that it was commanded with: both are kept, or both are new."""
        speed = self._wanted
        np.abs(wanted, out=speed)
        np.isinf(speed, out=self._mask)
        np.logical_and(self._mask, self._finite, out=self._mask)
        self._flag(Clamp.NOT_FINITE)
        np.copyto(speed, np.nan, where=self._mask)
        np.greater(speed, self._fastest, out=self._mask)
        np.logical_and(self._mask, self._finite, out=self._mask)
        self._flag(Clamp.VELOCITY)
        np.minimum(speed, self._fastest, out=speed)
        np.copyto(goal, speed, where=self._finite)

    def _flag(self, bit: Clamp) -> None:
        if np.count_nonzero(self._mask):  # a tenth of the time of any()
            self._flags[self._mask] |= np.uint8(bit)

    def _flag_rows(self, rows: NDArray[np.intp], bit: Clamp) -> None:
        if rows.size:
            self._flags[rows] |= np.uint8(bit)

    def _note(self, begun: NDArray[np.uint8]) -> None:
        for column, (bit, what) in enumerate(_WHAT.items()):
            self.counts[:, column] += (self._flags & np.uint8(bit)) != 0
            for row in np.flatnonzero(begun & np.uint8(bit)):
                self._tell(int(row), what)

    def _tell(self, row: int, what: str) -> None:
        name = self._plan.joints[row].name
        self._events.emit(EventCode.GATE, Severity.WARNING, name, f"{name}, {self._owner(name)}: {what}")

    def _owner(self, joint: str) -> str:
        active = self._record.active
        for index, controller in enumerate(self._plan.controllers):
            if active >> index & 1 and controller.command and joint in controller.joints:
                return f"controller {controller.name}"
        return "no controller"
