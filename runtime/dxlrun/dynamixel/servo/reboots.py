"""Reboots of servos: detected by Realtime Tick or by an LED that went out, reported, and counted."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

from dxlrun.dynamixel import texts
from dxlrun.dynamixel.remedies import choose_remedy
from dxlrun.dynamixel.servo.life import Life
from dxlwire.plan.retry import retry
from dxlwire.transaction import Program, Reply, Transaction

TICK_MODULUS_MS = 32_768
"""Realtime Tick counts milliseconds modulo this (e-Manual XM430-W350, Realtime Tick (120))."""
BLIND_NS = 16_000_000_000
"""Longest time between two readings of Realtime Tick that can be compared. After half a turn of the counter
the direction of a difference is ambiguous (protocol.md).
"""
DRIFT = 0.02  # largest relative drift between the clocks of servo and host [i] (protocol.md)
SLACK_MS = 20.0
"""Tolerated error of a tick reading, in addition to the time between request and reply [i] (protocol.md)."""
WITHIN_NS = 60_000_000_000
TOO_MANY_REBOOTS = 2
"""After this many reboots within WITHIN_NS a servo gets no torque back in this run (failures.md)."""


class TickReading(NamedTuple):
    """One reading of a servo's Realtime Tick, a millisecond counter that a reboot resets to 0."""

    tick: int
    middle_ns: int
    half_ms: float  # the servo sampled the tick within this time around the middle

    @classmethod
    def from_reply(cls, reply: Reply) -> TickReading:
        """Return the reading in the reply to a read of Realtime Tick."""
        half_ns = (reply.last_ns - reply.asked_ns) // 2
        return cls(reply.word(), reply.asked_ns + half_ns, half_ns * 1e-6)

    def rebooted(self, before: TickReading | None) -> bool | None:
        """Return True if the servo rebooted between the reading `before` and this one.

        None: the earlier reading is missing or too old to decide.
        """
        if before is None or self.middle_ns - before.middle_ns > BLIND_NS:
            return None
        elapsed_ms = (self.middle_ns - before.middle_ns) * 1e-6
        half = TICK_MODULUS_MS / 2
        # The difference between counter and elapsed time, wrapped to half a turn in each direction.
        off = (self.tick - before.tick - elapsed_ms + half) % TICK_MODULUS_MS - half
        return abs(off) > DRIFT * elapsed_ms + SLACK_MS + self.half_ms + before.half_ms


class RebootCount:
    """Counts the reboots of one servo; after TOO_MANY_REBOOTS within a minute it gets no torque back."""

    def __init__(self) -> None:
        self._times: deque[int] = deque(maxlen=TOO_MANY_REBOOTS)
        self.exhausted = False  # it has rebooted TOO_MANY_REBOOTS times within a minute

    def count_reboot(self, now_ns: int) -> bool:
        """Count a reboot at this time; return True only for the one that reaches the limit."""
        times = self._times
        times.append(now_ns)
        if self.exhausted or len(times) < TOO_MANY_REBOOTS or now_ns - times[0] > WITHIN_NS:
            return False
        self.exhausted = True
        return True


class Reboots:
    """Detects and counts the reboots of the servos of one bus; servos are indices in the plan.

    Servos of Protocol 1.0 have no Realtime Tick. Between `arm_detection` and `unwatch` their LED is lit
    instead: a reboot switches it off.
    """

    def __init__(self, life: Life) -> None:
        count = len(life.bus.plan.servos)
        self._life = life
        self._lit: list[int | None] = [None] * count
        """Value of each servo's LED before `arm_detection` lit it; None: the servo is not watched."""
        self._ticks: list[TickReading | None] = [None] * count
        self._counts = [RebootCount() for _ in range(count)]

    def tick_reading(self, index: int) -> Transaction | None:
        """Return the transaction that reads a servo's Realtime Tick; None if the model does not have it."""
        one = self._life.access_servo(index)
        item = one.items.get("realtime_tick")
        return None if item is None else one.reading(item.address, item.size)

    def tick(self, index: int) -> Program[bool]:
        """Read a servo's Realtime Tick and compare it with the last reading; return True if it shows a
        reboot, which is counted.

        For a watched servo without Realtime Tick: return True if its LED is off.
        """
        read = self.tick_reading(index)
        if read is not None:
            return bool(self.detect_reboot(index, (yield from retry(read))))
        if self._lit[index] is None or (yield from self._lamp_is(index)) != 0:
            return False
        self._lit[index] = None
        self.count(index)
        return True

    def arm_detection(self, index: int) -> Program[bool]:
        """Read Realtime Tick, or light the LED, so that a later `tick` detects a reboot; return True if this
        read shows a reboot.
        """
        lamp = self._lamp(index)
        if lamp is not None and self._lit[index] is None:
            self._lit[index] = yield from self._lamp_is(index)
            if self._lit[index] == 0:
                yield from self._life.access_servo(index).write_bytes(lamp, b"\1")
                if (yield from self._lamp_is(index)) != 1:
                    self._lit[index] = None
        return (yield from self.tick(index))

    def unwatch(self, index: int) -> Program[None]:
        """Switch off the LED of a servo that `arm_detection` lit; a LED that was lit before stays lit."""
        before, lamp = self._lit[index], self._lamp(index)
        self._lit[index] = None
        if before == 0 and lamp is not None:
            yield from self._life.access_servo(index).write_bytes(lamp, b"\0")

    def _lamp(self, index: int) -> int | None:
        """Return the address of the LED that shows a reboot; None for a servo with Realtime Tick or without
        LED.
        """
        one = self._life.access_servo(index)
        item = None if "realtime_tick" in one.items else one.items.get("led", one.items.get("led_red"))
        return None if item is None else item.address

    def _lamp_is(self, index: int) -> Program[int | None]:
        """Read the LED of a servo; None if it has none or the read failed."""
        lamp = self._lamp(index)
        if lamp is None:
            return None
        reply = yield from self._life.access_servo(index).read_bytes(lamp, 1)
        return reply.parameters[0] if reply.answered else None

    def detect_reboot(self, index: int, reply: Reply) -> bool | None:
        """Compare a reply with Realtime Tick with the last reading; return True for a reboot, which is
        counted, None if undecided.
        """
        if self.tick_reading(index) is None or not reply.answered:
            return None
        before, now = self._ticks[index], TickReading.from_reply(reply)
        self._ticks[index] = now
        rebooted = now.rebooted(before)
        if rebooted:
            self.count(index)
        return rebooted

    def count(self, index: int) -> None:
        """Log a reboot of a servo, and count it toward TOO_MANY_REBOOTS unless a client requested it."""
        life, loss = self._life, self._life.losses.get(index)
        if loss is not None:
            loss.rebooted, loss.had_torque = True, False
            if loss.reboot is not None:
                life.report_event(index, texts.servo_rebooted_on_request(life.servo_name(index)))
                return
        event = texts.servo_rebooted(life.servo_name(index))
        if self._counts[index].count_reboot(life.now_ns()):
            remedy = choose_remedy(life.bus.plan.port, "check its supply")
            event = texts.servo_reboots_repeatedly(life.servo_name(index), remedy)
        life.report_event(index, event)

    def exhausted(self, index: int) -> bool:
        """Return True if a servo rebooted so often that no policy gives it torque any more in this run."""
        return self._counts[index].exhausted
