"""Feeding: whether the exchange kept the Bus Watchdogs of one bus satisfied; who was stopped is revived."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from dxlrun.dynamixel.exchange.gaps import Gaps, Urgency
from dxlrun.dynamixel.plan.bus_plan import BusPlan, RegisterValue
from dxlrun.dynamixel.plan.planning import plan_line
from dxlrun.dynamixel.registers import bus_watchdog
from dxlrun.dynamixel.registers.declared import settle
from dxlrun.dynamixel.servo.absent import NEVER
from dxlrun.dynamixel.wire.transaction import Program
from dxlrun.run.channels.events import EventCode, EventSink, Severity


class Feeding:
    """Knows when the servos were last sent anything.

    `stopped` is told who gets no goal before its torque was read again, `failed` who could not be revived;
    `registers` returns what a servo shall hold.
    """

    __slots__ = (
        "_away",
        "_events",
        "_failed",
        "_fed_ns",
        "_gaps",
        "_longest_ns",
        "_plan",
        "_registers",
        "_reviving",
        "_stopped",
    )

    def __init__(  # noqa: PLR0917  whom it looks after, whom it tells
        self,
        plan: BusPlan,
        gaps: Gaps,
        away: list[bool],
        events: EventSink,
        stopped: Callable[[int], None],
        failed: Callable[[int], None],
        registers: Callable[[int], tuple[RegisterValue, ...]],
    ) -> None:
        self._plan = plan
        self._gaps = gaps
        self._away = away
        self._events = events
        self._stopped = stopped
        self._failed = failed
        self._registers = registers
        self._longest_ns = plan.watchdog_ticks * bus_watchdog.UNIT_NS or NEVER
        self._fed_ns = 0
        self._reviving = [False] * len(away)
        """Whose turn in the gaps has not come yet: a loop that is late again and again asks for no second."""

    def begin(self) -> Program[list[str]]:
        """Arm the watchdogs, which is the first that the servos are fed; return what went wrong."""
        return bus_watchdog.arm_all(self._plan, lambda: self.feed(self._gaps.now_ns()))

    def feed(self, now: int) -> None:
        """Note that everybody is sent something at `now`, ns; who was not fed for long has stopped."""
        if self._fed_ns and now - self._fed_ns > self._longest_ns:
            self._revive((now - self._fed_ns) // 1_000_000)
        self._fed_ns = now

    def _revive(self, silent_ms: int) -> None:
        plan, here = self._plan, [index for index, away in enumerate(self._away) if not away]
        fed = [index for index in here if bus_watchdog.has_one(plan, plan.servos[index])]
        for index in fed:
            self._stopped(index)
            if self._reviving[index]:
                continue
            self._reviving[index] = True
            program = self._revival(index)
            name = f"the Bus Watchdog of {plan.servos[index].joint}"
            self._gaps.add(program, partial(self._revived, index), Urgency.REPAIR, name, index)
        if fed:
            text = f"no instruction for {silent_ms} ms: the Bus Watchdog has stopped the servos"
            text = f"{text}; they are revived"
            self._events.emit(EventCode.WATCHDOG, Severity.ERROR, plan.name, text)

    def _revival(self, index: int) -> Program[str]:
        """Write again what a watchdog reset of the declared registers, then clear and arm it."""
        plan, servo = self._plan, self._plan.servos[index]
        ramp = [one for one in self._registers(index) if one.name == bus_watchdog.RAMP]
        if ramp:
            settled = yield from settle(plan, servo, ramp, plan_line(plan))
            for joint, text in settled.written:
                self._events.emit(EventCode.REGISTER_WRITTEN, Severity.INFO, joint, text)
            if settled.problems:
                return "; ".join(settled.problems)
        return (yield from bus_watchdog.revive(plan, servo))

    def _revived(self, index: int, problem: str) -> None:
        self._reviving[index] = False
        if problem and not self._away[index]:
            self._events.emit(EventCode.WATCHDOG, Severity.ERROR, self._plan.servos[index].joint, problem)
            self._failed(index)
