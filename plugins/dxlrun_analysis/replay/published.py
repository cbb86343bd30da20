"""Messages that controllers publish in a replay, compared with those in the log byte by byte."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field

import msgspec
import numpy as np

from dxlrun import Log
from dxlrun.tooling.logs import UNREADABLE
from dxlrun.tooling.output import counted
from dxlrun.tooling.records import EventCode, LostRecords
from dxlrun.tooling.topics import Codec, LogTopic, MessageSink, MessageType, PublishedTopic
from dxlrun_analysis.replay.recorded_inputs import RecordedInputs, ReplayDifference

RING = "loop/messages"
_NOT_COMPARED = frozenset((LogTopic.MACHINE, "/snapshots"))
"""Topics that a replay does not publish. Only logs of earlier versions have /snapshots."""
_LONGEST_SHOWN = 120  # Characters


@dataclass(slots=True)
class _PendingTopic:
    """Topic of the log, with its recorded messages that were not compared yet."""

    type: MessageType
    waiting: deque[tuple[int, bytes]] = field(default_factory=deque)
    """Time (ns) and data of each recorded message that was not compared yet."""


class MessageComparison(MessageSink):
    """Receiver of the messages that a replayed loop publishes; compares each with the log.

    Topics that the log does not have are not compared: they are from an earlier dxlrun that did not publish
    them.
    """

    def __init__(self, inputs: RecordedInputs) -> None:
        """Create a comparison without recorded messages; `add_messages` adds them."""
        self.first: ReplayDifference | None = None
        self._first_ns = 0
        self.compared = 0
        self.different = 0
        self._topics: dict[str, _PendingTopic] = {}
        self._announced: list[PublishedTopic] = []
        self._inputs = inputs
        self._until_ns = int(inputs.log.cycles["woken_ns"][inputs.end - 1])
        self._whole = inputs.end == len(inputs.log.cycles) and any(
            event.code == EventCode.LOOP_STOPPED for event in inputs.log.events
        )
        """True if the run stopped normally with the last compared cycle: its messages are complete."""
        self.lost = _lost(inputs.log)
        """Number of messages that the recorder lost. If there are any, a message that only the replay has
        is not a difference."""

    @property
    def remarks(self) -> tuple[str, ...]:
        """Sentence about messages that the log lacks; empty if it has all."""
        if not self.lost:
            return ()
        return (f"the log lacks {counted(self.lost, 'message', 'messages')} of topics",)

    def add_messages(self, part: Log) -> None:
        """Add the recorded messages of a slice of the log."""
        for name, logged in part.topics.items():
            if name in _NOT_COMPARED:
                continue
            pending = self._topics.setdefault(name, _PendingTopic(logged.type))
            pending.waiting += zip(logged.t_ns.tolist(), logged.data, strict=True)

    def announce(self, topic: PublishedTopic) -> int:
        """Register a topic that the replayed loop publishes; return its number for `message`."""
        self._announced.append(topic)
        return len(self._announced) - 1

    def message(self, topic: int, t_ns: int, data: bytes) -> None:
        """Compare one message of the replay with the recorded message of the same topic and time."""
        announced = self._announced[topic]
        name = announced.name
        pending = self._topics.get(name)
        if pending is None or t_ns > self._until_ns:
            return
        self._pass(name, pending, t_ns)
        if pending.waiting and pending.waiting[0][0] == t_ns:
            recorded = pending.waiting.popleft()[1]
            self.compared += 1
            if recorded != data:
                self._differs(t_ns, name, *_where(pending.type, announced, recorded, data))
        elif not self.lost and (self._whole or t_ns < self._until_ns):
            self.compared += 1
            self._differs(t_ns, name, "", "no message", "a message")

    def report_missing(self, reached_ns: int) -> None:
        """Count recorded messages until `reached_ns` that the replay did not publish as differences."""
        for name, pending in self._topics.items():
            self._pass(name, pending, min(reached_ns, self._until_ns) + 1)

    def _pass(self, name: str, pending: _PendingTopic, t_ns: int) -> None:
        """Count recorded messages from before a time as differences: the replay did not publish them."""
        while pending.waiting and pending.waiting[0][0] < t_ns:
            at_ns, _ = pending.waiting.popleft()
            self.compared += 1
            self._differs(at_ns, name, "", "a message", "no message")

    def _differs(self, t_ns: int, topic: str, field: str, recorded: str, replayed: str) -> None:
        self.different += 1
        if self.first is None or t_ns < self._first_ns:
            self._first_ns = t_ns
            index = int(np.searchsorted(self._inputs.log.cycles["woken_ns"], t_ns, side="right")) - 1
            what = f"message of {topic}" + (f": {field}" if field else "")
            self.first = self._inputs.difference(index, what, None, None, recorded, replayed)


def _lost(log: Log) -> int:
    lost = 0
    for event in log.events:
        if event.code == EventCode.RECORDER_GAP:
            try:
                data = msgspec.json.decode(event.data, type=LostRecords)
            except UNREADABLE:
                continue
            lost += data.lost if data.ring == RING else 0
    return lost


def _where(
    logged: MessageType, now: PublishedTopic, recorded: bytes, replayed: bytes
) -> tuple[str, str, str]:
    """Return the first field of a message that differs, and its recorded and replayed value, as text."""
    if (logged.name, logged.text) != (now.type.name, now.type.text):
        return "", f"type {logged.name}", f"another definition of {now.type.name}"
    codec = Codec(now.type)
    try:
        then, here = (_leaves(codec.unpack(data), "") for data in (recorded, replayed))
    except ValueError:
        return "", f"{len(recorded)} bytes that are not a {now.type.name}", f"{len(replayed)} bytes"
    for place, value in then.items():
        if place not in here:
            return place, value, "nothing"
        if here[place] != value:
            return place, value, here[place]
    more = next((place for place in here if place not in then), "")
    return more, "nothing", here.get(more, "equal fields, encoded differently")


def _leaves(value: object, place: str) -> dict[str, str]:
    """Return all single values of a message as text, by their path: `error[1]`."""
    if isinstance(value, Mapping):
        parts = [(f"{place}.{name}" if place else str(name), one) for name, one in value.items()]
    elif isinstance(value, np.ndarray | list):
        parts = [(f"{place}[{index}]", one) for index, one in enumerate(value)]
    elif isinstance(value, float | np.floating):
        return {place: f"{float(value)!r}{'' if np.isfinite(value) else f' (bits {_bits(value)})'}"}
    else:
        return {place: str(value)[:_LONGEST_SHOWN]}
    found: dict[str, str] = {}
    for name, one in parts:
        found |= _leaves(one, name)
    return found


def _bits(value: float | np.floating) -> str:
    return f"{int(np.float64(value).view(np.uint64)):#018x}"
