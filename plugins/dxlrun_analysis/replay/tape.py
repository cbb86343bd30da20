"""Tape: a log gone through twice in flat memory: first what is needed of all of it, then cycle by cycle."""

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
"""How much later than a cycle the log may have its messages: the recorder empties ring after ring."""


def overview(reader: LogReader) -> Log:
    """Return what a replay needs of all of a log before its cycles: the scalars of these, the events that
    matter and all commands; no packets and topics. Raises LogError as `open_log`."""
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
    """The cycles of a log, one after the other, with a few seconds of what follows."""

    def __init__(
        self, reader: LogReader, woken_ns: NDArray[np.int64], messages: Callable[[Log], None]
    ) -> None:
        """`messages` takes each slice when it is read; `woken_ns`: of all cycles."""
        self._slices: Iterator[Log] = reader.slices()
        self._woken_ns = woken_ns
        self._messages = messages
        self._parts: deque[NDArray[np.void]] = deque()
        self._first = self._end = 0
        """Indices of the first cycle that is there, and of the first that is not read yet."""
        self._read_all = False

    def row(self, index: int) -> np.void:
        """Return a cycle; one before the last one that was asked for may be gone. Raises LogError."""
        self._read_until(index)
        while self._parts and self._first + len(self._parts[0]) < index:  # the one before is kept
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
