"""The log: records of the rings become MCAP messages; two runs on virtual time give the same bytes."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import IO, TypeVar, cast

import msgspec
import numpy as np
import zstandard
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray

from dxlrun.channels.commands import TakenCommand
from dxlrun.channels.events import Event, EventCode, LostRecords, Severity
from dxlrun.channels.messages import OpenedTopic, TopicMessage
from dxlrun.channels.packets import BatchedPacket, split_packets
from dxlrun.channels.ring import Payload, RecordKind
from dxlrun.channels.tagged import decode
from dxlrun.errors import counted
from dxlrun.log import schemas
from dxlrun.log.log_file import LogFile
from dxlrun.log.packing.bus_messages import pack_packets
from dxlrun.log.packing.diagnostics import Diagnostics
from dxlrun.log.packing.frame_messages import Stamp, frame_messages
from dxlrun.log.schemas import LogHeader, LogSummary, to_metadata
from dxlrun.messages.cdr import ENCAPSULATION, Codec
from dxlrun.messages.definition import MessageType

Written = TypeVar("Written")
CHUNK_BYTES = 512 * 1024
"""A chunk with so many bytes of messages is written."""
_MOST_PACKETS, _MOST_CYCLES = 1000, 250
"""In one message. The index has 16 bytes a message, and arrays of many cycles compress better."""
_COMPRESSED_FROM = 16 * 1024
"""Bytes: an attachment of so many is compressed, as the plan is; shorter ones stay as text to read."""
_LIBRARY = "dxlrun"
_MEDIA_TYPES = {".json": "application/json", ".yaml": "application/yaml", ".txt": "text/plain"}
JOINT_COMMANDS_NS = 10_000_000
"""In so much time there is one message of /joint_commands; /cycle has the goals of each cycle."""


class LogWriter:
    """Writes one log; takes the records of the rings as they come.

    A disk that takes no more (OSError while writing) stops the writing, not the caller: the file is cut back
    to its last whole chunk, `error` says why, later records are counted. Only a file that cannot be created
    or begun raises OSError.
    """

    def __init__(self, path: Path, header: LogHeader) -> None:
        self.header = header
        self.error: str | None = None
        self.late_metadata: dict[str, dict[str, str]] = {}
        """Written at the end, beside the header's: what became known in the run."""
        self._layout = header.layout
        self._file = LogFile(path)
        self._messages = self._lost = self._unwritten = 0
        self.first_ns = self.last_ns = 0  # Of the messages so far
        self._whole_bytes = self._whole_messages = 0
        self._summary: LogSummary | None = None
        self._firsts: list[tuple[int, Callable[[Stamp], bytes]]] = []
        """Channels with one message, and what makes it of the time of the first record."""
        self._writer = Writer(
            cast("IO[bytes]", self._file), chunk_size=sys.maxsize, compression=CompressionType.ZSTD
        )
        self._chunk_bytes = 0
        self._sequences: dict[int, int] = {}
        self._known: dict[str, int] = {}
        """Schemas by the names of their messages."""
        self.topics: dict[bytes, None] = {}
        """Records of the topics that were opened."""
        self._topic_channels: dict[int, int] = {}
        """Channels of topics by their numbers."""
        self._machine_channel: int | None = None
        self._takers: dict[int, Callable[[Payload], None]] = {
            RecordKind.CYCLE: self._cycle,
            RecordKind.PACKETS: self._packets,
            RecordKind.TAGGED: self._tagged,
        }
        self._diagnostics = Diagnostics(header.joints)
        messages = (schemas.EVENT, schemas.ROS_LOG, schemas.JOINT_STATE, schemas.COMMAND)
        self._event, self._ros_log, self._joint_state, self._command = map(Codec, messages)
        try:
            self._begin()
        except BaseException:
            self._file.close()
            raise

    @property
    def size(self) -> int:
        """Bytes of the file so far; a chunk that is not finished does not count."""
        return self._file.tell()

    def _begin(self) -> None:
        header = self.header
        self._writer.start(profile=schemas.PROFILE, library=_LIBRARY)
        self._writer.add_metadata(schemas.METADATA_NAME, to_metadata(header))
        for name, record in sorted(header.metadata.items()):
            self._writer.add_metadata(name, dict(sorted(record.items())))
        own = {schemas.HEADER_ATTACHMENT: msgspec.json.format(msgspec.json.encode(to_metadata(header)))}
        for name, data in sorted({**header.attachments, **own}.items()):
            media = _MEDIA_TYPES.get(Path(name).suffix, "application/octet-stream")
            attached = name, media, data
            if len(data) >= _COMPRESSED_FROM:
                packed = zstandard.compress(data)
                attached = name + schemas.COMPRESSED_SUFFIX, schemas.COMPRESSED_TYPE, packed
            at_ns = max(0, header.epoch_offset_ns)
            self._writer.add_attachment(at_ns, at_ns, *attached)
        self._cycle_channel = self._channel(schemas.CYCLE_TOPIC, schemas.CYCLE)
        self._activation_channel = self._channel(schemas.ACTIVATION_TOPIC, schemas.CYCLE)
        self._taken_channel = self._channel(schemas.COMMANDS_TOPIC, schemas.COMMAND)
        self._states_channel = self._channel(schemas.JOINT_STATES_TOPIC, schemas.JOINT_STATE)
        self._commands_channel = self._channel(schemas.JOINT_COMMANDS_TOPIC, schemas.JOINT_STATE)
        self._diagnostics_channel = self._channel(schemas.DIAGNOSTICS_TOPIC, schemas.DIAGNOSTICS)
        self._event_channel = self._channel(schemas.EVENT_TOPIC, schemas.EVENT)
        self._rosout_channel = self._channel(schemas.ROSOUT_TOPIC, schemas.ROS_LOG)
        self._bus_channels = [
            self._channel(schemas.bus_topic(bus), schemas.BUS_PACKETS) for bus in header.buses
        ]
        self._waiting: list[list[BatchedPacket]] = [[] for _ in header.buses]
        """Packets that are not in a message yet, for each bus."""
        self._oldest: int | None = None
        """Cycle of the first of them."""
        self._commands_slot: int | None = None
        self._publishers = [
            (
                1 << index,
                controller.joints,
                np.array([header.joints.index(j) for j in controller.joints], int),
            )
            for index, controller in enumerate(header.controllers)
            if schemas.JOINT_STATES_TOPIC in controller.publishes
        ]
        latched = {"offered_qos_profiles": schemas.LATCHED}
        if header.robot_description is not None:
            channel = self._channel(schemas.ROBOT_DESCRIPTION_TOPIC, schemas.STRING, latched)
            description = Codec(schemas.STRING).pack(header.robot_description)
            self._firsts.append((channel, lambda _: description))
        self._frames = frame_messages(header)
        if self._frames is not None:
            self._frames_channel = self._channel(schemas.FRAMES_TOPIC, schemas.FRAMES)
            if self._frames.any_still:
                channel = self._channel(schemas.STILL_FRAMES_TOPIC, schemas.FRAMES, latched)
                self._firsts.append((channel, self._frames.still))
        self._end_chunk()

    def _channel(self, topic: str, message: MessageType, more: Mapping[str, str] | None = None) -> int:
        if message.name not in self._known:
            self._known[message.name] = self._writer.register_schema(
                message.name, schemas.SCHEMA_ENCODING, message.text.encode()
            )
        channel = self._writer.register_channel(
            topic,
            schemas.ENCODING,
            self._known[message.name],
            {"topic_type_hash": message.type_hash, **(more or {})},
        )
        self._sequences[channel] = 0
        return channel

    def _add(self, channel: int, t_ns: int, data: bytes) -> None:
        if self._firsts:  # the run begins with its first record, not when the log is opened
            firsts, self._firsts = self._firsts, []
            for first, message in firsts:
                self._add(first, t_ns, message(self._stamp(t_ns)))
        wall_ns = max(0, t_ns + self.header.epoch_offset_ns)
        sequence = self._sequences[channel]
        self._sequences[channel] = sequence + 1
        self._writer.add_message(channel, wall_ns, data, wall_ns, sequence & 0xFFFFFFFF)
        self._messages += 1
        self._chunk_bytes += len(data)
        self.first_ns = self.first_ns or t_ns
        self.last_ns = max(self.last_ns, t_ns)

    def _end_chunk(self) -> None:
        """Write the chunk, with the packets that belong to its cycles: what is behind it may be lost."""
        self._write_packets()
        self._writer.flush()
        self._whole_bytes, self._whole_messages = self._file.tell(), self._messages
        self._chunk_bytes = 0

    def _guarded(self, write: Callable[[Written], None], what: Written) -> None:
        """Write something, or count it when nothing can be written any more."""
        if self.error is None:
            write(what)
        else:
            self._unwritten += 1

    def _give_up(self, error: OSError) -> None:
        self.error = f"writing the log stopped: {error.strerror or error}"
        self._unwritten += self._messages - self._whole_messages
        self._messages = self._whole_messages
        try:
            self._file.truncate(self._whole_bytes)
        except OSError:
            return  # what lies behind the last whole chunk stays; a reader stops there

    def take(self, kind: int, payload: Payload) -> None:
        """Write one record of a ring. Raises ValueError when it is none that the log can hold."""
        if kind not in self._takers:
            raise ValueError(f"a record of kind {kind} does not belong into a log")
        self._guarded(self._takers[kind], payload)
        if self._chunk_bytes > CHUNK_BYTES:
            self.flush()

    def _cycle(self, payload: Payload) -> None:
        """Write a cycle: /cycle, the goals, the frames, and the states that controllers marked; before the
        first one /activation."""
        data = bytes(payload)
        record = np.frombuffer(data, dtype=self._layout.dtype)[0]
        written_ns, read_ns = int(record["written_ns"]), int(record["read_ns"])
        if int(record["cycle"]) < 0:
            self._add(self._activation_channel, written_ns, ENCAPSULATION + data)
            return
        self._add(self._cycle_channel, written_ns, ENCAPSULATION + data)
        published = int(record["published"])
        for bit, joints, rows in self._publishers:
            if published & bit:
                self._joint_states(read_ns, joints, record, rows)
        frames = None if self._frames is None else self._frames.of(record, self._stamp(read_ns))
        if frames is not None:
            self._add(self._frames_channel, read_ns, frames)
        slot = int(record["scheduled_ns"]) // JOINT_COMMANDS_NS
        if slot != self._commands_slot:
            self._commands_slot = slot
            self._joint_commands(written_ns, record)
        diagnostics = self._diagnostics.of(record, written_ns, self._stamp(written_ns))
        if diagnostics is not None:
            self._add(self._diagnostics_channel, written_ns, diagnostics)

    def _joint_commands(self, t_ns: int, record: np.void) -> None:
        goals = (record[name] for name in ("goal_position", "goal_velocity", "goal_effort"))
        data = self._joint_state.pack((self._stamp(t_ns), ""), self.header.joints, *goals)
        self._add(self._commands_channel, t_ns, data)

    def _joint_states(
        self, t_ns: int, joints: tuple[str, ...], record: np.void, rows: NDArray[np.int_]
    ) -> None:
        stale = ~record["valid"][rows]
        values = []
        for name in ("position", "velocity", "effort"):
            row = record[name][rows]
            row[stale] = np.nan
            values.append(row)
        data = self._joint_state.pack((self._stamp(t_ns), ""), joints, *values)
        self._add(self._states_channel, t_ns, data)

    def _stamp(self, t_ns: int) -> Stamp:
        return divmod(max(0, t_ns + self.header.epoch_offset_ns), 1_000_000_000)

    def _packets(self, payload: Payload) -> None:
        """Take one batch of packets; those of many cycles become one message, for a small index."""
        for packet in split_packets(payload):
            if self._oldest is None:
                self._oldest = packet[0]
            packets = self._waiting[packet[1]]
            packets.append(packet)
            if len(packets) >= _MOST_PACKETS or packet[0] - self._oldest >= _MOST_CYCLES:
                self._write_packets()

    def _write_packets(self) -> None:
        """Write the packets that wait, one message a bus, each at the time of its last packet."""
        self._oldest = None
        for channel, packets in zip(self._bus_channels, self._waiting, strict=True):
            if packets:
                data, t_ns = pack_packets(packets), packets[-1][5]
                packets.clear()
                self._add(channel, t_ns, data)

    def _tagged(self, payload: Payload) -> None:
        match decode(payload):
            case Event() as event:
                self._write_event(event)
            case TakenCommand() as command:
                self._taken_command(command)
            case OpenedTopic(number, topic=topic):
                self.topics[bytes(payload)] = None
                self._topic_channels[number] = self._channel(topic.name, topic.type)
            case TopicMessage(t_ns, number, data=data) if number in self._topic_channels:
                self._add(self._topic_channels[number], t_ns, data)
            case other:
                raise ValueError(
                    f"{type(other).__name__} does not belong into a log, or its topic was not opened"
                )

    def _taken_command(self, command: TakenCommand) -> None:
        data = self._command.pack(
            command.t_ns,
            command.cycle,
            command.planned,
            command.lease_ns,
            command.controller,
            command.kind,
            command.origin,
            command.text,
            command.numbers,
            command.request.decode(errors="replace"),
        )
        self._add(self._taken_channel, command.t_ns, data)

    def _write_event(self, event: Event) -> None:
        """Write one event, to /events and /rosout."""
        data = self._event.pack(
            event.t_ns,
            event.code,
            event.severity,
            0,
            event.name,
            event.source,
            event.text,
            event.data.decode(errors="replace"),
        )
        self._add(self._event_channel, event.t_ns, data)
        log = self._ros_log.pack(
            self._stamp(event.t_ns), event.severity, event.source, event.text, "", event.name, 0
        )
        self._add(self._rosout_channel, event.t_ns, log)

    def machine(self, t_ns: int, data: bytes) -> None:
        """Write a message about the machine; the first one opens its topic, which virtual time has not."""
        self._guarded(lambda message: self._machine(t_ns, message), data)

    def _machine(self, t_ns: int, data: bytes) -> None:
        if self._machine_channel is None:
            self._machine_channel = self._channel(schemas.MACHINE_TOPIC, schemas.MACHINE)
        self._add(self._machine_channel, t_ns, data)

    def gap(self, source: str, lost: int) -> None:
        """Declare that `lost` records of `source` did not reach the log; it becomes an event."""
        self._lost += lost
        what = counted(lost, f"record of {source} was", f"records of {source} were")
        them = "it" if lost == 1 else "them"
        text = f"{what} overwritten or damaged before the recorder read {them}"
        data = msgspec.json.encode(LostRecords(source, lost))
        event = Event(self.last_ns, EventCode.RECORDER_GAP, Severity.ERROR, "recorder", text, data=data)
        self._guarded(self._write_event, event)

    def flush(self, *, sync: bool = False) -> None:
        """Finish the chunk in progress, so that a reader finds it; with `sync`, wait for the disk."""
        if self.error is not None:
            return
        try:
            self._end_chunk()
            if sync:
                self._file.sync()
        except OSError as error:
            self._give_up(error)

    def close(self) -> LogSummary:
        """Finish the file and return what is in it; a second call returns the same.

        Its error is set too when the file is not there any more.
        """
        if self._summary is not None:
            return self._summary
        if self.error is None:
            try:
                self._finish()
            except OSError as error:
                self._give_up(error)
        if self._file.gone:
            self.error = "its file was deleted or moved by another program during the run"
        size = self._file.tell()
        self._file.close()
        self._summary = LogSummary(self._messages, size, self._lost, self.error, self._unwritten)
        return self._summary

    def _finish(self) -> None:
        self._end_chunk()
        for name, record in sorted(self.late_metadata.items()):
            self._writer.add_metadata(name, dict(sorted(record.items())))
        self._writer.add_metadata(
            schemas.SUMMARY_NAME, {"messages": str(self._messages), "gaps": str(self._lost)}
        )
        self._writer.finish()
        self._file.sync()
