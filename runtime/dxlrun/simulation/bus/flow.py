"""Answers of a read in turn that nobody disturbs: all of them are known when the instruction ends.

As long as nothing comes between them there is nothing to decide on the way. As soon as something does, the
bus breaks a flow up into what it stands for: bytes that have passed the line, those on it, and who waits.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Iterator, Sequence

from dxlrun.simulation.bus.ledger import Passed
from dxlrun.simulation.bus.wire import STATUS_BYTES, Chain, Chunk
from dxlrun.simulation.wire.packets import ReadEntry, ReadInTurn, Reply

Answers = Sequence[tuple[ReadEntry, list[Reply]]]
"""Who was asked, and who answered."""


class Flow:
    """What servos say one after the other; it may begin again when it is over."""

    __slots__ = (
        "_answers",
        "_begin_ns",
        "_dues",
        "_duration_ns",
        "_firsts",
        "_given",
        "_parts",
        "_passed",
        "_reading",
        "_slots",
        "lasts_ns",
    )

    def __init__(
        self,
        reading: ReadInTurn,
        answers: Answers,
        parts: Sequence[bytes],
        duration_ns: Callable[[int], int],
        slots: bool,
    ) -> None:
        """`answers`: one of each servo; `parts`: their bytes; `duration_ns`: how long so many bytes take.

        `slots`: the others go on when one of them falls out.
        """
        self._slots = slots
        self._reading = reading
        self._answers = answers
        self._parts = tuple(parts)
        self._duration_ns = duration_ns
        firsts, dues, free_ns = [], [], 0
        for (_, (reply,)), part in zip(answers, parts, strict=True):
            firsts.append(free_ns + reply.delay_ns)
            free_ns = firsts[-1] + duration_ns(len(part))
            dues.append(free_ns)
        self._firsts, self._dues = firsts, tuple(dues)
        self.lasts_ns = free_ns
        """So long after the instruction the last answer ends."""
        self._begin_ns = 0
        self._passed = self._given = 0

    def begin(self, t_ns: int) -> Flow:
        """Let the servos answer an instruction that ended at a time; return the flow."""
        self._begin_ns = t_ns
        self._passed = self._given = 0
        return self

    @property
    def over(self) -> bool:
        """True when the host has got everything."""
        return self._given == len(self._parts)

    def next_ns(self) -> int:
        """Return when the host can be given something."""
        return self._begin_ns + self._dues[self._given]

    def gathered_ns(self, within_ns: int) -> int:
        """Return when the last answer has passed that does so within a time after the next one."""
        dues = self._dues
        if self._passed > self._given:
            return self.next_ns()
        latest_ns = dues[self._given] + within_ns
        if self.lasts_ns <= latest_ns:
            return self._begin_ns + self.lasts_ns
        return self._begin_ns + dues[bisect_right(dues, latest_ns) - 1]

    def pass_until(self, now_ns: int) -> None:
        """Let pass the line what does so until a time."""
        passed = bisect_right(self._dues, now_ns - self._begin_ns)
        self._passed = max(passed, self._passed)

    def give(self, bus: str, handed_ns: int | None) -> Passed:
        """Return what has passed since the last time."""
        first, last = self._given, self._passed
        self._given = last
        if last - first == len(self._parts):
            return Passed(bus, self._begin_ns, self._dues, self._parts, handed_ns)
        return Passed(bus, self._begin_ns, self._dues[first:last], self._parts[first:last], handed_ns)

    def break_up(self) -> tuple[list[Chunk], list[Chunk]]:
        """Return what has passed and was not given, and what is on the line: the others wait for its end."""
        begin_ns, index = self._begin_ns, self._passed
        arrived = [self._chunk(each, None) for each in range(self._given, index)]
        self._given = self._passed = len(self._parts)
        if index == len(self._parts):
            return arrived, []
        fast = Repeated(self._parts[index + 1 :]) if self._reading.fast else None
        chain = Chain(self._reading, deque(self._answers[index + 1 :]), fast, self._slots)
        length = self._answers[index][0].length
        chain.slot_end_ns = begin_ns + self._firsts[index] + self._duration_ns(STATUS_BYTES + length)
        return arrived, [self._chunk(index, chain)]

    def _chunk(self, index: int, chain: Chain | None) -> Chunk:
        first_ns, due_ns = self._begin_ns + self._firsts[index], self._begin_ns + self._dues[index]
        return Chunk(first_ns, due_ns, self._parts[index], "", chain)


class Repeated:
    """A status packet that several servos put together, of which the rest is known."""

    __slots__ = ("_parts",)

    def __init__(self, parts: Sequence[bytes]) -> None:
        self._parts: Iterator[bytes] = iter(parts)

    def part(self, _: Reply) -> bytes:
        """Return the bytes that the next servo adds."""
        return next(self._parts)
