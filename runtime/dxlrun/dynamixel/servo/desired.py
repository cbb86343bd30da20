"""Desired state: the mode and the register values that each servo of a bus should have, as changed during a
run.

Clients and controllers request changes. Programs write them in idle time and read them back. A servo that was
offline is brought to the newest desired state again.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from dxlrun.dynamixel import texts
from dxlrun.dynamixel.findings import Findings
from dxlrun.dynamixel.servo import mode_switches
from dxlrun.dynamixel.servo.life import Life
from dxlrun.dynamixel.servo.reboots import Reboots
from dxlrun.dynamixel.servo.registers import merged, read_registers, write_registers
from dxlrun.dynamixel.servo.torque_limits import limits_positions, restore_torque_limit
from dxlwire.bus_plan import RegisterValue, ServoPlan
from dxlwire.exchange.goal_writes import GoalArrays
from dxlwire.exchange.idle import Urgency
from dxlwire.modes import Mode
from dxlwire.plan.line import listen_transaction
from dxlwire.transaction import Program

PAUSES_NS = (50_000_000, 150_000_000, 0)
"""Pauses (ns) between the attempts to read or write a register. A request must not fail because the machine
or the adapter stalls for a moment.
"""
RegisterDone = Callable[[str, int | None], None]
"""Callback of a register request: the problem (empty on success), and the value, of a write the previous one;
None: not known.
"""


class DesiredState:
    """The desired mode and the desired registers of each servo of one bus; servos are indices in the plan.

    While a mode changes, the robot's `mode` is UNKNOWN and no goal is sent. If a servo refuses or does not
    answer, its mode is read again. If that fails, the mode stays UNKNOWN until the servo has been recovered.
    """

    def __init__(self, life: Life, goals: GoalArrays, reboots: Reboots, mode: NDArray[np.uint8]) -> None:
        """Start with the modes and registers of the plan; `mode` is the robot's array of the joints' present
        modes, which this object fills.
        """
        self._life = life
        self._goals = goals
        self._reboots = reboots
        self._mode = mode
        self._modes = [servo.start_mode for servo in self._servos]
        self._changing = [False] * len(self._servos)
        self._settings = [servo.settings for servo in self._servos]

    @property
    def _servos(self) -> tuple[ServoPlan, ...]:
        return self._life.bus.plan.servos

    def place_servo(self, index: int, servo: ServoPlan) -> None:
        """Use a plan of a servo from now on whose reference and ticks count from another zero."""
        bus, samples = self._life.bus, self._life.reads.samples
        if servo == bus.plan.servos[index]:
            return
        servos = (*bus.plan.servos[:index], servo, *bus.plan.servos[index + 1 :])
        bus.plan = replace(bus.plan, servos=servos)
        samples.place_servo(index, servo)
        self._goals.place_servos(bus.plan)

    def mode(self, index: int) -> Mode:
        """Return the desired mode of a servo: its present mode, or the one into which it will change."""
        return self._modes[index]

    def mode_shown(self, index: int) -> Mode:
        """Return the confirmed mode of a servo, which the robot's states show; UNKNOWN while the mode
        changes.
        """
        return self._goals.modes[index]

    def resting(self, index: int) -> tuple[int, bytes] | None:
        """Return address and bytes of the goal 0 that stops a servo without a position goal; None if it
        follows a position or its mode is unknown.
        """
        mode = self._goals.modes[index]
        goal = None if mode is Mode.UNKNOWN else self._servos[index].mode_plan(mode).goals[-1]
        return None if goal is None or goal.position is not None else (goal.address, bytes(goal.length))

    def settings(self, index: int) -> tuple[RegisterValue, ...]:
        """Return the register values that a servo should have, in the order in which they are written after a
        reset.
        """
        return self._settings[index]

    def change_modes(self, requested: NDArray[np.uint8]) -> None:
        """Request operating modes, which the servos enter in idle time; a later request replaces this one.

        Args:
            requested: Mode of each joint, shape (joints,); UNKNOWN: no change.
        """
        for index, servo in enumerate(self._servos):
            mode = Mode(int(requested[servo.row]))
            if mode is Mode.UNKNOWN:
                continue
            self._modes[index] = mode
            if not self._changing[index] and mode != self._mode[servo.row]:
                self._begin_change(index)

    def entered(self, index: int, mode: Mode) -> None:
        """Record that a servo is in a mode now, and make it the desired one: after start-up, after a change,
        or on its return.
        """
        self._modes[index] = mode
        self._show(index, mode)

    def returned(self, index: int, mode: Mode) -> None:
        """Record that a servo is back from a loss, in this mode; start a mode change if another mode is
        desired now.

        The features restore the registers that they wrote.
        """
        for part in self._life.parts:
            part.recover_servo(index)
        if self._changing[index]:
            return  # its change waits for idle time, and will read the mode
        if mode == self._modes[index]:
            self.entered(index, mode)
        else:
            self._begin_change(index)

    def _show(self, index: int, mode: Mode) -> None:
        self._goals.set_mode(index, mode)
        self._mode[self._servos[index].row] = mode

    def _begin_change(self, index: int) -> None:
        self._changing[index] = True
        self._show(index, Mode.UNKNOWN)
        self._life.do(index, self._change_mode(index), "the mode", Urgency.MODE)

    def _change_mode(self, index: int) -> Program[None]:
        """Bring one servo to its newest requested mode, restore its torque limit, and report success or the
        problem.

        A servo that reboots during the change does not get its torque back here: it counts as lost, and
        returns by the policy. A servo that is already lost is not changed: its watchdog may have stopped it,
        and then it would refuse the goal that it needs to hold in another mode. Its recovery switches it to
        the newest mode.
        """
        life, one, mode = self._life, self._life.access_servo(index), self._modes[index]
        if life.offline(index):
            self._changing[index] = False
            return
        problem = mode_switches.STARTED_ANEW if (yield from self._reboots.arm_detection(index)) else ""
        if not problem:
            rebooted = partial(self._reboots.tick, index)
            try:
                problem = yield from mode_switches.enter_mode(one, mode, inward=True, rebooted=rebooted)
            except LookupError as error:
                problem = f"cannot follow: {error}"
        servo = self._servos[index]
        if not problem and any(limits_positions(servo, each) for each in servo.modes):
            limits = Findings()
            yield from self.restore_torque_limit(index, mode, limits)
            limits.log(life.events)
            problem = "; ".join(limits.problems)
        yield from self._reboots.unwatch(index)
        if problem == mode_switches.STARTED_ANEW:
            self._changing[index] = False
            if not life.offline(index):
                life.lose(index).rebooted = True
            return
        if problem:
            mode = yield from mode_switches.mode_now(one)
        life.give_torque(index)
        self._changing[index] = False
        if problem:
            life.report_event(index, texts.mode_not_entered(life.servo_name(index), problem, _words(mode)))
            self._show(index, mode)
            self._modes[index] = mode or self._modes[index]
        elif self._modes[index] != mode:  # a newer request came during the change
            self._begin_change(index)
        else:
            self.entered(index, mode)
            life.report_event(index, texts.mode_entered(life.servo_name(index), _words(mode)))

    def read_limits(self, index: int) -> Program[None]:
        """Read a servo's limit registers, beyond which it refuses goals, and use them for its goals; the
        servo may have been replaced.
        """
        self._goals.set_limits(index, (yield from mode_switches.read_limits(self._life.access_servo(index))))

    def restore_torque_limit(self, index: int, mode: Mode, found: Findings) -> Program[None]:
        """Restore a servo's own torque limit in this mode, unless a policy reduced the torque of the
        robot."""
        if self._goals.fraction >= 1.0:
            yield from restore_torque_limit(self._life.access_servo(index), mode, found)

    def queue_read(self, index: int, item: str, done: RegisterDone) -> None:
        """Read an item of a servo in idle time; `done` receives the problem and the value."""
        one = self._life.access_servo(index)
        entry = one.items.get(item)
        if entry is None:
            done(f"{one.servo.joint} has no register {item}", None)
            return
        register = RegisterValue(entry.address, entry.size, 0, item)
        self._life.do(index, self._read_with_retries(index, register, done), entry.title, Urgency.STEERED)

    def _read_with_retries(self, index: int, register: RegisterValue, done: RegisterDone) -> Program[None]:
        one = self._life.access_servo(index)
        for pause_ns in PAUSES_NS:
            found = (yield from read_registers(one, (register,)))[register.name]
            if found is not None or not pause_ns:
                break
            yield listen_transaction(pause_ns)
        title = one.items[register.name].title
        done("" if found is not None else f"{one} did not answer when {title} was read", found)

    def queue_write(self, index: int, item: str, value: int, done: RegisterDone) -> None:
        """Write a RAM item of a servo in idle time if it has another value, and keep the value as desired.

        `done` receives the problem and the previous value.
        """
        one = self._life.access_servo(index)
        entry = one.items.get(item)
        if entry is None or entry.area != "RAM" or entry.access != "RW":
            done(f"{one.servo.joint} has no writable RAM register {item}", None)
            return
        register = RegisterValue(entry.address, entry.size, value, item)
        self._life.do(index, self._write_with_retries(index, register, done), entry.title, Urgency.STEERED)

    def _write_with_retries(self, index: int, register: RegisterValue, done: RegisterDone) -> Program[None]:
        """Write one register with up to three attempts, with a pause after each in which the servo was
        silent.
        """
        life, one = self._life, self._life.access_servo(index)
        for pause_ns in PAUSES_NS:
            found = Findings()
            before = yield from write_registers(one, (register,), found)
            if before or not pause_ns:
                break
            yield listen_transaction(pause_ns)
        if problem := "; ".join(found.problems):
            life.events.emit_event(one.servo.joint, texts.register_not_written(problem))
        else:
            self._settings[index] = merged(self._settings[index], register)
        found.log(life.events)
        done(problem, before.get(register.name))


def _words(mode: Mode) -> str:
    if mode is Mode.UNKNOWN:
        return "an unknown mode"
    return f"{mode.name.lower().replace('_', '-')} mode"
