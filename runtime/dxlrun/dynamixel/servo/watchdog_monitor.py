"""Watchdog monitor: notices that a bus received no instruction for too long, and revives its servos."""

from __future__ import annotations

from dxlrun.channels.events import EventCode, Severity
from dxlrun.dynamixel.findings import Findings
from dxlrun.dynamixel.servo import watchdog
from dxlrun.dynamixel.servo.desired import DesiredState
from dxlrun.dynamixel.servo.life import Life, ServoEvent
from dxlrun.dynamixel.servo.registers import settle
from dxlwire.exchange.bus import ASKED_NS, SILENCE_NS
from dxlwire.transaction import Program


class WatchdogMonitor:
    """Knows when the servos of one bus were last sent anything; the exchange kernel looks at that, too."""

    def __init__(self, life: Life, desired: DesiredState) -> None:
        self._life = life
        self._desired = desired
        self._words = life.idle.bus.words
        self._words[SILENCE_NS] = life.plan.watchdog_ticks * watchdog.UNIT_NS
        self._reviving: set[int] = set()
        """Their revival waits for idle time already: a loop that is late again requests no second one."""

    def arm(self, found: Findings) -> Program[None]:
        """Arm every servo and read it back, at the end of the start-up.

        All of them at once, and once more before each is read: none is stopped because the others take long.
        A servo that is revived is sent instructions all the time, so it is not stopped by that itself.
        """
        life, plan = self._life, self._life.plan
        self._words[ASKED_NS] = life.now_ns()
        packets = watchdog.to_all(plan, plan.servos, plan.watchdog_ticks)
        alone = sum(watchdog.has_one(plan, servo) for servo in plan.servos) == 1
        for index, servo in enumerate(plan.servos):
            if not plan.watchdog_ticks or (item := watchdog.item_of(plan, servo)) is None:
                continue
            one = life.reach(index)
            self.sent(life.now_ns())
            for packet in packets:
                yield one.line.unanswered(packet)
            back = yield one.reading(item.address, item.size)
            if back.answered and back.word(item.size) == plan.watchdog_ticks:
                continue
            if problem := (yield from watchdog.revive(one)):
                found.problems.append(problem)
            elif alone:
                self._words[ASKED_NS] = life.now_ns()

    def sent(self, now_ns: int) -> None:
        """Record that the servos are sent something now; revive them if they were silent for too long."""
        words = self._words
        if not (words[SILENCE_NS] and words[ASKED_NS]):
            return
        silent_ns = now_ns - words[ASKED_NS]
        if silent_ns > words[SILENCE_NS]:
            silent_ns -= self._life.idle.bus.stalled_ns(words[ASKED_NS], now_ns)
        if silent_ns > words[SILENCE_NS]:
            self._revive_all(silent_ns // 1_000_000)
        words[ASKED_NS] = now_ns

    def _revive_all(self, silent_ms: int) -> None:
        plan, life = self._life.plan, self._life
        armed = [
            index
            for index, servo in enumerate(plan.servos)
            if watchdog.has_one(plan, servo) and not life.offline(index)
        ]
        for index in armed:
            life.on(index, ServoEvent.WATCHDOG)
            if index not in self._reviving:
                self._reviving.add(index)
                life.do(index, self._revive(index), "the Bus Watchdog")
        if armed:
            text = f"no instruction for {silent_ms} ms: the Bus Watchdog has stopped the servos"
            life.events.emit(EventCode.WATCHDOG, Severity.ERROR, plan.name, f"{text}; they are revived")

    def _revive(self, index: int) -> Program[None]:
        """Write again what the watchdog reset of the desired registers, then clear and arm it."""
        life, one, found = self._life, self._life.reach(index), Findings()
        ramp = [each for each in self._desired.settings(index) if each.name == watchdog.RAMP]
        yield from settle(one, ramp, found)
        found.log(life.events)
        problem = "; ".join(found.problems) or (yield from watchdog.revive(one))
        self._reviving.remove(index)
        if problem and not life.offline(index):
            life.events.emit(EventCode.WATCHDOG, Severity.ERROR, one.servo.joint, problem)
            life.lose(index)
