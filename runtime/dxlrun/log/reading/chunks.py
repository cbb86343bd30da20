"""Chunks: reads the messages of any MCAP file chunk by chunk, and skips damaged places.

Source: mcap.dev/spec. Memory is bounded for any content: by _LARGEST for each record and each chunk.
"""

from __future__ import annotations

import struct
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from io import BytesIO
from typing import IO

import lz4.frame
import msgspec
import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Metadata, Schema, Statistics
from numpy.typing import NDArray

from dxlrun.log.columns import numbers
from dxlrun.log.schemas import COMPRESSED_SUFFIX, COMPRESSED_TYPE
from dxlrun.messages.definition import MessageType

MAGIC = b"\x89MCAP0\r\n"
_RECORD = struct.Struct("<BQ")
_MESSAGE_HEAD = 22
"""Length of a message's header, bytes: channel, sequence, log time, publish time."""
_TIME_AT = 6
_DAMAGE = (
    McapError,
    zstandard.ZstdError,
    struct.error,
    UnicodeDecodeError,
    EOFError,
    OverflowError,
    MemoryError,
)
_LARGEST = 64 << 20
"""Largest record and decompressed chunk that is read, bytes; dxlrun's chunks have 512 KiB and one message."""
_MOST_EXPANDED = 256
"""Largest ratio of decompressed to file size that is read, against malicious files; logs of dxlrun have 8 to
50."""
_LOOSE_BYTES = 1 << 20
"""Size to which messages that are not in chunks are collected, bytes."""
_COMPRESSIONS = (b"\4\0\0\0zstd", b"\3\0\0\0lz4")
"""Bytes that a chunk's header contains (its compression), used to find the next chunk after damage."""
_COMPRESSION_AT = _RECORD.size + 28
_BLOCK = 1 << 20


class OpenChannel(msgspec.Struct, frozen=True):
    """A channel of an MCAP file: its topic, message type and encoding."""

    topic: str
    encoding: str
    """Encoding of the channel's messages, such as `cdr`."""
    type_name: str
    schema_encoding: str
    """Language of the message definition; only `ros2msg` is decoded."""
    text: str
    """Definition of the message type."""

    @property
    def type(self) -> MessageType:
        """Message type of the channel, from its name and definition."""
        return MessageType(self.type_name, self.text)


class Messages(msgspec.Struct, frozen=True, eq=False):
    """Messages of one chunk as arrays, one element per message, in file order."""

    data: NDArray[np.uint8]
    """Bytes of the whole chunk."""
    channel: NDArray[np.int64]
    t_ns: NDArray[np.int64]
    """Log time of each message, ns since 1970."""
    start: NDArray[np.int64]
    """Index in `data` of each message's first byte after its header."""
    size: NDArray[np.int64]

    def bodies(self, rows: NDArray[np.int64]) -> list[bytes]:
        """Return the bytes of the messages with these row numbers."""
        data, start = self.data.data, self.start[rows]
        return [
            bytes(data[a:b]) for a, b in zip(start.tolist(), (start + self.size[rows]).tolist(), strict=True)
        ]


def gathered(chunks: Iterable[Messages], least: int) -> Iterator[Messages]:
    """Join consecutive chunks until each has at least `least` bytes; the last may have fewer."""
    parts: list[Messages] = []
    size = 0
    for messages in chunks:
        parts.append(messages)
        size += len(messages.data)
        if size >= least:
            size = 0
            yield _joined(parts)
    if parts:
        yield _joined(parts)


def _joined(parts: list[Messages]) -> Messages:
    """Concatenate the messages of chunks, and empty the list `parts` to free their memory."""
    if len(parts) == 1:
        return parts.pop()
    sizes = [len(part.data) for part in parts]
    before = np.cumsum([0, *sizes[:-1]])
    whole = Messages(
        data=np.concatenate([part.data for part in parts]),
        channel=np.concatenate([part.channel for part in parts]),
        t_ns=np.concatenate([part.t_ns for part in parts]),
        start=np.concatenate([part.start + at for part, at in zip(parts, before, strict=True)]),
        size=np.concatenate([part.size for part in parts]),
    )
    parts.clear()
    return whole


@dataclass(slots=True)
class McapFile:
    """Contents of an MCAP file found so far; reading again continues where the last walk ended.

    The files of one log are walked in sequence: `begin` starts the next file.
    """

    channels: dict[int, OpenChannel] = field(default_factory=dict)
    attachments: dict[str, bytes] = field(default_factory=dict)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    counts: dict[int, int] = field(default_factory=dict)
    """Number of messages of each channel that the file's statistics state; empty if it has none."""
    damage: list[str] = field(default_factory=list)
    finished: bool = False
    end: int = len(MAGIC)
    """Offset in the file after the last complete record, where the next walk continues."""
    name: str = ""
    """File name to mention in damage reports; empty if the log has only one file."""
    on_metadata: Callable[[str, dict[str, str]], None] = lambda name, record: None
    """Called with name and contents of each metadata record; an exception it raises ends the walk."""
    _base: int = 0
    """Number added to channel numbers, because each file of a log numbers its channels from 0."""
    _anchor: int = len(MAGIC)
    """Offset after the last complete chunk, from which the next chunk is searched after damage."""
    _read: Counter[int] = field(default_factory=Counter)
    """Number of messages of each channel that were read."""
    _schemas: dict[int, Schema] = field(default_factory=dict)
    _room: int = 0
    """Bytes that may still be decompressed before the file counts as malicious."""

    def begin_file(self, number: int) -> None:
        """Reset for the next file of the same log, which is the `number`-th and has its own channels."""
        self._base, self.end, self.finished = number << 16, len(MAGIC), False
        self._anchor = self.end
        self._schemas.clear()

    def walk(self, stream: IO[bytes], size: int, *, chunks: bool = True) -> Iterator[Messages]:
        """Read a file to its end and yield its messages chunk by chunk; add to `damage` what is unreadable.

        `chunks=False` skips messages, and the channels that only chunks have.
        """
        self._room = _LARGEST + _MOST_EXPANDED * size
        loose = bytearray()
        while True:
            opcode, length = self._head(stream, size)
            body = self.end + _RECORD.size
            if loose and (opcode != Opcode.MESSAGE or len(loose) > _LOOSE_BYTES):
                yield from self._messages(bytes(loose))
                loose.clear()
            if opcode == 0:
                if not self._go_on(stream, size):
                    return
                continue
            if opcode == Opcode.MESSAGE:
                if chunks:
                    loose += _RECORD.pack(opcode, length) + stream.read(length)
            elif opcode == Opcode.CHUNK:
                self._anchor = self.end + 1
                data = self._chunk(stream.read(length)) if chunks else None
                if data is not None:
                    self._anchor = body + length
                    yield from self._messages(data)
            elif opcode in _READ:
                try:
                    _READ[Opcode(opcode)](self, ReadDataStream(BytesIO(stream.read(length))))
                except _DAMAGE as error:
                    what = Opcode(opcode).name.lower().replace("_", " ")
                    self.damage.append(f"a record of kind {what} cannot be read: {_reason(error)}")
            self.end = body + length
            if opcode == Opcode.FOOTER:
                self._finish(counted=chunks)
                return

    def _head(self, stream: IO[bytes], size: int) -> tuple[int, int]:
        """Return opcode and length of the record at `end`; opcode 0 if it is incomplete or invalid."""
        stream.seek(self.end)
        head = stream.read(_RECORD.size)
        if len(head) < _RECORD.size:
            return 0, 0
        opcode, length = _RECORD.unpack(head)
        end = self.end + _RECORD.size + length
        if end > size or length > _LARGEST:
            return 0, 0
        if opcode == Opcode.FOOTER:
            stream.seek(end)
            # Another record with a wrong bit.
            if stream.read(len(MAGIC)) != MAGIC:
                return 0, 0
            stream.seek(self.end + _RECORD.size)
        return opcode, length

    def _finish(self, *, counted: bool) -> None:
        """Mark the file as finished; report messages that the statistics count but that were not found."""
        self.finished = True
        if counted and not self.damage:
            self.damage += [
                f"{count - self._read[channel]} of {count} messages of {known.topic} are missing{self._of}"
                for channel, known in self.channels.items()
                if (count := self.counts.get(channel, 0)) > self._read[channel]
            ]

    def _go_on(self, stream: IO[bytes], size: int) -> bool:
        """After an invalid record, skip to the next chunk and report it; return False if there is none."""
        begin = self.end
        found = _next_chunk(stream, self._anchor, size)
        if found is not None:
            # A wrong length may have skipped the next chunk.
            begin = min(begin, self._anchor)
            self.end, self._anchor = found, found + 1
            self.damage.append(f"bytes {begin} to {found}{self._of} cannot be read")
            return True
        stream.seek(begin)
        if stream.read(1) == b"\0":
            self.damage.append(f"the bytes after {begin}{self._of} cannot be read: they are not a record")
        return False

    @property
    def _of(self) -> str:
        return f" of {self.name}" if self.name else ""

    def _chunk(self, body: bytes) -> bytes | None:
        """Return the decompressed records of a chunk; None if it is damaged, which is reported."""
        try:
            return self._decompressed(Chunk.read(ReadDataStream(BytesIO(body))))
        except _DAMAGE as error:
            self._damaged_chunk(error)
            return None

    def _damaged_chunk(self, error: Exception) -> None:
        damage = f"a chunk of messages is damaged and skipped: {_reason(error)}"
        if damage not in self.damage:
            self.damage.append(damage)

    def _messages(self, data: bytes) -> Iterator[Messages]:
        """Yield the messages in the records of a chunk; records after a damaged one are skipped."""
        starts: list[int] = []
        keep, unpack, at, end = starts.append, _RECORD.unpack_from, 0, len(data)
        message = int(Opcode.MESSAGE)
        try:
            while at < end:
                opcode, length = unpack(data, at)
                body = at + 9
                after = body + length
                if after > end:
                    raise EOFError("a record is longer than its chunk")
                if opcode == message:
                    if length < _MESSAGE_HEAD:
                        raise EOFError("a message is shorter than its header")
                    keep(at)
                elif opcode in _OPENS:
                    _READ[Opcode(opcode)](self, ReadDataStream(BytesIO(data[body:after])))
                at = after
        except _DAMAGE as error:
            self._damaged_chunk(error)
        if not starts:
            return
        start, array = np.array(starts, np.int64), np.frombuffer(data, np.uint8)
        body_at = start + _RECORD.size
        channel = numbers(array, body_at, "<u2") + self._base
        self._read.update(
            dict(zip(*(part.tolist() for part in np.unique(channel, return_counts=True)), strict=True))
        )
        yield Messages(
            data=array,
            channel=channel,
            t_ns=numbers(array, body_at + _TIME_AT, "<i8"),
            start=body_at + _MESSAGE_HEAD,
            size=numbers(array, start + 1, "<i8") - _MESSAGE_HEAD,
        )

    def _decompressed(self, chunk: Chunk) -> bytes:
        """Decompress a chunk; raise EOFError if length or CRC are wrong, or it is too large."""
        size = chunk.uncompressed_size
        self._take_room(size)
        if chunk.compression == "zstd":
            data = _of_zstd(chunk.data, size + 1)
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
            raise EOFError("it has the wrong length")
        if chunk.uncompressed_crc not in (0, zlib.crc32(data)):
            raise EOFError("its bytes do not agree with their CRC")
        return data

    def _take_room(self, size: int) -> None:
        """Count `size` bytes against the limits for decompression. Raises EOFError if one is exceeded."""
        if size > _LARGEST:
            raise EOFError(f"it is {size} bytes long when decompressed, and {_LARGEST} are read at most")
        if size > self._room:
            raise EOFError(f"the file becomes more than {_MOST_EXPANDED} times as long when decompressed")
        self._room -= size

    def _take_schema(self, body: ReadDataStream) -> None:
        schema = Schema.read(body)
        self._schemas[schema.id] = schema

    def _take_channel(self, body: ReadDataStream) -> None:
        channel = Channel.read(body)
        schema = self._schemas.get(channel.schema_id)
        found = OpenChannel(
            channel.topic,
            channel.message_encoding,
            schema.name if schema else "",
            schema.encoding if schema else "",
            schema.data.decode(errors="replace") if schema else "",
        )
        known = self.channels.setdefault(self._base + channel.id, found)
        # The summary at the end repeats all channels, without a CRC.
        if known != found:
            self.damage.append(
                f"topic {known.topic} has two different definitions{self._of}; the first one is used"
            )

    def _take_attachment(self, body: ReadDataStream) -> None:
        attachment = Attachment.read(body)
        name, data = attachment.name, attachment.data
        if attachment.media_type == COMPRESSED_TYPE and name.endswith(COMPRESSED_SUFFIX):
            size = zstandard.get_frame_parameters(data).content_size
            self._take_room(size)
            name, data = name.removesuffix(COMPRESSED_SUFFIX), _of_zstd(data, size + 1)
            if len(data) != size:
                raise EOFError("it has the wrong length")
        self.attachments[name] = data

    def _take_metadata(self, body: ReadDataStream) -> None:
        record = Metadata.read(body)
        self.on_metadata(record.name, record.metadata)
        self.metadata[record.name] = record.metadata

    def _take_statistics(self, body: ReadDataStream) -> None:
        counts = Statistics.read(body).channel_message_counts
        self.counts |= {self._base + channel: count for channel, count in counts.items()}


_READ: dict[Opcode, Callable[[McapFile, ReadDataStream], None]] = {
    Opcode.SCHEMA: McapFile._take_schema,
    Opcode.CHANNEL: McapFile._take_channel,
    Opcode.ATTACHMENT: McapFile._take_attachment,
    Opcode.METADATA: McapFile._take_metadata,
    Opcode.STATISTICS: McapFile._take_statistics,
}
_OPENS = frozenset((int(Opcode.SCHEMA), int(Opcode.CHANNEL)))


def _of_zstd(data: bytes, most: int) -> bytes:
    # decompress() would trust the length in the frame, and allocate it.
    return zstandard.ZstdDecompressor().stream_reader(data).read(most)


def _next_chunk(stream: IO[bytes], begin: int, size: int) -> int | None:
    """Return the offset of the next plausible chunk in a file, from `begin`; None if there is none."""
    at = begin
    while at < size:
        stream.seek(at)
        block = stream.read(_BLOCK + _COMPRESSION_AT + 8)
        places = sorted(place for mark in _COMPRESSIONS for place in _places(block, mark))
        for place in places:
            start = at + place - _COMPRESSION_AT
            if start >= begin and _is_chunk(stream, start, size):
                return start
        at += _BLOCK
    return None


def _places(block: bytes, mark: bytes) -> Iterator[int]:
    place = block.find(mark)
    while place >= 0:
        yield place
        place = block.find(mark, place + 1)


def _is_chunk(stream: IO[bytes], start: int, size: int) -> bool:
    """Return True if a chunk at this offset has consistent lengths in its header."""
    stream.seek(start)
    head = stream.read(_COMPRESSION_AT + 16)
    if len(head) < _COMPRESSION_AT + 16:
        return False
    opcode, length = _RECORD.unpack_from(head)
    (name,) = struct.unpack_from("<I", head, _COMPRESSION_AT)
    (inside,) = struct.unpack_from("<Q", head, _COMPRESSION_AT + 4 + name)
    whole = start + _RECORD.size + length <= size
    return bool(opcode == Opcode.CHUNK and whole and length == 28 + 4 + name + 8 + inside)


def _reason(error: Exception) -> str:
    return str(error) or type(error).__name__
