"""Snapshots: every 10 s the state of the loop and of each controller, for the log; a little in each cycle."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Protocol

import numpy as np

from dxlrun.channels.cycle import CycleRecord
from dxlrun.channels.snapshots import INTERVAL_NS, MOST_PIECES, TOPIC, SnapshotPiece, pieces_of
from dxlrun.clock import Clock
from dxlrun.control.controllers.manager import Manager
from dxlrun.control.controllers.topics import Publisher, TopicLog
from dxlrun.control.state.loop_state import LoopState, encoded
from dxlrun.control.state.object_state import StateError
from dxlrun.messages import Header

MOST_SHARE = 0.5
"""Of a period that the state of one controller may take to be written down; one that took longer twice has no
snapshots any more."""
_STRIKES = 2


class _Loop(Protocol):
    """What has the state of the loop itself."""

    def snapshot(self) -> LoopState:
        """Return it."""
        ...


class Snapshots:
    """Takes states in rounds: that of the loop, and in later cycles one controller after the other."""

    __slots__ = (
        "_clock",
        "_due_ns",
        "_left",
        "_manager",
        "_message",
        "_open",
        "_pieces",
        "_publisher",
        "_record",
        "_slow",
    )

    def __init__(self, manager: Manager, record: CycleRecord, clock: Clock, topics: TopicLog) -> None:
        self._manager = manager
        self._record = record
        self._clock = clock
        self._open = topics.declared(TOPIC, SnapshotPiece)
        self._publisher: Publisher | None = None
        self._pieces: Iterator[bytes] = iter(())
        self._left: list[str] = []
        self._due_ns = 0
        self._slow: dict[str, int] = {}
        """By controller: how often it took too long."""
        self._message = SnapshotPiece(Header(), 0, "", 0, 0, np.empty(0, np.uint8))

    def step(self, loop: _Loop, period_ns: int) -> int:
        """Let out a piece, or take the next state; at the end of a cycle.

        Return when it is to be called again, ns of the run's clock; 0: in the next cycle.
        """
        message = self._message
        if message.piece < message.pieces:
            self._publish(next(self._pieces))
            return self._next_ns()
        if self._manager.keeping:  # what leaves would have to be in the state
            return 0
        if not self._left:
            self._due_ns = self._record.woken_ns + INTERVAL_NS
            self._left = self._manager.loaded
            self._begin("", encoded(loop.snapshot()))
            return self._next_ns()
        name = self._left.pop(0)
        if name in self._manager.loaded:
            self._begin(name, self._taken(name, period_ns))
        return self._next_ns()

    def _next_ns(self) -> int:
        message = self._message
        return 0 if self._left or message.piece < message.pieces else self._due_ns

    def _taken(self, name: str, period_ns: int) -> bytes:
        """Return the state of a controller, or why it has none."""
        if self._slow.get(name, 0) >= _STRIKES:
            problem = f"its snapshots took more than {MOST_SHARE:.0%} of a period"
            return encoded(self._manager.snapshot_of(name, _refusing(problem)))
        begun_ns = self._clock.now_ns()
        data = encoded(self._manager.snapshot_of(name))
        if self._clock.now_ns() - begun_ns > MOST_SHARE * period_ns:
            self._slow[name] = self._slow.get(name, 0) + 1
        return data

    def _begin(self, controller: str, data: bytes) -> None:
        message = self._message
        message.cycle, message.controller, message.piece = self._record.cycle, controller, 0
        message.pieces, self._pieces = pieces_of(data)
        if message.pieces > MOST_PIECES:  # thousands of points that are played: the next round may have fewer
            message.pieces = 0
            return
        self._publish(next(self._pieces))

    def _publish(self, data: bytes) -> None:
        message = self._message
        message.data = np.frombuffer(data, np.uint8)
        if self._publisher is None:  # a short run has no such topic
            self._publisher = self._open()
        self._publisher.publish(message)
        message.piece += 1


def _refusing(problem: str) -> Callable[[], bytes]:
    def refuse() -> bytes:
        raise StateError(problem)

    return refuse
