"""What is planned for a simulated bus: actions at a time, or after so many instruction packets."""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Callable

Action = Callable[[], None]


class Agenda:
    """Actions in order; those of one moment in the order in which they were planned."""

    def __init__(self) -> None:
        self.next_ns: int | None = None
        """When the first action of a time is due."""
        self._timed: list[tuple[int, int, Action]] = []
        self._counted: list[tuple[int, int, Action]] = []
        self._packets = 0
        self._order = itertools.count()

    def at(self, t_ns: int, action: Action) -> None:
        """Plan an action for a time."""
        heapq.heappush(self._timed, (t_ns, next(self._order), action))
        self.next_ns = self._timed[0][0]

    def after(self, packets: int, action: Action) -> None:
        """Plan an action for when so many more packets have passed; 0 calls it now."""
        heapq.heappush(self._counted, (self._packets + packets, next(self._order), action))
        self._count_down()

    def pop(self) -> Action:
        """Return the first action of a time; raises IndexError when there is none."""
        action = heapq.heappop(self._timed)[2]
        self.next_ns = self._timed[0][0] if self._timed else None
        return action

    def packet_passed(self) -> None:
        """Count an instruction packet, and do what was planned for it."""
        self._packets += 1
        if self._counted:
            self._count_down()

    def _count_down(self) -> None:
        while self._counted and self._counted[0][0] <= self._packets:
            heapq.heappop(self._counted)[2]()
