"""Registers that clients change while the robot runs: written in the gaps, read back, kept over a reset."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from dxlrun.dynamixel.control_table import control_table
from dxlrun.dynamixel.exchange.gaps import Gaps, Urgency
from dxlrun.dynamixel.plan.bus_plan import BusPlan, RegisterValue, ServoPlan
from dxlrun.dynamixel.plan.line import listen
from dxlrun.dynamixel.plan.planning import plan_line
from dxlrun.dynamixel.registers.declared import Settled, merged, settle
from dxlrun.dynamixel.registers.inspection import called, who
from dxlrun.dynamixel.wire.transaction import Program
from dxlrun.run.channels.events import EventCode, EventSink, Severity

PAUSES_NS = (50_000_000, 150_000_000)
"""Between tries: a client would rather wait than hear of a machine or an adapter that stood still."""


class SteeredRegisters:
    """What each servo of one bus shall hold: as declared in the robot file, then as clients changed it."""

    __slots__ = ("_events", "_gaps", "_plan", "_wanted")

    def __init__(self, plan: BusPlan, gaps: Gaps, events: EventSink) -> None:
        self._plan = plan
        self._gaps = gaps
        self._events = events
        self._wanted = [servo.registers for servo in plan.servos]

    def wanted(self, index: int) -> tuple[RegisterValue, ...]:
        """Return what a servo that was reset shall hold again, in the order in which it is written."""
        return self._wanted[index]

    def write(self, index: int, item: str, value: int, done: Callable[[str], None]) -> None:
        """Write an item in the next gaps, if the servo has something else; `done` takes what went wrong."""
        servo = self._plan.servos[index]
        entry = control_table(servo.model, self._plan.protocol).items.get(item)
        if entry is None or entry.area != "RAM" or entry.access != "RW":
            done(f"{servo.joint} has no register {item} that could be written now")
            return
        register = RegisterValue(entry.address, entry.size, value, item)
        self._gaps.add(
            self._settle(servo, register),
            partial(self._written, index, register, done),
            Urgency.STEERED,
            f"{called(entry)} of {who(self._plan, servo)}",
            index,
        )

    def _settle(self, servo: ServoPlan, register: RegisterValue) -> Program[Settled]:
        """Write one register, and try again later while the servo is silent."""
        for pause_ns in PAUSES_NS:
            settled = yield from settle(self._plan, servo, (register,), plan_line(self._plan))
            if not settled.silent:
                return settled
            yield listen(pause_ns)
        return (yield from settle(self._plan, servo, (register,), plan_line(self._plan)))

    def _written(
        self, index: int, register: RegisterValue, done: Callable[[str], None], settled: Settled
    ) -> None:
        problem = "; ".join(settled.problems)
        joint = self._plan.servos[index].joint
        if problem:
            self._events.emit(EventCode.REGISTER_DIFFERS, Severity.WARNING, joint, problem)
        else:
            self._wanted[index] = merged(self._wanted[index], register)
        for _, text in settled.written:
            self._events.emit(EventCode.REGISTER_WRITTEN, Severity.INFO, joint, text)
        done(problem)
