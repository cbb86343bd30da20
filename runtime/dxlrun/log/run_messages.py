"""Run messages: converts records of the rings into messages of the log's topics, for file or viewer."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from dxlrun.channels.commands import TakenCommand
from dxlrun.channels.event_records import Event
from dxlrun.channels.logged_packets import BatchedPacket, split_packets
from dxlrun.channels.ring import Payload, RecordKind
from dxlrun.channels.tagged import decode
from dxlrun.channels.topic_messages import OpenedTopic, TopicRecord
from dxlrun.log import schemas
from dxlrun.log.packing.bus_messages import pack_packets
from dxlrun.log.packing.diagnostics import Diagnostics
from dxlrun.log.packing.frame_messages import Stamp, frame_messages
from dxlrun.log.schemas import CycleSpan, LogHeader
from dxlrun.messages.cdr import ENCAPSULATION, Codec
from dxlrun.messages.definition import MessageType

_MOST_PACKETS, _MOST_CYCLES = 1000, 250
"""Most packets and most cycles of one packet message. The index needs 16 bytes per message, and arrays of
many cycles compress better."""
JOINT_COMMANDS_NS = 10_000_000
"""Time between two messages of /joint_commands, ns; /cycle has the goals of each cycle."""


class RunMessages(ABC):
    """Converts a run's records into encoded messages; a subclass writes them to a file or sends them."""

    def __init__(self, header: LogHeader) -> None:
        self.header = header
        self.span = CycleSpan()
        """First and last cycle so far, with times."""
        self._layout = header.layout
        self._firsts: list[tuple[int, Callable[[Stamp], bytes]]] = []
        """Channels that get one message only, when the first record comes, and the function that makes it."""
        self.topics: dict[bytes, None] = {}
        """Encoded records that opened the topics so far, to repeat them in the log's next part."""
        self._topic_channels: dict[int, int] = {}
        """Channel of each controller's topic, by the topic's number in the records."""
        self._machine_channel: int | None = None
        self._takers: dict[int, Callable[[Payload], None]] = {
            RecordKind.CYCLE: self.cycle,
            RecordKind.PACKETS: self._packets,
            RecordKind.TAGGED: self._tagged,
        }
        self._diagnostics = Diagnostics(header.joints)
        messages = (schemas.EVENT, schemas.ROS_LOG, schemas.JOINT_STATE, schemas.COMMAND)
        self._event, self._ros_log, self._joint_state, self._command = map(Codec, messages)

    @abstractmethod
    def _channel(self, topic: str, message: MessageType, *, latched: bool = False) -> int:
        """Open a channel for a topic and return its number; `latched`: later readers also get its message."""

    @abstractmethod
    def _put(self, channel: int, t_ns: int, wall_ns: int, data: bytes) -> None:
        """Write or send an encoded message; `t_ns` is the run's clock, `wall_ns` is ns since 1970."""

    def _add(self, channel: int, t_ns: int, data: bytes) -> None:
        # The run begins with its first record, not with the opening of the log.
        if self._firsts:
            firsts, self._firsts = self._firsts, []
            for first, message in firsts:
                self._add(first, t_ns, message(self._stamp(t_ns)))
        self._put(channel, t_ns, max(0, t_ns + self.header.epoch_offset_ns), data)

    def _open_channels(self) -> None:
        """Open the channels of the topics that every run has."""
        header = self.header
        self._cycle_channel = self._channel(schemas.LogTopic.CYCLE, schemas.CYCLE)
        self._activation_channel = self._channel(schemas.LogTopic.ACTIVATION, schemas.CYCLE)
        self._taken_channel = self._channel(schemas.LogTopic.COMMANDS, schemas.COMMAND)
        self._states_channel = self._channel(schemas.LogTopic.JOINT_STATES, schemas.JOINT_STATE)
        self._commands_channel = self._channel(schemas.LogTopic.JOINT_COMMANDS, schemas.JOINT_STATE)
        self._diagnostics_channel = self._channel(schemas.LogTopic.DIAGNOSTICS, schemas.DIAGNOSTICS)
        self._event_channel = self._channel(schemas.LogTopic.EVENT, schemas.EVENT)
        self._rosout_channel = self._channel(schemas.LogTopic.ROSOUT, schemas.ROS_LOG)
        self._bus_channels = [
            self._channel(schemas.bus_topic(bus), schemas.BUS_PACKETS) for bus in header.buses
        ]
        self._waiting: list[list[BatchedPacket]] = [[] for _ in header.buses]
        """Packets of each bus that are still to be packed into a message."""
        self._oldest: int | None = None
        """Number of the cycle of the first of these packets; None: there are none."""
        self._commands_slot: int | None = None
        self._publishers = [
            (
                1 << index,
                controller.joints,
                np.array([header.joints.index(j) for j in controller.joints], int),
            )
            for index, controller in enumerate(header.controllers)
            if schemas.LogTopic.JOINT_STATES in controller.publishes
        ]
        if header.robot_description is not None:
            channel = self._channel(schemas.LogTopic.ROBOT_DESCRIPTION, schemas.STRING, latched=True)
            description = Codec(schemas.STRING).pack(header.robot_description)
            self._firsts.append((channel, lambda _: description))
        self._frames = frame_messages(header)
        if self._frames is not None:
            self._frames_channel = self._channel(schemas.LogTopic.FRAMES, schemas.FRAMES)
            if self._frames.any_still:
                channel = self._channel(schemas.LogTopic.STILL_FRAMES, schemas.FRAMES, latched=True)
                self._firsts.append((channel, self._frames.still))

    def cycle(self, payload: Payload) -> None:
        """Convert the record of a cycle into messages: /cycle, joint states, commands, frames, diagnostics.

        The record before the first cycle becomes /activation.
        """
        data = bytes(payload)
        record = np.frombuffer(data, dtype=self._layout.dtype)[0]
        self.span.extend_span(record, self.header.period_ns)
        written_ns, read_ns = int(record["written_ns"]), int(record["read_ns"])
        if int(record["cycle"]) < 0:
            self._add(self._activation_channel, written_ns, ENCAPSULATION + data)
            return
        self._add(self._cycle_channel, written_ns, ENCAPSULATION + data)
        published = int(record["published"])
        for bit, joints, rows in self._publishers:
            if published & bit:
                self._joint_states(read_ns, joints, record, rows)
        frames = None if self._frames is None else self._frames.pack_frames(record, self._stamp(read_ns))
        if frames is not None:
            self._add(self._frames_channel, read_ns, frames)
        slot = int(record["scheduled_ns"]) // JOINT_COMMANDS_NS
        if slot != self._commands_slot:
            self._commands_slot = slot
            self._joint_commands(written_ns, record)
        diagnostics = self._diagnostics.pack_diagnostics(record, written_ns, self._stamp(written_ns))
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
        """Collect the packets of a record; pack them when they are many, for a small index."""
        for packet in split_packets(payload):
            if self._oldest is None:
                self._oldest = packet[0]
            packets = self._waiting[packet[1]]
            packets.append(packet)
            if len(packets) >= _MOST_PACKETS or packet[0] - self._oldest >= _MOST_CYCLES:
                self._write_packets()

    def _write_packets(self) -> None:
        """Pack and write the collected packets, one message per bus, with the time of its last packet."""
        self._oldest = None
        for channel, packets in zip(self._bus_channels, self._waiting, strict=True):
            if packets:
                data, t_ns = pack_packets(packets), packets[-1][5]
                packets.clear()
                self._add(channel, t_ns, data)

    def _tagged(self, payload: Payload) -> None:
        match decode(payload):
            case Event() as event:
                self.event(event)
            case TakenCommand() as command:
                self._taken_command(command)
            case OpenedTopic(number, topic=topic):
                self.topics[bytes(payload)] = None
                self._topic_channels[number] = self._channel(topic.name, topic.type)
            case TopicRecord(t_ns, number, data=data) if number in self._topic_channels:
                self._add(self._topic_channels[number], t_ns, data)
            case other:
                raise ValueError(f"a log has no message {type(other).__name__}, or its topic is not open")

    def _taken_command(self, command: TakenCommand) -> None:
        data = self._command.pack(
            command.t_ns,
            command.cycle,
            command.planned,
            command.lease_ns,
            command.controller,
            command.kind,
            command.origin,
            command.data_text,
            command.numbers,
            command.request.decode(errors="replace"),
        )
        self._add(self._taken_channel, command.t_ns, data)

    def event(self, event: Event) -> None:
        """Convert an event into messages of /events and /rosout."""
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

    def _machine(self, t_ns: int, data: bytes) -> None:
        if self._machine_channel is None:
            self._machine_channel = self._channel(schemas.LogTopic.MACHINE, schemas.MACHINE)
        self._add(self._machine_channel, t_ns, data)
