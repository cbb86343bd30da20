"""Watchdog monitor: notices that a bus received no instruction for too long, and revives its servos."""

from __future__ import annotations

from dxlrun.channels.events import EventCode, EventSink, Severity
from dxlrun.dynamixel.exchange.bus import ASKED_NS, SILENCE_NS, Bus
from dxlrun.dynamixel.exchange.idle import IdleScheduler, Urgency
from dxlrun.dynamixel.plan.planning import plan_line
from dxlrun.dynamixel.servo import watchdog
from dxlrun.dynamixel.servo.desired import DesiredState
from dxlrun.dynamixel.servo.life import Life, ServoEvent
from dxlrun.dynamixel.servo.registers import settle
from dxlrun.plan.bus_plan import BusPlan
from dxlrun.plan.transaction import Program


class WatchdogMonitor:
    """Knows when the servos of one bus were last sent anything; the exchange kernel looks at that, too."""

    def __init__(  # noqa: PLR0917  what a bus consists of
        self,
        plan: BusPlan,
        bus: Bus,
        idle: IdleScheduler,
        life: Life,
        desired: DesiredState,
        events: EventSink,
    ) -> None:
        self._plan = plan
        self._idle = idle
        self._life = life
        self._desired = desired
        self._events = events
        self._words = bus.words
        self._words[SILENCE_NS] = plan.watchdog_ticks * watchdog.UNIT_NS
        self._reviving = [False] * len(plan.servos)
        """A revival waits for idle time already: a loop that is late repeatedly requests no second one."""

    def arm(self) -> Program[list[str]]:
        """Arm every servo and read it back, at the end of the start-up; return what went wrong.

        All of them at once, and once more before each is read: none is stopped because the others take long.
        """
        plan, line, problems = self._plan, plan_line(self._plan), []
        self._words[ASKED_NS] = self._idle.now_ns()
        packets = watchdog.to_all(plan, plan.servos, plan.watchdog_ticks)
        for servo in plan.servos:
            if not plan.watchdog_ticks or (item := watchdog.item_of(plan, servo)) is None:
                continue
            self.sent(self._idle.now_ns())
            for packet in packets:
                yield line.unanswered(packet)
            back = yield line.read(servo.servo_id, item.address, item.size)
            if not (back.answered and back.word(item.size) == plan.watchdog_ticks):
                problems.append((yield from watchdog.revive(plan, servo)))
        return [problem for problem in problems if problem]

    def sent(self, now_ns: int) -> None:
        """Record that the servos are sent something now; revive them if they were silent for too long."""
        words = self._words
        if not (words[SILENCE_NS] and words[ASKED_NS]):
            return
        if now_ns - words[ASKED_NS] > words[SILENCE_NS]:
            self._revive_all((now_ns - words[ASKED_NS]) // 1_000_000)
        words[ASKED_NS] = now_ns

    def _revive_all(self, silent_ms: int) -> None:
        plan, life = self._plan, self._life
        armed = [
            index
            for index, servo in enumerate(plan.servos)
            if watchdog.has_one(plan, servo) and not life.offline(index)
        ]
        for index in armed:
            life.on(index, ServoEvent.WATCHDOG)
            if not self._reviving[index]:
                self._reviving[index] = True
                name = f"the Bus Watchdog of {plan.servos[index].joint}"
                self._idle.add(self._revive(index), Urgency.REPAIR, name, index)
        if armed:
            text = f"no instruction for {silent_ms} ms: the Bus Watchdog has stopped the servos"
            text = f"{text}; they are revived"
            self._events.emit(EventCode.WATCHDOG, Severity.ERROR, plan.name, text)

    def _revive(self, index: int) -> Program[None]:
        """Write again what the watchdog reset of the desired registers, then clear and arm it."""
        plan, servo, problem = self._plan, self._plan.servos[index], ""
        ramp = [one for one in self._desired.registers(index) if one.name == watchdog.RAMP]
        if ramp:
            settled = yield from settle(plan, servo, ramp, plan_line(plan))
            self._desired.report_written(settled.written)
            problem = "; ".join(settled.problems)
        if not problem:
            problem = yield from watchdog.revive(plan, servo)
        self._reviving[index] = False
        if problem and not self._life.offline(index):
            self._events.emit(EventCode.WATCHDOG, Severity.ERROR, servo.joint, problem)
            self._life.lose(index)
