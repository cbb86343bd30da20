"""Reboots: whether a servo started anew since it was last asked, and how often it did of late."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

from dxlrun.dynamixel.wire.transaction import Reply

TURN_MS = 32_768
"""Realtime Tick counts milliseconds modulo this (e-Manual XM430-W350, Realtime Tick (120))."""
BLIND_NS = 16_000_000_000
"""After half a turn nobody can say whether it was less or more (protocol.md)."""
DRIFT = 0.02
"""The servo's clock may go so much faster or slower than the host's [i] (protocol.md)."""
SLACK_MS = 20.0
"""And a reading may be so far off, beside the time from question to answer [i] (protocol.md)."""
WITHIN_NS = 60_000_000_000
LATCHED = 2
"""So many reboots within a minute, and a servo gets no torque again in this run (failures.md)."""


class _Reading(NamedTuple):
    tick: int
    middle_ns: int
    half_ms: float
    """The tick was read within this time around the middle."""


class RealtimeTicks:
    """Compares a servo's millisecond counter with the host's clock: a reboot sets it back to 0."""

    __slots__ = ("_last",)

    def __init__(self, servos: int) -> None:
        self._last: list[_Reading | None] = [None] * servos

    def rebooted(self, servo: int, reply: Reply) -> bool | None:
        """Take a reading of Realtime Tick; say whether the servo rebooted since the one before.

        None: there was none before, or it is too long ago to tell.
        """
        half_ns = (reply.last_ns - reply.sent_ns) // 2
        now = _Reading(reply.word(), reply.sent_ns + half_ns, half_ns * 1e-6)
        before, self._last[servo] = self._last[servo], now
        if before is None or now.middle_ns - before.middle_ns > BLIND_NS:
            return None
        elapsed_ms = (now.middle_ns - before.middle_ns) * 1e-6
        off = (now.tick - before.tick - elapsed_ms + TURN_MS / 2) % TURN_MS - TURN_MS / 2
        return abs(off) > DRIFT * elapsed_ms + SLACK_MS + now.half_ms + before.half_ms


class RebootCount:
    """Counts the reboots of each servo; one that reboots again and again is latched for good."""

    __slots__ = ("_times", "latched")

    def __init__(self, servos: int) -> None:
        self._times: list[deque[int]] = [deque(maxlen=LATCHED) for _ in range(servos)]
        self.latched = [False] * servos
        """Who rebooted LATCHED times within a minute, ever."""

    def add(self, servo: int, now_ns: int) -> bool:
        """Count a reboot; return whether the servo is latched by it."""
        times = self._times[servo]
        times.append(now_ns)
        if self.latched[servo] or len(times) < LATCHED or now_ns - times[0] > WITHIN_NS:
            return False
        self.latched[servo] = True
        return True
