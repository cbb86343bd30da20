"""Watchdog monitor: detects pauses in the instructions on a bus that trip the Bus Watchdogs, and revives the
servos.
"""

from __future__ import annotations

from dxlrun.dynamixel import texts
from dxlrun.dynamixel.findings import Findings
from dxlrun.dynamixel.servo import watchdog
from dxlrun.dynamixel.servo.desired import DesiredState
from dxlrun.dynamixel.servo.life import Life, ServoEvent
from dxlrun.dynamixel.servo.registers import write_registers
from dxlwire.exchange.bus_engine import ASKED_NS, SILENCE_NS
from dxlwire.plan.bus_watchdog import UNIT_NS, has_watchdog, watchdog_item
from dxlwire.transaction import Program


class WatchdogMonitor:
    """Keeps the time of the last packet to the servos of one bus, which the exchange kernel checks, too.
    After a pause longer than the watchdogs' timeout it revives the servos.
    """

    def __init__(self, life: Life, desired: DesiredState) -> None:
        self._life = life
        self._desired = desired
        self._words = life.idle.bus.words
        self._words[SILENCE_NS] = life.bus.plan.watchdog_ticks * UNIT_NS
        self._reviving: set[int] = set()
        """Indices of servos whose revival already waits for idle time; a second late cycle must not schedule
        it again.
        """

    def arm(self, found: Findings) -> Program[None]:
        """Arm the Bus Watchdog of every servo and read it back, at the end of start-up; problems go to
        `found`.

        All servos are armed at once, and again before each read-back, so none trips while the other servos
        are read. A servo that is being revived receives instructions all the time.
        """
        life, plan = self._life, self._life.bus.plan
        self._words[ASKED_NS] = life.now_ns()
        packets = watchdog.to_all(plan, plan.servos, plan.watchdog_ticks)
        alone = sum(has_watchdog(plan, servo) for servo in plan.servos) == 1
        for index, servo in enumerate(plan.servos):
            if not plan.watchdog_ticks or (item := watchdog_item(plan, servo)) is None:
                continue
            one = life.access_servo(index)
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
        """Record that packets are sent to the servos now. If the pause before tripped their watchdogs, revive
        the servos.
        """
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
        plan, life = self._life.bus.plan, self._life
        armed = [
            index
            for index, servo in enumerate(plan.servos)
            if has_watchdog(plan, servo) and not life.offline(index)
        ]
        for index in armed:
            life.on(index, ServoEvent.WATCHDOG)
            if index not in self._reviving:
                self._reviving.add(index)
                life.do(index, self._revive(index), "the Bus Watchdog")
        if armed:
            life.events.emit_event(plan.name, texts.watchdog_stopped_servos(silent_ms))

    def _revive(self, index: int) -> Program[None]:
        """Program for one stopped servo: restore the desired registers that the stop reset, then clear and
        arm its watchdog.
        """
        life, one, found = self._life, self._life.access_servo(index), Findings()
        ramp = [each for each in self._desired.settings(index) if each.name == watchdog.RAMP]
        yield from write_registers(one, ramp, found)
        found.log(life.events)
        problem = "; ".join(found.problems) or (yield from watchdog.revive(one))
        self._reviving.remove(index)
        if problem and not life.offline(index):
            life.events.emit_event(one.servo.joint, texts.watchdog_not_cleared(problem))
            life.lose(index)
