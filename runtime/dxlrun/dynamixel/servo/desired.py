"""Desired state of the servos of one bus: mode and registers, changed in the run, kept over a reset.

Clients and controllers request changes; programs carry them out in idle time and read them back. A servo that
was offline is brought to the newest of it again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial

import numpy as np
from numpy.typing import NDArray

from dxlrun.channels.events import EventCode, EventSink, Severity
from dxlrun.description.modes import Mode
from dxlrun.dynamixel.control_table import control_table
from dxlrun.dynamixel.exchange.goals import GoalArrays
from dxlrun.dynamixel.exchange.idle import IdleScheduler, Urgency
from dxlrun.dynamixel.plan.line import listen
from dxlrun.dynamixel.plan.planning import plan_line
from dxlrun.dynamixel.plan.retry import retry
from dxlrun.dynamixel.servo import modes
from dxlrun.dynamixel.servo.life import Life, ServoEvent
from dxlrun.dynamixel.servo.reboots import Reboots
from dxlrun.dynamixel.servo.registers import Settled, compare, merged, settle
from dxlrun.plan.bus_plan import BusPlan, RegisterValue, ServoPlan
from dxlrun.plan.transaction import Program

PAUSES_NS = (50_000_000, 150_000_000)
"""Between attempts to write a register: a stalled machine or adapter is no reason to fail a request."""
RegisterDone = Callable[[str, int | None], None]
"""Takes what went wrong with a register, or an empty text, and what the servo had there; None: not known."""


class DesiredState:
    """The mode in which each servo of one bus shall be, and the registers that it shall hold.

    While a mode changes, the robot's `mode` shows UNKNOWN and no goal is sent. Where a servo refuses or does
    not answer, its mode is read again; one that cannot be read stays UNKNOWN until the servo is taken back.
    """

    def __init__(  # noqa: PLR0917  what a bus consists of
        self,
        plan: BusPlan,
        idle: IdleScheduler,
        goals: GoalArrays,
        life: Life,
        reboots: Reboots,
        mode: NDArray[np.uint8],
        events: EventSink,
    ) -> None:
        """`mode` is the robot's array of the modes in which the joints are."""
        self._plan = plan
        self._idle = idle
        self._goals = goals
        self._life = life
        self._reboots = reboots
        self._mode = mode
        self._events = events
        self._modes = [servo.start_mode for servo in plan.servos]
        self._changing = [False] * len(plan.servos)
        self._registers = [servo.registers for servo in plan.servos]

    def mode(self, index: int) -> Mode:
        """Return the mode in which a servo is, or shall be as soon as it can."""
        return self._modes[index]

    def resting(self, index: int) -> tuple[int, bytes] | None:
        """Return where a servo that is led to no position has its goal, and that of standing still."""
        mode = self._goals.modes[index]
        goal = None if mode is Mode.UNKNOWN else self._plan.servos[index].mode_plan(mode).goals[-1]
        return None if goal is None or goal.position is not None else (goal.address, bytes(goal.length))

    def registers(self, index: int) -> tuple[RegisterValue, ...]:
        """Return what a servo that was reset shall hold again, in the order in which it is written."""
        return self._registers[index]

    def change_modes(self, requested: NDArray[np.uint8]) -> None:
        """Let servos change into modes, shape (joints,), UNKNOWN: none; a later request replaces this one."""
        for index, servo in enumerate(self._plan.servos):
            mode = Mode(int(requested[servo.row]))
            if mode is Mode.UNKNOWN:
                continue
            self._modes[index] = mode
            if not self._changing[index] and mode != self._mode[servo.row]:
                self._begin_change(index)

    def entered(self, index: int, mode: Mode) -> None:
        """Record that a servo was brought into a mode: at the start, by a change, or when it returned."""
        self._modes[index] = mode
        self._show(index, mode)

    def returned(self, index: int, mode: Mode) -> None:
        """Record that a servo returned in a mode; another one that was requested meanwhile follows."""
        if self._changing[index]:
            return  # its change is next in idle time, and reads the mode then
        if mode == self._modes[index]:
            self.entered(index, mode)
        else:
            self._begin_change(index)

    def _show(self, index: int, mode: Mode) -> None:
        self._goals.set_mode(index, mode)
        self._mode[self._plan.servos[index].row] = mode

    def _begin_change(self, index: int) -> None:
        self._changing[index] = True
        self._show(index, Mode.UNKNOWN)
        name = f"the mode of {self._plan.label(self._plan.servos[index])}"
        self._idle.add(self._change_mode(index), Urgency.MODE, name, index)

    def _change_mode(self, index: int) -> Program[None]:
        """Change into the newest mode that is requested, and report what came of it.

        A servo that reboots meanwhile gets no torque back by that: it is lost, and returns by the policy. One
        that is lost already is left alone: its watchdog may have stopped it, and then it would refuse the
        goal that it needs to hold in another mode. Its return brings it into the newest mode.
        """
        if self._life.offline(index):
            self._changing[index] = False
            return
        plan, servo, mode = self._plan, self._plan.servos[index], self._modes[index]
        rebooted = yield from self._reboots.watch(index)
        problem = modes.STARTED_ANEW if rebooted else ""
        if not rebooted:
            try:
                problem = yield from modes.enter(
                    plan, servo, mode, inward=True, rebooted=partial(self._reboots.tick, index)
                )
            except LookupError as error:
                problem = f"cannot follow: {error}"
        problem = problem or (yield from self.unlimit(index, mode))
        yield from self._reboots.unwatch(index)
        if problem == modes.STARTED_ANEW:
            self._changing[index] = False
            if not self._life.offline(index):
                self._life.lose(index).rebooted = True
            return
        if problem:
            mode = yield from modes.mode_now(plan, servo)
            self._life.on(index, ServoEvent.DOUBT)
        else:
            torque = yield from retry(plan.torque_reads[index])
            if not (torque.answered and torque.parameters[0] == 1):
                self._life.on(index, ServoEvent.DOUBT)  # lost unnoticed, and a goal may switch it on
        self._changing[index] = False
        if problem:
            self._report_mode(index, Severity.ERROR, f"{problem}; it is in {_words(mode)}")
            self._show(index, mode)
            self._modes[index] = mode or self._modes[index]
        elif self._modes[index] != mode:  # another request came meanwhile
            self._begin_change(index)
        else:
            self.entered(index, mode)
            self._report_mode(index, Severity.INFO, f"is in {_words(mode)}")

    def unlimit(self, index: int, mode: Mode) -> Program[str]:
        """Give a servo all of its torque again after a mode that limited it, unless a policy reduced it."""
        if self._goals.fraction < 1.0:
            return ""
        return (yield from modes.unlimit(self._plan, self._plan.servos[index], mode))

    def _report_mode(self, index: int, severity: Severity, text: str) -> None:
        self._life.report(EventCode.MODE, severity, index, text)

    def read_register(self, index: int, item: str, done: RegisterDone) -> None:
        """Read an item in idle time; `done` takes what went wrong, and what the servo has."""
        servo = self._plan.servos[index]
        entry = control_table(servo.model, self._plan.protocol).items.get(item)
        if entry is None:
            done(f"{servo.joint} has no register {item}", None)
            return
        register = RegisterValue(entry.address, entry.size, 0, item)
        name = f"{entry.title} of {self._plan.label(servo)}"
        self._idle.add(self._read(servo, register, done), Urgency.STEERED, name, index)

    def _read(self, servo: ServoPlan, register: RegisterValue, done: RegisterDone) -> Program[None]:
        found: int | None = None
        for pause_ns in (*PAUSES_NS, 0):
            (difference,) = yield from compare(self._plan, servo, (register,), plan_line(self._plan))
            found = difference.found
            if found is not None or not pause_ns:
                break
            yield listen(pause_ns)
        item = control_table(servo.model, self._plan.protocol).items[register.name]
        problem = f"{self._plan.label(servo)} did not answer when {item.title} was read"
        done(problem if found is None else "", found)

    def write_register(self, index: int, item: str, value: int, done: RegisterDone) -> None:
        """Write a RAM item in idle time, if the servo has something else.

        `done` takes what went wrong, and what the servo had before.
        """
        servo = self._plan.servos[index]
        entry = control_table(servo.model, self._plan.protocol).items.get(item)
        if entry is None or entry.area != "RAM" or entry.access != "RW":
            done(f"{servo.joint} has no register {item} that could be written now", None)
            return
        register = RegisterValue(entry.address, entry.size, value, item)
        name = f"{entry.title} of {self._plan.label(servo)}"
        self._idle.add(self._write(index, register, done), Urgency.STEERED, name, index)

    def _write(self, index: int, register: RegisterValue, done: RegisterDone) -> Program[None]:
        servo = self._plan.servos[index]
        settled = yield from self._settle(servo, register)
        problem = "; ".join(settled.problems)
        if problem:
            self._events.emit(EventCode.REGISTER_DIFFERS, Severity.WARNING, servo.joint, problem)
        else:
            self._registers[index] = merged(self._registers[index], register)
        self.report_written(settled.written)
        done(problem, settled.found.get(register.name))

    def _settle(self, servo: ServoPlan, register: RegisterValue) -> Program[Settled]:
        """Write one register, and try again later while the servo is silent."""
        for pause_ns in PAUSES_NS:
            settled = yield from settle(self._plan, servo, (register,), plan_line(self._plan))
            if not settled.silent:
                return settled
            yield listen(pause_ns)
        return (yield from settle(self._plan, servo, (register,), plan_line(self._plan)))

    def report_written(self, written: Iterable[tuple[str, str]]) -> None:
        """Log registers that were written, each with its joint."""
        for joint, text in written:
            self._events.emit(EventCode.REGISTER_WRITTEN, Severity.INFO, joint, text)


def _words(mode: Mode) -> str:
    if mode is Mode.UNKNOWN:
        return "a mode that is not known"
    return f"{mode.name.lower().replace('_', '-')} mode"
