"""Rounds: every host in turn, a few exchanges each, again and again, so that all meet the same machine."""

from __future__ import annotations

import ctypes
import gc
import os
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np

from exchange.hosts import Host

_PR_SET_TIMERSLACK, _PR_GET_TIMERSLACK = 29, 30
"""linux/prctl.h"""
WARM = 3
"""Exchanges at the beginning of a turn that do not count: the caches are still another host's."""


@dataclass(slots=True)
class Measured:
    """What one host took, round by round; of exchanges in which a reply was lost only their number counts."""

    walls_ns: list[list[int]] = field(default_factory=list)
    """Of each round, the duration of each exchange."""
    starts_ns: list[int] = field(default_factory=list)
    """When the first exchange of each round began; the others follow each other."""
    processor_ns: list[float] = field(default_factory=list)
    """Of each round, this process' processor time an exchange."""
    lost: int = 0

    @property
    def exchanges(self) -> int:
        """How many count."""
        return sum(map(len, self.walls_ns))

    @property
    def wall_medians_ns(self) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
        """The median of each round."""
        return np.array([np.median(round_) for round_ in self.walls_ns])


def measure(
    hosts: Mapping[str, Host],
    seconds: float,
    *,
    most: int = 100,
    recover: Callable[[str], None],
    progress: Callable[[float], None] = lambda _: None,
) -> dict[str, Measured]:
    """Let hosts exchange in turns of up to `most` exchanges for some time; at least two rounds.

    `recover` is called when a host lost a reply, `progress` with the share of the time after each round.
    """
    found = {name: Measured() for name in hosts}
    names = list(hosts)
    turn_ns = min(50_000_000, round(seconds * 1e9 / len(names) / 4))
    with _undisturbed():
        began_ns = time.monotonic_ns()
        number = 0
        while (share := (time.monotonic_ns() - began_ns) / (seconds * 1e9)) < 1 or number < 2:
            progress(min(1.0, share))
            first = number // 2 % len(names)
            order = names[first:] + names[:first]
            for name in order[
                :: 1 if number % 2 else -1
            ]:  # no host is always first, or always behind another
                if not _turn(hosts[name], found[name], most, turn_ns):
                    recover(name)
            number += 1
    progress(1.0)
    return found


def _turn(host: Host, found: Measured, most: int, turn_ns: int) -> bool:
    """Let one host exchange; return False when it lost a reply, which ends its turn and leaves it out."""
    exchange, now_ns = host.exchange, time.monotonic_ns
    for _ in range(WARM):
        if not exchange():
            found.lost += 1
            return False
    walls: list[int] = []
    end_ns = now_ns() + turn_ns
    processor = time.process_time_ns()
    before = began_ns = now_ns()
    while not walls or (len(walls) < most and before < end_ns):
        if not exchange():
            found.lost += 1
            return False
        after = now_ns()
        walls.append(after - before)
        before = after
    found.processor_ns.append((time.process_time_ns() - processor) / len(walls))
    found.walls_ns.append(walls)
    found.starts_ns.append(began_ns)
    return True


@contextmanager
def _undisturbed() -> Iterator[None]:
    """Keep the collector away and let sleeps end in time, as the loop does."""
    gc.collect()
    gc.freeze()
    gc.disable()
    libc = ctypes.CDLL(None)
    slack_ns = libc.prctl(_PR_GET_TIMERSLACK, 0, 0, 0, 0)
    libc.prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0)
    try:
        yield
    finally:
        libc.prctl(_PR_SET_TIMERSLACK, slack_ns, 0, 0, 0)
        gc.enable()
        gc.unfreeze()


def cores() -> tuple[int, int]:
    """Return the core for the host and the one for the responder: two different ones where there are two."""
    allowed = sorted(os.sched_getaffinity(0))
    return allowed[0], allowed[-1]


@contextmanager
def on_core(core: int) -> Iterator[None]:
    """Stay on one core meanwhile."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {core})
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)
