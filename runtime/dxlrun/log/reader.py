"""Reading a log: whole, unfinished after a kill, or damaged; the unreadable is reported."""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import IO, cast

import lz4.frame
import msgspec
import numpy as np
import zstandard
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, McapRecord, Metadata, Schema
from mcap.stream_reader import StreamReader
from numpy.typing import NDArray

from dxlrun.description.modes import Mode
from dxlrun.errors import LogError, counted, suggestion
from dxlrun.log import schemas
from dxlrun.log.bus_messages import BusMessages, read_packets
from dxlrun.log.columns import PacketColumns
from dxlrun.log.parts import log_files
from dxlrun.log.recording import PART_END_NAME, PART_NAME, LeftOut
from dxlrun.log.schemas import LoggedController, LogHeader, from_metadata
from dxlrun.log.topics import LoggedTopic
from dxlrun.messages.cdr import ENCAPSULATION, Codec, Value
from dxlrun.messages.definition import MessageType
from dxlrun.run.channels.commands import TakenCommand, data_of
from dxlrun.run.channels.cycle import CycleLayout
from dxlrun.run.channels.events import Event
from dxlrun.run.channels.packets import BEFORE_FIRST_CYCLE

_MAGIC = b"\x89MCAP0\r\n"
_RECORD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
_TIMED_AT = 6
"""Bytes of a message before its times: channel and sequence."""
_TIMES = struct.Struct("<QQ")
"""Log time and publish time of a message."""
_FOR_OTHERS = frozenset(
    (
        schemas.ROSOUT_TOPIC,
        schemas.JOINT_STATES_TOPIC,
        schemas.JOINT_COMMANDS_TOPIC,
        schemas.DIAGNOSTICS_TOPIC,
        schemas.ROBOT_DESCRIPTION_TOPIC,
    )
)
"""What other tools read; the same is in the other topics."""
_OWN = frozenset(
    (
        schemas.CYCLE_TOPIC,
        schemas.ACTIVATION_TOPIC,
        schemas.COMMANDS_TOPIC,
        schemas.EVENT_TOPIC,
    )
)
"""What this module reads by itself."""
_DAMAGE = (McapError, zstandard.ZstdError, struct.error, UnicodeDecodeError, EOFError)
UNREADABLE = (msgspec.MsgspecError, ValueError, RecursionError)
"""What msgspec raises for JSON in a log (the plan, data of a command) that is damaged or too deep."""
_LARGEST_CHUNK = 64 << 20
"""Bytes of a chunk when decompressed; ours have 256 KiB and one message, those of other writers some MiB."""
_MOST_EXPANDED = 256
"""Bytes that a file may become for each of its own: logs of ours become 8 to 50 times as long."""


@dataclass(slots=True)
class _Found:
    """What a walk through a file collects."""

    channels: dict[int, str] = field(default_factory=dict)
    needless: set[int] = field(default_factory=set)
    """Channels whose messages are left where they are."""
    schemas: dict[int, MessageType] = field(default_factory=dict)
    types: dict[int, int] = field(default_factory=dict)
    """Schemas of all channels."""
    published: dict[int, int] = field(default_factory=dict)
    """Channels of topics of controllers and of the runtime -> their schemas. Their messages have log time and
    publish time in front."""
    messages: dict[int, list[bytes]] = field(default_factory=dict)
    attachments: dict[str, bytes] = field(default_factory=dict)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    damage: list[str] = field(default_factory=list)
    finished: bool = False
    room: int = 0
    """Bytes that the chunks which follow may have when they are decompressed."""
    packets: bool = True
    """Packets are read."""
    after: Callable[[_Found], None] = lambda found: None
    """Called behind each chunk."""
    end: int = 0
    """The byte behind the last whole record."""
    part: int = 0
    """Which of the log's files is read."""
    name: str = "the file"
    """What sentences call it."""
    left_out: list[LeftOut] = field(default_factory=list)

    @property
    def base(self) -> int:
        """What is added to the numbers of channels and schemas, which each part has for itself."""
        return self.part << 16


@dataclass(frozen=True)
class Log:
    """One run, as its log has it. Times: ns of the run's clock; wall time = that + `epoch_offset_ns`."""

    path: Path
    header: LogHeader
    cycles: NDArray[np.void]
    """Shape (cycles,), read-only; fields of CycleLayout: scalars, and rows of joints or controllers."""
    events: tuple[Event, ...]
    attachments: dict[str, bytes]
    metadata: dict[str, dict[str, str]]
    complete: bool
    """True when the recorder finished the file and nothing in it is damaged."""
    damage: tuple[str, ...]
    """A sentence for each thing that is missing or could not be read."""
    packets: PacketColumns = field(default_factory=lambda: PacketColumns.of(()))
    """Every packet of every bus, bus by bus as recorded."""
    activation: NDArray[np.void] | None = None
    """Shape (1,), as `cycles`: states and goals when the controllers were activated; None: not in the log."""
    commands: tuple[TakenCommand, ...] = ()
    """What cycles took for controllers and for the loop, in order."""
    topics: Mapping[str, LoggedTopic] = field(default_factory=dict)
    """Own topics of controllers, and `/goals` of the runtime, by name."""
    left_out: tuple[LeftOut, ...] = ()
    """What the recorder left out on purpose, waiting for a fault: neither lost nor missing."""

    def slices(self) -> Iterator[Log]:
        """Yield the log itself: one that was read whole is its own only slice."""
        yield self

    @property
    def about(self) -> Log:
        """The log itself, as LogReader has one without its records."""
        return self

    def messages(self, topic: str) -> list[Mapping[str, Value]]:
        """Return the messages of a controller's own topic by their fields; `topics` has times and columns.

        Raises LogError when the log does not have it.
        """
        if topic not in self.topics:
            raise LogError(f"{self.path}: no topic {topic}; {suggestion(topic, tuple(self.topics))}")
        return self.topics[topic].messages()

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints, in the order of rows."""
        return self.header.joints

    @property
    def buses(self) -> tuple[str, ...]:
        """Names of the buses; a packet's `bus` is an index here."""
        return self.header.buses

    @property
    def controllers(self) -> tuple[LoggedController, ...]:
        """The controllers, in the order of the masks' bits."""
        return self.header.controllers

    @property
    def period_ns(self) -> int:
        """The nominal period of the loop, ns."""
        return self.header.period_ns


def read_log(path: str | Path) -> Log:
    """Read a log of dxlrun. Raises LogError with one sentence when the file is none, is missing or empty."""
    path = Path(path)
    found = _opened(path, _Found())
    return _log_of(path, found)


def scan_log(path: str | Path, take: Callable[[Log], None]) -> Log:
    """Read a log slice by slice, in memory that does not grow with it: `take` gets each as a log of its own.

    A slice has the cycles, packets, events and commands of a chunk of the file; an event that goes beyond
    it is continued in the next one by one of `part` > 0. Return what is left: a log without them, with all
    that the file contains about itself. Raises LogError as read_log, and where a packet cannot be read.
    """
    path = Path(path)

    def slice_of(found: _Found) -> None:
        if schemas.METADATA_NAME in found.metadata:
            part = _log_of(path, replace(found, damage=[], finished=True))
            found.messages.clear()
            take(part)

    found = _opened(path, _Found(after=slice_of))
    return _log_of(path, replace(found, messages={}))


class LogReader:
    """A log that is open: what it says about itself, and its slices one after the other in flat memory."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._about: Log | None = None

    @property
    def about(self) -> Log:
        """All that the file says about itself, as a log without records; whole behind the last slice."""
        if self._about is None:
            for _ in self.slices():
                pass
        return cast("Log", self._about)

    def slices(self) -> Iterator[Log]:
        """Yield cycles, packets, events, commands and topics chunk after chunk, as logs of their own."""
        log = read_log(self.path)
        yield log
        self._about = replace(
            log, cycles=log.cycles[:0], packets=log.packets[:0], events=(), commands=(), topics={}
        )


def open_log(path: str | Path) -> LogReader:
    """Open a log. Raises LogError with one sentence when the file is none, is missing or empty."""
    return LogReader(Path(path))


class LogFollower:
    """A log that is being written: what came since the last look. Packets are left out.

    Raises LogError as read_log, at each look.
    """

    def __init__(self, path: str | Path) -> None:
        self._path = Path(path)
        self._found = _Found(packets=False)

    def new(self) -> Log:
        """Return what the file has in addition, as a log of its own."""
        found = self._found
        found.messages.clear()
        found.damage.clear()
        _opened(self._path, found)
        return _log_of(self._path, replace(found, messages=dict(found.messages), damage=[]))


class _OtherRunError(Exception):
    """A part is of another run than the first."""


def _opened(path: Path, found: _Found) -> _Found:
    """Go through the files of a log; raises LogError with one sentence when it is none, missing or empty."""
    log = log_files(path)
    found.damage += log.damage
    refused: LogError | None = None
    while True:
        file = log.files[found.part]
        found.name = "the file" if file == path else file.name
        try:
            _open_file(file, found)
            refused = None
        except _OtherRunError:
            found.damage.append(f"{found.name} is of another run and left out")
            found.finished = True
        except LogError as error:
            if len(log.files) == 1:
                raise
            refused = error
            found.damage.append(str(error).removeprefix(f"{path}/"))
        if found.part + 1 == len(log.files):
            break
        if not found.finished and refused is None:
            found.damage.append(_no_end(found))
        found.part += 1
        found.end, found.finished = 0, False
    if schemas.METADATA_NAME not in found.metadata and refused is not None:
        raise refused
    if file != path and found.finished and found.metadata.get(PART_END_NAME, {}).get("last") == "no":
        found.damage.append(f"the parts behind {file.name} are missing")
    return found


def _open_file(path: Path, found: _Found) -> None:
    try:
        with path.open("rb") as stream:
            size = os.fstat(stream.fileno()).st_size
            if size == 0:
                raise LogError(f"{path}: the file is empty; its recorder never began to write")
            if stream.read(len(_MAGIC)) != _MAGIC:
                raise LogError(f"{path}: this is no MCAP file, so it is no log of dxlrun")
            _walk(stream, size, found)
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror or error}") from error


def _no_end(found: _Found) -> str:
    return f"{found.name} has no end: its recorder was killed, or could write no more"


def _log_of(path: Path, found: _Found) -> Log:
    if schemas.METADATA_NAME not in found.metadata:
        raise LogError(f"{path}: an MCAP file, but not written by dxlrun: it has no metadata 'dxlrun'")
    try:
        header = from_metadata(found.metadata[schemas.METADATA_NAME])
        return _log(path, header, found)
    except ValueError as error:
        raise LogError(f"{path}: a log that this version of dxlrun cannot read: {error}") from error


def _log(path: Path, header: LogHeader, found: _Found) -> Log:
    by_topic: dict[str, list[bytes]] = {topic: [] for topic in found.channels.values()}
    for channel, topic in found.channels.items():
        by_topic[topic] += found.messages.get(channel, [])
    names = [controller.name for controller in header.controllers]
    layout = CycleLayout(header.joints, names, header.references)
    cycles = _cycles(layout, by_topic.get(schemas.CYCLE_TOPIC, []))
    packets = _packets(header, found, cycles)
    activation = by_topic.get(schemas.ACTIVATION_TOPIC, [])[:1]
    if not found.finished:
        found.damage.append(_no_end(found))
    return Log(
        path=path,
        header=header,
        cycles=cycles,
        events=_events(by_topic.get(schemas.EVENT_TOPIC, [])),
        attachments=found.attachments,
        metadata=found.metadata,
        complete=not found.damage,
        damage=tuple(found.damage),
        packets=packets,
        activation=_cycles(layout, activation) if activation else None,
        commands=_commands(by_topic.get(schemas.COMMANDS_TOPIC, [])),
        topics=_topics(header, found),
        left_out=tuple(found.left_out),
    )


def _topics(header: LogHeader, found: _Found) -> dict[str, LoggedTopic]:
    topics: dict[str, LoggedTopic] = {}
    for channel, schema in found.published.items():
        kind = found.schemas.get(schema)
        if kind is None:
            raise ValueError(f"the topic {found.channels[channel]} has no definition")
        messages = found.messages.get(channel, [])
        name = found.channels[channel]
        before = topics.get(name)  # of a controller that was unloaded and loaded again
        if before is not None and before.type != kind:
            name, before = f"{name} ({kind.name})", None
        t_ns = np.array([_TIMES.unpack_from(message)[0] for message in messages], dtype=np.int64)
        t_ns -= header.epoch_offset_ns
        data = tuple(message[_TIMES.size :] for message in messages)
        if before is not None:
            t_ns, data = np.concatenate((before.t_ns, t_ns)), (*before.data, *data)
        topics[name] = LoggedTopic(name, kind, t_ns, data)
    return topics


def _cycles(layout: CycleLayout, messages: list[bytes]) -> NDArray[np.void]:
    size = len(ENCAPSULATION) + layout.size
    old = len(ENCAPSULATION) + layout.places["mode"].stop
    if not layout.references and all(len(message) == old for message in messages):
        # a log from before cycles had references: the length of none is missing
        messages = [message + bytes(size - old) for message in messages]
    if any(len(message) != size for message in messages):
        raise ValueError("the messages of /cycle are not as long as joints and controllers ask")
    bodies = b"".join(message[len(ENCAPSULATION) :] for message in messages)
    array: NDArray[np.void] = np.frombuffer(bodies, dtype=layout.dtype)
    unknown = np.flatnonzero((array["mode"] > max(Mode)).any(axis=1))
    if len(unknown):
        raise ValueError(f"cycle {array['cycle'][unknown[0]]} has a mode of a servo that is not known")
    return array


def _packets(header: LogHeader, found: _Found, cycles: NDArray[np.void]) -> PacketColumns:
    """Return the packets of all buses; those of formats 3 and 4 get the numbers of their cycles by time."""
    parts: list[PacketColumns] = []
    for index, bus in enumerate(header.buses):
        for channel, topic in found.channels.items():
            messages = found.messages.get(channel)
            if topic != schemas.bus_topic(bus) or not messages:
                continue
            sizes = np.array([len(message) for message in messages], np.int64)
            single = found.schemas[found.types[channel]].name == schemas.BUS_PACKET_NAME
            place = BusMessages(index, np.cumsum(sizes) - sizes, sizes, single)
            read = read_packets(np.frombuffer(b"".join(messages), np.uint8), place)
            if read.wrong:
                them = counted(read.wrong, "message of packets is", "messages of packets are")
                found.damage.append(f"{them} damaged and left out")
            parts.append(_numbered(read.packets, cycles) if single else read.packets)
    return PacketColumns.joined(parts)


def _numbered(packets: PacketColumns, cycles: NDArray[np.void]) -> PacketColumns:
    if not len(cycles):
        return packets
    row = np.searchsorted(cycles["woken_ns"], packets.first_ns, side="right") - 1
    return replace(packets, cycle=np.where(row < 0, BEFORE_FIRST_CYCLE, cycles["cycle"][np.maximum(row, 0)]))


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
        for values in _unpacked(Codec(schemas.COMMAND), messages)
    )


_NO_TEXT = b"\1\0\0\0\0"
"""An empty string in CDR."""


def _unpacked(codec: Codec, messages: Iterable[bytes]) -> Iterator[Mapping[str, Value]]:
    """Yield messages by their fields; those of logs from before their last field, a string, have it empty."""
    for data in messages:
        try:
            yield codec.unpack(data)
        except ValueError:
            yield codec.unpack(data + bytes(-len(data) % 4) + _NO_TEXT)


def _events(messages: list[bytes]) -> tuple[Event, ...]:
    events: list[Event] = []
    for values in _unpacked(Codec(schemas.EVENT), messages):
        event = Event(
            t_ns=cast("int", values["t_ns"]),
            code=cast("int", values["code"]),
            severity=cast("int", values["severity"]),
            source=str(values["source"]),
            text=str(values["text"]),
            part=cast("int", values["part"]),
            data=str(values["data"]).encode(),
        )
        if event.part and events and (events[-1].t_ns, events[-1].code) == (event.t_ns, event.code):
            last = events.pop()
            event = Event(last.t_ns, last.code, last.severity, last.source, last.text + event.text)
        events.append(event)
    return tuple(events)


def _walk(stream: IO[bytes], size: int, found: _Found) -> None:
    """Go through the file, record by record, until its end or to what cannot be read.

    It begins behind the last record that was read before: at the start of the file the first time.
    """
    found.room = _LARGEST_CHUNK + _MOST_EXPANDED * size
    stream.seek(found.end)
    reader = StreamReader(stream, skip_magic=found.end > 0, emit_chunks=True, record_size_limit=size)
    records: Iterator[McapRecord] = reader.records
    while True:
        try:
            record = next(records, None)
        except _DAMAGE as error:
            at = stream.tell()
            if at < size or not isinstance(error, struct.error | EOFError | McapError):
                where = f"byte {at}" if found.name == "the file" else f"byte {at} of {found.name}"
                found.damage.append(f"what lies behind {where} cannot be read: {_said(error)}")
            return
        if record is None:
            found.finished = True  # the footer and the magic bytes behind it were read
            return
        _take(record, found)
        found.end = stream.tell()


def _take(record: McapRecord, found: _Found) -> None:
    if isinstance(record, Chunk):
        try:
            _split(_decompressed(record, found), found)
        except _DAMAGE as error:
            damage = f"a chunk of messages is damaged and left out: {_said(error)}"
            if damage not in found.damage:
                found.damage.append(damage)
        found.after(found)
    elif isinstance(record, Attachment):
        found.attachments[record.name] = record.data
    elif isinstance(record, Metadata):
        _take_metadata(record, found)
    elif isinstance(record, Schema):
        _open_schema(record.id + found.base, record.name, record.data, found)
    elif isinstance(record, Channel):
        _open_channel(record.id + found.base, record.schema_id + found.base, record.topic, found)


def _take_metadata(record: Metadata, found: _Found) -> None:
    known = found.metadata.get(record.name)
    if record.name == schemas.METADATA_NAME and known not in (None, record.metadata):
        raise _OtherRunError
    found.metadata[record.name] = record.metadata
    if record.name in (PART_NAME, PART_END_NAME):
        with suppress(ValueError):
            left_out = LeftOut.from_metadata(record.metadata)
            if left_out != LeftOut():
                found.left_out.append(left_out)


def _open_schema(identifier: int, name: str, data: bytes, found: _Found) -> None:
    found.schemas[identifier] = MessageType(name, data.decode(errors="replace"), "")


def _open_channel(identifier: int, schema: int, topic: str, found: _Found) -> None:
    found.channels[identifier] = topic
    found.types[identifier] = schema
    if topic in _FOR_OTHERS or (topic.startswith(schemas.BUS_PREFIX) and not found.packets):
        found.needless.add(identifier)
    elif topic not in _OWN and not topic.startswith(schemas.BUS_PREFIX):
        found.published[identifier] = schema


def _counted(data: bytes, at: int) -> tuple[bytes, int]:
    """Return bytes that have their length in front, and where they end."""
    (length,) = struct.unpack_from("<I", data, at)
    return data[at + 4 : at + 4 + length], at + 4 + length


def _decompressed(chunk: Chunk, found: _Found) -> bytes:
    """Return the records of a chunk; EOFError when it contradicts its header, or more than a log can have."""
    size = chunk.uncompressed_size
    if size > _LARGEST_CHUNK:
        raise EOFError(f"it is {size} bytes long when decompressed, and a chunk has {_LARGEST_CHUNK} at most")
    if size > found.room:
        raise EOFError(f"the file becomes more than {_MOST_EXPANDED} times as long when decompressed")
    found.room -= size
    if chunk.compression == "zstd":
        # not decompress(): it believes the length in the frame, not that of the chunk
        data = zstandard.ZstdDecompressor().stream_reader(chunk.data).read(size + 1)
    elif chunk.compression == "lz4":
        try:
            data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1)
        except RuntimeError as error:
            raise EOFError(str(error)) from error
    elif chunk.compression == "":
        data = chunk.data
    else:
        raise EOFError(f"its compression {chunk.compression!r} is not known")
    if len(data) != size:
        raise EOFError("it is not as long as it says")
    if chunk.uncompressed_crc not in (0, zlib.crc32(data)):
        raise EOFError("its bytes do not agree with their CRC")
    return data


def _split(data: bytes, found: _Found) -> None:
    """Cut a chunk into its messages; several times faster than the library's objects."""
    start, end = 0, len(data)
    messages, needless, published, base = found.messages, found.needless, found.published, found.base
    while start < end:
        opcode, length = _RECORD.unpack_from(data, start)
        body = start + _RECORD.size
        start = body + length
        if start > end:
            raise EOFError("a record is longer than its chunk")
        if opcode == Opcode.MESSAGE:
            channel = base + data[body] + (data[body + 1] << 8)
            if channel not in needless:
                begin = body + (_TIMED_AT if channel in published else _MESSAGE.size)
                messages.setdefault(channel, []).append(data[begin:start])
        elif opcode == Opcode.CHANNEL:
            identifier, schema = struct.unpack_from("<HH", data, body)
            (text_length,) = struct.unpack_from("<I", data, body + 4)
            topic = data[body + 8 : body + 8 + text_length].decode()
            _open_channel(base + identifier, base + schema, topic, found)
        elif opcode == Opcode.SCHEMA:
            (identifier,) = struct.unpack_from("<H", data, body)
            name, at = _counted(data, body + 2)
            _, at = _counted(data, at)  # its encoding: ros2msg
            _open_schema(base + identifier, name.decode(), _counted(data, at)[0], found)


def _said(error: Exception) -> str:
    return str(error) or type(error).__name__
