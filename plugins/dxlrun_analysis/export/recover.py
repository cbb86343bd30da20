"""Recover: make a whole, indexed MCAP file of one that is unfinished or damaged, and declare what is lost.

The layout of records is that of the MCAP specification (mcap.dev/spec). A record that cannot be read is
left out; behind it the next chunk is looked for, by its bytes. Of a chunk that the file's end cuts in two,
the messages in front of the cut are taken. Memory is bounded by the largest chunk and attachment.
"""

from __future__ import annotations

import io
import os
import struct
import zlib
from collections.abc import Generator, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, cast

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Header, Metadata, Schema, Statistics
from mcap.writer import CompressionType, Writer

from dxlrun.errors import LogError, counted
from dxlrun.log import schemas
from dxlrun.log.log_writer import CHUNK_BYTES, LogFile
from dxlrun.log.part_writer import FOLDER_MODE
from dxlrun.log.parts import log_files
from dxlrun.plan.recording_plan import PART_END_NAME, RECOVERED_NAME

_MAGIC = b"\x89MCAP0\r\n"
_RECORD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
_TO_COMPRESSION = 37
"""Bytes of a chunk's record before the length of its compression's name."""
_CHUNKS = (b"\x04\x00\x00\x00zstd", b"\x03\x00\x00\x00lz4")
"""How the records of chunks look at that place."""
_PRIVATE = 0x80
"""Opcodes from here on are for records of applications."""
_FOOTER = struct.Struct("<BQQQI")
_LARGEST_CHUNK = 64 << 20
_BLOCK = 1 << 20
_UNREADABLE = (
    McapError,
    zstandard.ZstdError,
    struct.error,
    ValueError,
    EOFError,
    RuntimeError,
    OverflowError,  # a length that no stream can have
)


@dataclass(slots=True)
class Recovered:
    """What became of one file."""

    messages: int = 0
    """In the new file."""
    lost_messages: int = 0
    """Messages that the numbers of those around them show to be missing; only logs of dxlrun number them."""
    lost_bytes: int = 0
    """Bytes of the old file that could not be used."""
    goes_on: bool = False
    """A part that says that another one follows it."""
    end: bool = False
    """The old file had its end: nothing is missing behind the last message."""
    sentences: list[str] = field(default_factory=list)
    """What is lost, one sentence a place."""

    @property
    def whole(self) -> bool:
        """Nothing was wrong with the file."""
        return self.end and not self.sentences and not self.lost_messages

    def to_metadata(self, source: str) -> dict[str, str]:
        """Return the record `recovered`."""
        return {
            "from": source,
            "messages": str(self.messages),
            "lost_messages": str(self.lost_messages),
            "lost_bytes": str(self.lost_bytes),
            "end": "there" if self.end else "missing",
            **{f"lost {number}": sentence for number, sentence in enumerate(self.sentences)},
        }


_MOST_SENTENCES = 20
"""More are only counted."""


def recover_file(source: Path, target: Path) -> Recovered:
    """Write what can be read of an MCAP file into a new one, and return what is lost.

    Raises LogError with one sentence when the source is no MCAP file or has nothing that can be used, and
    OSError when the target cannot be written.
    """
    try:
        with source.open("rb") as stream:
            size = os.fstat(stream.fileno()).st_size
            if size == 0:
                raise LogError(f"{source}: the file is empty; its recorder never began to write")
            if stream.read(len(_MAGIC)) != _MAGIC:
                raise LogError(f"{source}: this is no MCAP file, so it is no log of dxlrun")
            walk = _Walk(stream, size)
            return _write(walk, source, target)
    except OSError as error:
        if error.filename is not None and Path(error.filename) == source:
            raise LogError(f"{source}: cannot be read: {error.strerror or error}") from error
        raise


class _Walk:
    """The records of a file that can be read, in order; chunks as the records in them."""

    def __init__(self, stream: IO[bytes], size: int) -> None:
        self._stream = stream
        self._size = size
        self._chunked = False
        """True behind the first chunk: a writer that makes chunks puts every message into one."""
        self.result = Recovered()

    def lost(self, sentence: str, size: int) -> None:
        """Declare bytes that cannot be used."""
        self.result.lost_bytes += size
        if len(self.result.sentences) < _MOST_SENTENCES:
            self.result.sentences.append(sentence)

    def records(self) -> Iterator[tuple[int, bytes]]:
        """Yield opcode and content of each record outside of the summary."""
        at = len(_MAGIC)
        while at + _RECORD.size <= self._size:
            self._stream.seek(at)
            opcode, length = _RECORD.unpack(self._stream.read(_RECORD.size))
            end = at + _RECORD.size + length
            if opcode == Opcode.DATA_END:
                self.result.end = self._ended()
                return
            known = 0 < opcode <= Opcode.DATA_END or opcode >= _PRIVATE
            if not known or end > self._size:
                at = yield from self._behind_damage(at, opcode)
                continue
            content = self._stream.read(length)
            if opcode == Opcode.CHUNK:
                self._chunked = True
                yield from self._chunk(content, at)
            elif opcode == Opcode.MESSAGE and self._chunked:
                # no checksum vouches for it, and one flipped bit makes it of the index of a chunk
                self.lost(f"a message at byte {at} is in no chunk, as all others are: left out", length)
            else:
                yield opcode, content
            at = end
        if at < self._size:
            self.lost(f"the last {counted(self._size - at, 'byte', 'bytes')} are no record", self._size - at)

    def summary(self) -> Iterator[tuple[int, bytes]]:
        """Yield schemas, channels and statistics that a finished file has once more behind its data."""
        at = self._size - len(_MAGIC) - _FOOTER.size
        if at < len(_MAGIC):
            return
        self._stream.seek(at)
        opcode, length, start, _, _ = _FOOTER.unpack(self._stream.read(_FOOTER.size))
        if (opcode, length) != (Opcode.FOOTER, _FOOTER.size - _RECORD.size) or not 0 < start < at:
            return
        if at - start > _LARGEST_CHUNK:
            return
        self._stream.seek(start)
        data = self._stream.read(at - start)
        begin = 0
        while begin + _RECORD.size <= len(data):
            opcode, length = _RECORD.unpack_from(data, begin)
            body, begin = begin + _RECORD.size, begin + _RECORD.size + length
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.STATISTICS) and begin <= len(data):
                yield opcode, data[body:begin]

    def _ended(self) -> bool:
        """Return whether the file ends as it must behind its data."""
        self._stream.seek(self._size - len(_MAGIC))
        return self._stream.read() == _MAGIC

    def _behind_damage(self, at: int, opcode: int) -> Generator[tuple[int, bytes], None, int]:
        """Yield what is in a chunk that the file's end cuts; return where the next whole chunk begins."""
        found = self._next_chunk(at + 1)
        if found is None and opcode == Opcode.CHUNK:
            self._stream.seek(at + _RECORD.size)
            yield from self._chunk(self._stream.read(_LARGEST_CHUNK), at, cut=True)
            return self._size
        end = self._size if found is None else found
        self.lost(
            f"{counted(end - at, 'byte', 'bytes')} behind byte {at} cannot be read and are left out", end - at
        )
        return end

    def _next_chunk(self, at: int) -> int | None:
        """Return where the next record of a chunk lies that fits into the file."""
        overlap = _TO_COMPRESSION + max(map(len, _CHUNKS))
        self._stream.seek(at)
        before = b""
        while block := self._stream.read(_BLOCK):
            data = before + block
            start = at - len(before)
            places = sorted(place for name in _CHUNKS for place in _places(data, name))
            for place in places:
                begin = start + place - _TO_COMPRESSION
                if begin >= at - len(before) and place >= _TO_COMPRESSION and self._fits(begin):
                    return begin
            at = start + len(data)
            self._stream.seek(at)
            before = data[-overlap:]
        return None

    def _fits(self, at: int) -> bool:
        self._stream.seek(at)
        length: int
        opcode, length = _RECORD.unpack(self._stream.read(_RECORD.size))
        first, last = struct.unpack("<QQ", self._stream.read(16))
        return opcode == Opcode.CHUNK and at + _RECORD.size + length <= self._size and first <= last

    def _chunk(self, content: bytes, at: int, *, cut: bool = False) -> Iterator[tuple[int, bytes]]:
        """Yield the records of a chunk; of one that is cut, those in front of the cut."""
        try:
            chunk = Chunk.read(ReadDataStream(io.BytesIO(content)))
            data = _decompressed(chunk)
            if len(data) < chunk.uncompressed_size and not cut:
                raise EOFError("it is not as long as it says")  # and no CRC could vouch for what is there
        except _UNREADABLE as error:
            what = str(error) or type(error).__name__
            self.lost(f"a chunk at byte {at} is damaged and left out: {what}", len(content))
            return
        start = 0
        while start + _RECORD.size <= len(data):
            opcode, length = _RECORD.unpack_from(data, start)
            body, end = start + _RECORD.size, start + _RECORD.size + length
            if end > len(data):
                break
            yield opcode, data[body:end]
            start = end
        if len(data) < chunk.uncompressed_size:
            missing = chunk.uncompressed_size - start
            self.lost(
                f"the chunk at byte {at} is cut: the last {missing} of its {chunk.uncompressed_size} bytes "
                "are lost",
                missing,
            )
        elif start < len(data):
            self.lost(f"the chunk at byte {at} has a record that is longer than it", len(content))


def _places(data: bytes, name: bytes) -> Iterator[int]:
    place = data.find(name)
    while place >= 0:
        yield place
        place = data.find(name, place + 1)


def _decompressed(chunk: Chunk) -> bytes:
    """Return the records of a chunk, of one that is cut its first ones; raises one of _UNREADABLE."""
    size = chunk.uncompressed_size
    if size > _LARGEST_CHUNK:
        raise EOFError(f"it would be {size} bytes long")
    if chunk.compression == "zstd":
        data = zstandard.ZstdDecompressor().stream_reader(chunk.data).read(size + 1)
    elif chunk.compression == "lz4":
        data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1)
    elif chunk.compression == "":
        data = chunk.data
    else:
        raise EOFError(f"its compression {chunk.compression!r} is not known")
    if len(data) > size:
        raise EOFError("it is not as long as it says")
    if len(data) == size and chunk.uncompressed_crc not in (0, zlib.crc32(data)):
        raise EOFError("its bytes do not agree with their CRC")
    return data


class _Copy:
    """Writes records into a new file, with channels and schemas by their new numbers."""

    def __init__(self, file: LogFile) -> None:
        self._writer = Writer(
            cast("IO[bytes]", file), chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD
        )
        self._started = False
        self._schemas: dict[int, int] = {0: 0}
        self._channels: dict[int, int] = {}
        self._next: dict[int, int] = {}
        """The number that the next message of a channel has."""
        self.numbered = self.goes_on = False
        self.messages = 0
        self.in_source: int | None = None
        """Messages that the old file says it has."""
        self._missing = 0

    @property
    def lost(self) -> int:
        """How many messages are known to be lost."""
        return max(self._missing, (self.in_source or 0) - self.messages)

    def take(self, opcode: int, content: bytes) -> None:
        """Write one record. Raises one of _UNREADABLE."""
        stream = ReadDataStream(io.BytesIO(content))
        if opcode == Opcode.MESSAGE:
            self._message(content)
        elif opcode == Opcode.HEADER:
            self.start(Header.read(stream).profile)
        elif opcode == Opcode.SCHEMA:
            schema = Schema.read(stream)
            if schema.id not in self._schemas:
                self._schemas[schema.id] = self._writer.register_schema(
                    schema.name, schema.encoding, schema.data
                )
        elif opcode == Opcode.CHANNEL:
            self._channel(Channel.read(stream))
        elif opcode == Opcode.STATISTICS:
            self.in_source = Statistics.read(stream).message_count
        elif opcode == Opcode.ATTACHMENT:
            one = Attachment.read(stream)
            self._writer.add_attachment(one.create_time, one.log_time, one.name, one.media_type, one.data)
        elif opcode == Opcode.METADATA:
            record = Metadata.read(stream)
            self.numbered |= record.name == schemas.METADATA_NAME
            self.goes_on |= record.name == PART_END_NAME and record.metadata.get("last") == "no"
            self._writer.add_metadata(record.name, record.metadata)

    def start(self, profile: str = schemas.PROFILE) -> None:
        """Begin the file, once."""
        if not self._started:
            self._started = True
            self._writer.start(profile=profile, library="dxlrun recover")

    def _channel(self, channel: Channel) -> None:
        if channel.id in self._channels:
            return
        if channel.schema_id not in self._schemas:
            raise ValueError(f"the schema of {channel.topic} is lost")
        self._channels[channel.id] = self._writer.register_channel(
            channel.topic, channel.message_encoding, self._schemas[channel.schema_id], channel.metadata
        )

    def _message(self, content: bytes) -> None:
        channel, sequence, log_time, publish_time = _MESSAGE.unpack_from(content)
        if channel not in self._channels:
            raise ValueError("the channel of a message is lost")
        self._writer.add_message(
            self._channels[channel], log_time, content[_MESSAGE.size :], publish_time, sequence
        )
        self.messages += 1
        if self.numbered:
            self._missing += max(0, sequence - self._next.get(channel, 0))
            self._next[channel] = max(self._next.get(channel, 0), sequence + 1)

    def finish(self, result: Recovered, source: str) -> None:
        """Write what was lost, and the index."""
        self._writer.flush()  # type: ignore[no-untyped-call]  # mcap does not annotate it
        self._writer.add_metadata(RECOVERED_NAME, result.to_metadata(source))
        self._writer.finish()  # type: ignore[no-untyped-call]  # mcap does not annotate it


def _write(walk: _Walk, source: Path, target: Path) -> Recovered:
    result = walk.result
    file = LogFile(target)
    try:
        copy = _Copy(file)
        begun = False
        for opcode, content in walk.records():
            _take(copy, walk, opcode, content)
            if not begun:  # behind the header: the chunk that defines the channels may be the damaged one
                begun = True
                copy.start()
                for twice in [*walk.summary()]:
                    _take(copy, walk, *twice)
        if not copy.messages:
            raise LogError(f"{source}: there is no message in it that could be read")
        result.messages, result.lost_messages = copy.messages, copy.lost
        result.goes_on = copy.goes_on
        if not result.end:
            result.sentences.append("it has no end: what was written last is lost with it")
        copy.finish(result, source.name)
        file.sync()
    finally:
        file.close()
    return result


def _take(copy: _Copy, walk: _Walk, opcode: int, content: bytes) -> None:
    if opcode != Opcode.HEADER:
        copy.start()
    try:
        copy.take(opcode, content)
    except _UNREADABLE as error:
        walk.lost(f"a record is left out: {error}", len(content))


@dataclass(frozen=True, slots=True)
class RecoveredLog:
    """What became of a log: of its file, or of each of its parts."""

    files: dict[str, Recovered]
    """By name."""
    missing: tuple[str, ...] = ()
    """A sentence for each part that is not there."""

    @property
    def whole(self) -> bool:
        """Nothing is wrong with any of them."""
        return not self.missing and all(one.whole for one in self.files.values())


def recover_log(source: Path, target: Path) -> RecoveredLog:
    """Recover a file, or all parts of a log in a new directory; raises as recover_file.

    A part of which nothing can be read is declared as missing.
    """
    parts = log_files(source)
    if not source.is_dir():
        return RecoveredLog({source.name: recover_file(source, target)})
    target.mkdir(FOLDER_MODE)
    files: dict[str, Recovered] = {}
    missing = [*parts.damage]
    for part in parts.files:
        try:
            files[part.name] = recover_file(part, target / part.name)
        except LogError as error:
            missing.append(f"{error}")
            (target / part.name).unlink(missing_ok=True)
    if not files:
        target.rmdir()
        raise LogError(missing[-1])
    last = parts.files[-1].name
    if last in files and files[last].goes_on:
        missing.append(f"the parts behind {last} are missing")
    return RecoveredLog(files, tuple(missing))
