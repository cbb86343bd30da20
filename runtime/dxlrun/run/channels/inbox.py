"""Inbox: commands on their way into the loop, from whoever may steer it; the loop looks in once a cycle.

A command is for one controller, or for the loop itself (its name is then LOOP): switch, rate, pause, resume,
load, unload, stop. Both are prepared and checked before they come here, and both are in the log.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

LOOP = ""
"""Name of the addressee of a command that is for the loop itself; no controller can be called so."""

MOST_PER_CYCLE = 8
"""Commands that one cycle takes; the others wait for the next."""


@dataclass(frozen=True, slots=True)
class Command:
    """What somebody wants of a controller, or of the loop."""

    number: int
    """The sender's; the answer names it."""
    controller: str
    kind: str
    data: bytes
    """For a controller what its `prepare` made, little-endian float64; for the loop JSON (UTF-8)."""
    origin: str
    """Who asked, for the log."""
    lease_ns: int = 0
    """For how long it counts unless another one follows, ns; 0: for ever."""


class Inbox(Protocol):
    """Where the loop finds commands; never blocks, never raises."""

    def take(self) -> Sequence[Command]:
        """Return what has come, in order, at most MOST_PER_CYCLE and the newest set-point of each stream."""
        ...

    def answer(self, number: int, refusal: str) -> None:
        """Tell the sender what became of a command: done when `refusal` is empty, else why not."""
        ...


class NoInbox:
    """Nobody steers this loop."""

    def take(self) -> Sequence[Command]:
        """Return nothing."""
        return ()

    def answer(self, number: int, refusal: str) -> None:
        """Forget it: nobody asked."""


class QueueInbox:
    """Commands from the same process, on virtual time; `answers` holds the refusal of each number."""

    def __init__(self) -> None:
        self.waiting: deque[Command] = deque()
        self.answers: dict[int, str] = {}

    def take(self) -> Sequence[Command]:
        """Return what has been put into `waiting`."""
        if not self.waiting:
            return ()
        return [self.waiting.popleft() for _ in range(min(len(self.waiting), MOST_PER_CYCLE))]

    def answer(self, number: int, refusal: str) -> None:
        """Keep the answer."""
        self.answers[number] = refusal
