"""Tape: read a log twice in constant memory, first an overview of the whole, then cycle by cycle."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import cast

import numpy as np
from numpy.typing import NDArray

from dxlrun import Log, LogError, LogReader
from dxlrun.tooling.records import Event, EventCode, TakenCommand

_SCALARS = (
    "cycle",
    "scheduled_ns",
    "woken_ns",
    "read_ns",
    "updated_ns",
    "written_ns",
    "period_ns",
    "skipped",
    "active",
    "command_count",
)
_EVENTS = frozenset(
    (
        EventCode.SERVO_LIMITS,
        EventCode.STEERED,
        EventCode.COMMAND_REFUSED,
        EventCode.POLICY,
        EventCode.RECORDER_GAP,
        EventCode.LOOP_STOPPED,
    )
)
AHEAD_NS = 5_000_000_000
"""Time that the tape reads ahead: the largest delay of messages behind their cycle in the log. The
recorder drains one ring after the other."""


def overview(reader: LogReader) -> Log:
    """Read a whole log, but return only the data that a replay needs before the first cycle.

    These are the scalar fields of the cycles, the relevant events, and all commands, without packets and
    topics.

    Raises:
        LogError: As in `open_log`.
    """
    first: Log | None = None
    cycles: list[NDArray[np.void]] = []
    commands: list[TakenCommand] = []
    events: list[Event] = []
    damage: list[str] = []
    activation: NDArray[np.void] | None = None
    for part in reader.slices():
        first = part if first is None else first
        cycles.append(_scalars(part.cycles))
        commands += part.commands
        events += [event for event in part.events if event.code in _EVENTS]
        damage += [sentence for sentence in part.damage if sentence not in damage]
        activation = part.activation if activation is None else activation
    about = reader.about
    damage += [sentence for sentence in about.damage if sentence not in damage]
    return replace(
        about,
        cycles=np.concatenate(cycles) if cycles else _scalars(about.cycles),
        events=tuple(events),
        commands=tuple(commands),
        activation=activation,
        complete=not damage,
        damage=tuple(damage),
    )


def _scalars(cycles: NDArray[np.void]) -> NDArray[np.void]:
    found = np.empty(len(cycles), [(name, "<i8") for name in _SCALARS])
    for name in _SCALARS:
        found[name] = cycles[name]
    return cast("NDArray[np.void]", found)


class Tape:
    """Reader of the cycles of a log one after the other, and of the messages a few seconds ahead."""

    def __init__(
        self, reader: LogReader, woken_ns: NDArray[np.int64], messages: Callable[[Log], None]
    ) -> None:
        """Create a tape.

        Args:
            reader: The log.
            woken_ns: Wake-up times of all cycles.
            messages: Function that receives each slice when it is read.
        """
        self._slices: Iterator[Log] = reader.slices()
        self._woken_ns = woken_ns
        self._messages = messages
        self._parts: deque[NDArray[np.void]] = deque()
        self._first = self._end = 0
        """Index of the first buffered cycle, and of the first that is not read yet."""
        self._read_all = False

    def row(self, index: int) -> np.void:
        """Return the cycle with this index. Indices must ascend; only the preceding cycle can be read again.

        Raises:
            LogError: The log cannot be read, or has changed.
        """
        self._read_until(index)
        while self._parts and self._first + len(self._parts[0]) < index:  # The preceding cycle is kept
            self._first += len(self._parts.popleft())
        at = index - self._first
        for part in self._parts:
            if at < len(part):
                return cast("np.void", part[at])
            at -= len(part)
        raise LogError(f"the log was changed while it was read: cycle number {index} is gone")

    def _read_until(self, index: int) -> None:
        until_ns = int(self._woken_ns[index]) + AHEAD_NS
        while not self._read_all and (self._end <= index or self._woken_ns[self._end - 1] < until_ns):
            part = next(self._slices, None)
            if part is None:
                self._read_all = True
                return
            self._messages(part)
            if len(part.cycles):
                self._parts.append(part.cycles)
                self._end += len(part.cycles)
