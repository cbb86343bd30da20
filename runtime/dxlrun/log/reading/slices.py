"""Slices: decodes messages of a log into cycles, packets, events, commands and topics."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import cast

import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from dxlrun.channels.commands import TakenCommand, data_of
from dxlrun.channels.cycle import CycleLayout
from dxlrun.channels.event_records import Event
from dxlrun.errors import LogError, counted, suggestion
from dxlrun.log import schemas
from dxlrun.log.columns import PacketColumns
from dxlrun.log.packing.bus_messages import read_packets
from dxlrun.log.reading.chunks import Messages
from dxlrun.log.reading.logged_topics import LoggedTopic
from dxlrun.log.reading.walk import LogWalk
from dxlrun.log.schemas import CycleSpan, LoggedController, LogHeader
from dxlrun.messages.cdr import ENCAPSULATION, Codec, Value
from dxlrun.messages.cdr_columns import pieces
from dxlrun.messages.definition import MessageType
from dxlwire.modes import Mode

_FOR_OTHERS = frozenset(
    (
        schemas.LogTopic.ROSOUT,
        schemas.LogTopic.JOINT_STATES,
        schemas.LogTopic.JOINT_COMMANDS,
        schemas.LogTopic.DIAGNOSTICS,
        schemas.LogTopic.ROBOT_DESCRIPTION,
        schemas.LogTopic.FRAMES,
        schemas.LogTopic.STILL_FRAMES,
    )
)
"""Topics written for other tools; they are not decoded, because other topics have the same data."""
_OWN = frozenset(
    (
        schemas.LogTopic.CYCLE,
        schemas.LogTopic.ACTIVATION,
        schemas.LogTopic.COMMANDS,
        schemas.LogTopic.EVENT,
    )
)
"""Topics of dxlrun that this module decodes into cycles, commands and events."""
_MOST_HELD = 4096
"""Most cycles that wait for their packets, or packets for their cycles: recorders took up to 2000 records of
one ring in turn."""
_MOST_PACKETS_HELD = 1 << 18
_NO_PACKETS = PacketColumns.from_packets(())


@dataclass(frozen=True)
class Log:
    """A run, or a slice of one, decoded from its log.

    Times are ns of the run's clock; wall time = time + `epoch_offset_ns`.
    """

    path: Path
    header: LogHeader
    cycles: NDArray[np.void]
    """One record per cycle, read-only, with the fields of CycleLayout: scalars, and rows of joints or
    controllers."""
    events: tuple[Event, ...]
    attachments: dict[str, bytes]
    metadata: dict[str, dict[str, str]]
    complete: bool
    """True if the recorder finished the file and nothing in it is damaged."""
    damage: tuple[str, ...]
    """A sentence for each missing or unreadable piece of the log."""
    being_written: bool = False
    """True if a run was still writing the file when it was read."""
    packets: PacketColumns = field(default_factory=lambda: PacketColumns.from_packets(()))
    """All packets, grouped by bus, each bus in the order of recording."""
    activation: NDArray[np.void] | None = None
    """States and goals when the controllers were activated, shape (1,), as `cycles`; None if the log lacks
    them."""
    commands: tuple[TakenCommand, ...] = ()
    """Commands in the order in which cycles passed them to controllers or to the loop."""
    topics: Mapping[str, LoggedTopic] = field(default_factory=dict)
    """Messages of controllers' topics and of the runtime's `/goals`, by topic."""

    part: int = 0
    """Number of the log's first existing part; above 0, the beginning of the run was deleted."""

    def slices(self, *, packets: bool = True) -> Iterator[Log]:
        """Yield the log itself, as LogReader yields its pieces."""
        yield self

    @property
    def about(self) -> Log:
        """The log itself, as LogReader has it without records."""
        return self

    def messages(self, topic: str) -> list[Mapping[str, Value]]:
        """Return the decoded messages of a topic as mappings from field to value.

        Raises LogError when the log does not have the topic.
        """
        if topic not in self.topics:
            raise LogError(f"{self.path}: no topic {topic}; {suggestion(topic, tuple(self.topics))}")
        return self.topics[topic].messages()

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints, in the order of rows in `cycles`."""
        return self.header.joints

    @property
    def buses(self) -> tuple[str, ...]:
        """Names of the buses; `packets.bus` contains indices into this tuple."""
        return self.header.buses

    @property
    def controllers(self) -> tuple[LoggedController, ...]:
        """Controllers of the run; their order is that of the bits in masks of `cycles`."""
        return self.header.controllers

    @property
    def period_ns(self) -> int:
        """Planned period of the loop, ns."""
        return self.header.period_ns


class Slicer:
    """Converts messages of a log, in file order, into slices with complete cycles and all their packets.

    Cycles and packets reach the recorder through different rings. Those without a counterpart wait for the
    next slice.
    """

    def __init__(self, header: LogHeader, walk: LogWalk, *, packets: bool = True) -> None:
        """Prepare for a log; `walk` supplies the channels, `packets` says whether to decode packets."""
        self._header, self._walk, self._file = header, walk, walk.file
        self._layout = header.layout
        self._buses = {schemas.bus_topic(bus): index for index, bus in enumerate(header.buses)}
        self._with_packets = packets
        self._cycles = np.zeros(0, self._layout.dtype)
        self._packets = _NO_PACKETS
        self._activation: NDArray[np.void] | None = None
        self._names: dict[int, str] = {}
        self._span = CycleSpan()
        self.wrong = 0
        """Number of damaged packet messages that were skipped."""

    def add_messages(self, messages: Messages) -> Log:
        """Decode more messages; return all cycles that are complete now, with packets, events and topics.

        Raises ValueError for messages that cannot be decoded.
        """
        bodies: dict[str, list[bytes]] = {}
        cycle_rows = np.zeros(0, np.int64)
        topics: dict[str, LoggedTopic] = {}
        buses: dict[int, int] = {}
        for channel in np.unique(messages.channel).tolist():
            known = self._file.channels.get(channel)
            if known is None:
                raise ValueError(f"a message is of the unknown channel {channel}")
            topic = known.topic
            if topic in _FOR_OTHERS:
                continue
            if topic in self._buses:
                buses[channel] = self._buses[topic]
                continue
            rows = np.flatnonzero(messages.channel == channel)
            if topic == schemas.LogTopic.CYCLE:
                cycle_rows = np.append(cycle_rows, rows)
            elif topic in _OWN:
                bodies.setdefault(topic, []).extend(messages.bodies(rows))
            elif not topic.startswith(schemas.BUS_PREFIX):
                logged = self._topic(channel, messages, rows)
                before = topics.get(logged.name)
                topics[logged.name] = logged if before is None else joined_topic((before, logged))
        packets = self._read_packets(messages, buses) if self._with_packets else _NO_PACKETS
        activation = None
        if self._activation is None and schemas.LogTopic.ACTIVATION in bodies:
            message = np.frombuffer(bodies[schemas.LogTopic.ACTIVATION][0], np.uint8)
            activation = self._activation = _cycles(
                self._layout, message, np.zeros(1, np.int64), np.array([len(message)])
            )
        cycles = _cycles(self._layout, messages.data, messages.start[cycle_rows], messages.size[cycle_rows])
        for record in (activation, cycles[:1], cycles[-1:]):
            if record is not None and len(record):
                self._span.extend_span(record[0], self._header.period_ns)
        cycles = joined_cycles([self._cycles, cycles])
        return replace(
            self._slice(cycles, packets, last=not self._with_packets),
            activation=activation,
            events=_events(bodies.get(schemas.LogTopic.EVENT, [])),
            commands=_commands(bodies.get(schemas.LogTopic.COMMANDS, [])),
            topics=topics,
        )

    def remaining_slice(self) -> Log:
        """Return the cycles and packets that were still waiting after the last message."""
        return self._slice(self._cycles, _NO_PACKETS, last=True)

    def about(self) -> Log:
        """Return a log without records, with metadata, damage and topic names found so far."""
        damage = list(self._file.damage)
        if self.wrong:
            them = counted(self.wrong, "message of packets is", "messages of packets are")
            damage.append(f"{them} damaged and skipped")
        if not self._file.finished:
            damage.append(f"{self._walk.no_end}; {self._span.last_cycle_text}")
        empty = self._log(self._cycles[:0], _NO_PACKETS)
        return replace(
            empty,
            damage=tuple(damage),
            complete=not damage,
            being_written=self._walk.is_being_written,
            activation=self._activation,
            topics={
                name: LoggedTopic(name, self._file.channels[channel].type, np.zeros(0, np.int64), ())
                for channel, name in self._names.items()
            },
        )

    def _log(self, cycles: NDArray[np.void], packets: PacketColumns) -> Log:
        return Log(
            path=self._walk.path,
            header=self._header,
            cycles=cycles,
            events=(),
            attachments=self._file.attachments,
            metadata=self._file.metadata,
            complete=True,
            damage=(),
            part=self._walk.first_part,
            packets=packets,
        )

    def _slice(self, cycles: NDArray[np.void], packets: PacketColumns, *, last: bool) -> Log:
        """Return the complete cycles with their packets, and keep the others for the next slice."""
        found = [part for part in (self._packets, packets) if len(part)]
        joined = PacketColumns.joined(found)
        if len(found) > 1:
            joined = joined.select_rows(np.argsort(joined.bus, kind="stable"))
        bound = _FOREVER if last else self._bound(cycles, joined)
        whole, ready = cycles["cycle"] < bound, joined.cycle < bound
        self._cycles, self._packets = _chosen(cycles, ~whole), joined.select_rows(~ready).compact()
        return self._log(_chosen(cycles, whole), joined if ready.all() else joined.select_rows(ready))

    def _bound(self, cycles: NDArray[np.void], packets: PacketColumns) -> int:
        """Return the number of the first cycle that may still get packets; all below it are complete."""
        if len(cycles) > _MOST_HELD or len(packets) > _MOST_PACKETS_HELD:
            return _FOREVER
        newest = int(cycles["cycle"][-1]) if len(cycles) else 0
        if any(known.topic in self._buses for known in self._file.channels.values()):
            return min(newest, int(packets.cycle.max()) if len(packets) else 0)
        return newest

    def _read_packets(self, messages: Messages, buses: Mapping[int, int]) -> PacketColumns:
        """Decode the packets of all buses; `buses` maps channel numbers to bus indices."""
        rows = [np.flatnonzero(messages.channel == channel) for channel in buses]
        if not rows:
            return _NO_PACKETS
        bus = [np.full(len(own), at, np.uint8) for at, own in zip(buses.values(), rows, strict=True)]
        all_rows = np.concatenate(rows)
        start, size = messages.start[all_rows], messages.size[all_rows]
        packets, wrong = read_packets(messages.data, np.concatenate(bus), start, size)
        self.wrong += wrong
        return packets

    def _topic(self, channel: int, messages: Messages, rows: NDArray[np.int64]) -> LoggedTopic:
        known = self._file.channels[channel]
        if not known.text and not known.type_name:
            raise ValueError(f"the topic {known.topic} has no definition")
        if channel not in self._names:
            # A controller that was loaded again may publish another message type on the same topic.
            others = [one for at, one in self._file.channels.items() if at < channel]
            same = [one for one in others if one.topic == known.topic]
            other = same and (same[0].type_name, same[0].text) != (known.type_name, known.text)
            self._names[channel] = f"{known.topic} ({known.type_name})" if other else known.topic
        t_ns = messages.t_ns[rows] - self._header.epoch_offset_ns
        return LoggedTopic(self._names[channel], known.type, t_ns, tuple(messages.bodies(rows)))


_FOREVER = int(np.iinfo(np.int64).max)


def joined_topic(parts: Sequence[LoggedTopic]) -> LoggedTopic:
    """Concatenate the messages of one topic from several slices."""
    t_ns = np.concatenate([part.t_ns for part in parts])
    return structs.replace(
        parts[0], t_ns=t_ns, data=tuple(message for part in parts for message in part.data)
    )


def joined_cycles(parts: Sequence[NDArray[np.void]]) -> NDArray[np.void]:
    """Concatenate cycle records byte for byte, with their padding, which NumPy would not copy."""
    some = [part for part in parts if len(part)]
    if len(some) < 2:
        return some[0] if some else parts[0]
    dtype = some[0].dtype
    return np.concatenate([part.view(_bytes(dtype)) for part in some]).view(dtype)


def _chosen(cycles: NDArray[np.void], rows: NDArray[np.bool_]) -> NDArray[np.void]:
    count = int(np.count_nonzero(rows))
    if rows[:count].all():
        return cycles[:count]
    if rows[len(rows) - count :].all():
        return cycles[len(rows) - count :]
    found: NDArray[np.void] = cycles.view(_bytes(cycles.dtype))[rows].view(cycles.dtype)
    return found


def _bytes(dtype: np.dtype[np.void]) -> np.dtype[np.void]:
    return np.dtype((np.void, dtype.itemsize))


def joined(about: Log, slices: Sequence[Log]) -> Log:
    """Join slices into one log; `about` supplies header, metadata and damage."""
    packets = PacketColumns.joined([part.packets.compact() for part in slices if len(part.packets)])
    if len(about.buses) > 1:
        packets = packets.select_rows(np.argsort(packets.bus, kind="stable"))
    topics: dict[str, list[LoggedTopic]] = {name: [topic] for name, topic in about.topics.items()}
    for part in slices:
        for name, topic in part.topics.items():
            topics.setdefault(name, []).append(topic)
    return replace(
        about,
        cycles=joined_cycles([about.cycles, *(part.cycles for part in slices)]),
        packets=packets,
        events=tuple(event for part in slices for event in part.events),
        commands=tuple(command for part in slices for command in part.commands),
        topics={name: joined_topic(parts) for name, parts in topics.items()},
    )


def _cycles(
    layout: CycleLayout, data: NDArray[np.uint8], start: NDArray[np.int64], size: NDArray[np.int64]
) -> NDArray[np.void]:
    """Return the cycle records in messages of /cycle, checked for length and known modes."""
    if (size != len(ENCAPSULATION) + layout.size).any():
        raise ValueError("the messages of /cycle do not fit the numbers of joints and controllers")
    bodies = pieces(data, start + len(ENCAPSULATION), size - len(ENCAPSULATION))
    array: NDArray[np.void] = bodies.view(layout.dtype)
    unknown = np.flatnonzero((array["mode"] > max(Mode)).any(axis=1))
    if len(unknown):
        raise ValueError(f"cycle {array['cycle'][unknown[0]]} has an unknown mode of a servo")
    return array


def _commands(messages: list[bytes]) -> tuple[TakenCommand, ...]:
    return tuple(
        TakenCommand(
            t_ns=cast("int", values["t_ns"]),
            cycle=cast("int", values["cycle"]),
            planned=cast("int", values["planned"]),
            controller=str(values["controller"]),
            kind=str(values["kind"]),
            origin=str(values["origin"]),
            data=data_of(
                str(values["controller"]),
                str(values["text"]),
                cast("NDArray[np.float64]", values["data"]),
            ),
            lease_ns=cast("int", values["lease_ns"]),
            request=str(values["request"]).encode(),
        )
        for values in map(_codec(schemas.COMMAND).unpack, messages)
    )


@cache
def _codec(message: MessageType) -> Codec:
    return Codec(message)


def _events(messages: list[bytes]) -> tuple[Event, ...]:
    return tuple(
        Event(
            t_ns=cast("int", values["t_ns"]),
            code=cast("int", values["code"]),
            severity=cast("int", values["severity"]),
            source=str(values["source"]),
            text=str(values["text"]),
            data=str(values["data"]).encode(),
        )
        for values in map(_codec(schemas.EVENT).unpack, messages)
    )
