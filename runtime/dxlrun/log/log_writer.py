"""Log writer: writes a run's records as messages of an MCAP file; equal virtual runs give equal bytes."""

from __future__ import annotations

import platform
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace
from typing import IO, TypeVar, cast

import mcap.writer
import msgspec
import zstandard
from mcap.writer import CompressionType, Writer

from dxlrun.channels.event_records import Event, EventCode, LostRecords, Severity, event_text
from dxlrun.channels.ring import Handover, Payload
from dxlrun.channels.topic_messages import MessageRing, PublishedTopic
from dxlrun.errors import counted
from dxlrun.log import schemas
from dxlrun.log.log_file import LogFile
from dxlrun.log.run_messages import RunMessages
from dxlrun.log.schemas import CycleSpan, LogHeader, LogSummary, epoch_offset_ns, to_metadata
from dxlrun.messages.cdr import Codec, Value
from dxlrun.messages.declared import declared_message
from dxlrun.messages.definition import MessageType

Written = TypeVar("Written")
CHUNK_BYTES = 2 * 1024 * 1024
"""Size of the collected messages, bytes, above which they are written to the file as a chunk: the window of
zstandard at LEVEL."""
LEVEL = 6
"""Level of zstandard for chunks. The default, 3, takes 5 us a cycle instead of 15, and up to a fifth more
bytes; 7 saves another half percent."""
_COMPRESSED_FROM = 16 * 1024
"""Size from which an attachment is compressed, bytes. Smaller ones remain readable as text."""
_LIBRARY = "dxlrun"
_PACKAGE = "dxlrun_msgs"
_LIBRARIES = ("dxlrun", "mcap", "numpy")
# mcap.writer names no level and has no option for it. Other writers of this process get this level, too.
setattr(mcap.writer, "zstandard", SimpleNamespace(compress=partial(zstandard.compress, level=LEVEL)))  # noqa: B010
_MEDIA_TYPES = {".json": "application/json", ".yaml": "application/yaml", ".txt": "text/plain"}


@event_text(EventCode.RECORDER_GAP, Severity.ERROR)
def records_lost(source: str, lost: int) -> str:
    """Return the event that records of a source did not reach the log."""
    return f"{counted(lost, 'record', 'records')} of {source} lost: overwritten or damaged before reading"


class LogWriter(RunMessages):
    """Writer of one MCAP file from the records that the recorder takes from the rings.

    A disk that accepts no more bytes (OSError) stops the writing, but not the caller. The file is then
    truncated to its last whole chunk, `error` has the reason, and later records are counted. Only a file that
    cannot be created or begun raises OSError.
    """

    def __init__(self, path: Path, header: LogHeader, span: CycleSpan | None = None) -> None:
        """Create the file, write header and attachments; `span` holds the cycles of earlier parts."""
        super().__init__(header)
        self.span = span or self.span
        self.error: str | None = None
        self.late_metadata: dict[str, dict[str, str]] = {}
        """Metadata records that become known during the run; written at the end of the file."""
        self._file = LogFile(path)
        self._messages = self._lost = self._unwritten = 0
        # Times of the first and the last message so far.
        self.first_ns = self.last_ns = 0
        self._whole_bytes = self._whole_messages = 0
        self._whole_last_ns: int | None = None
        self._summary: LogSummary | None = None
        self._writer = Writer(
            cast("IO[bytes]", self._file), chunk_size=sys.maxsize, compression=CompressionType.ZSTD
        )
        self._chunk_bytes = 0
        self._sequences: dict[int, int] = {}
        self._known: dict[str, int] = {}
        """Number of each message type in the file, by the type's name."""
        try:
            self._write_header()
        except BaseException:
            self._file.close()
            raise

    @property
    def size(self) -> int:
        """Size of the file so far, bytes, without messages that are still collected for the next chunk."""
        return self._file.tell()

    def _write_header(self) -> None:
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
        self._open_channels()
        self._end_chunk()

    def _channel(self, topic: str, message: MessageType, *, latched: bool = False) -> int:
        if message.name not in self._known:
            self._known[message.name] = self._writer.register_schema(
                message.name, schemas.SCHEMA_ENCODING, message.text.encode()
            )
        about = {"topic_type_hash": message.type_hash}
        if latched:
            about["offered_qos_profiles"] = schemas.LATCHED
        channel = self._writer.register_channel(topic, schemas.ENCODING, self._known[message.name], about)
        self._sequences[channel] = 0
        return channel

    def _put(self, channel: int, t_ns: int, wall_ns: int, data: bytes) -> None:
        sequence = self._sequences[channel]
        self._sequences[channel] = sequence + 1
        self._writer.add_message(channel, wall_ns, data, wall_ns, sequence & 0xFFFFFFFF)
        self._messages += 1
        self._chunk_bytes += len(data)
        self.first_ns = self.first_ns or t_ns
        self.last_ns = max(self.last_ns, t_ns)

    def _end_chunk(self) -> None:
        """Write the collected messages as a chunk; a failure later loses only messages after this point."""
        self._write_packets()
        self._writer.flush()
        self._whole_bytes, self._whole_messages = self._file.tell(), self._messages
        self._whole_last_ns = self.span.last_ns
        self._chunk_bytes = 0

    def _guarded(self, write: Callable[[Written], None], what: Written) -> None:
        """Call `write` with a record; after the writing has stopped, count the record as unwritten."""
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
            # Bytes after the last whole chunk remain; a reader stops there.
            return
        self.span.last_ns = self._whole_last_ns
        if self.span.last_ns is not None and self._file.tell() == self._whole_bytes:
            self.error += f"; {self.span.last_cycle_text}"

    def write_record(self, kind: int, payload: Payload) -> None:
        """Write one record from a ring as a message. Raises ValueError for a kind that logs do not have."""
        if kind not in self._takers:
            raise ValueError(f"a record of kind {kind} does not belong in a log")
        self._guarded(self._takers[kind], payload)
        if self._chunk_bytes > CHUNK_BYTES:
            self.finish_chunk()

    def machine(self, t_ns: int, data: bytes) -> None:
        """Write an encoded message about the machine's load to /machine; the first one opens the topic."""
        self._guarded(lambda message: self._machine(t_ns, message), data)

    def gap(self, source: str, lost: int) -> None:
        """Write an event that `lost` records of `source` did not reach the log, and count them."""
        self._lost += lost
        code, severity, text = records_lost(source, lost)
        data = msgspec.json.encode(LostRecords(source, lost))
        event = Event(self.last_ns, code, severity, "recorder", text, data)
        self._guarded(self.event, event)

    def finish_chunk(self) -> None:
        """Write the collected messages, so that a reader finds them even after this process was killed."""
        if self.error is None:
            try:
                self._end_chunk()
            except OSError as error:
                self._give_up(error)

    def sync(self) -> None:
        """Block until the disk has stored all written chunks, so that they survive a power failure."""
        if self.error is None:
            try:
                self._file.sync()
            except OSError as error:
                self._give_up(error)

    def close(self) -> LogSummary:
        """Finish the file and return message count, size and error; later calls return the same summary.

        The summary also has an error when the file no longer exists.
        """
        if self._summary is not None:
            return self._summary
        if self.error is None:
            try:
                self._finish()
            except OSError as error:
                self._give_up(error)
        if self._file.gone:
            self.error = "another program deleted or moved the file during the run"
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


class TopicWriter:
    """Writer of a measurement's own topics into a new log file, without a robot.

        log = TopicWriter(Path("heat.mcap"), "heat", 1_000_000_000, {"setup": {"room": "lab"}})
        heat = log.open_topic("/heat", Heat)  # a dataclass
        log.append(heat, t_ns, (t_ns, 21.5))  # its fields
        log.close()

    Args:
        path: The file.
        name: Name in place of the robot's.
        period_ns: Period of the measurement.
        metadata: Metadata records by name, in addition to those of the machine.

    Raises:
        OSError: The file cannot be created.
    """

    def __init__(self, path: Path, name: str, period_ns: int, metadata: Mapping[str, dict[str, str]]) -> None:
        here = platform.uname()
        header = LogHeader(
            robot=name,
            joints=(),
            buses=(),
            controllers=(),
            period_ns=period_ns,
            epoch_offset_ns=epoch_offset_ns(),
            metadata={
                **metadata,
                "versions": {"python": sys.version.split()[0]} | {name: version(name) for name in _LIBRARIES},
                "kernel": {"system": here.system, "release": here.release, "version": here.version}
                | {"machine": here.machine},
            },
        )
        self._log = LogWriter(path, header)
        self._ring = MessageRing(Handover(self._log.write_record))
        self._codecs: list[Codec] = []

    def open_topic(self, name: str, message: type) -> int:
        """Add a topic with messages of a dataclass or msgspec struct; return its number for `append`."""
        codec = Codec(declared_message(message, _PACKAGE).type)
        self._codecs.append(codec)
        return self._ring.announce(PublishedTopic(name, codec.message))

    def append(self, topic: int, t_ns: int, values: Sequence[Value]) -> None:
        """Append a message to a topic; `values` are its fields in sequence, `t_ns` is monotonic time."""
        self._ring.message(topic, t_ns, self._codecs[topic].pack_row(values))

    def close(self) -> LogSummary:
        """Finish the file and return its summary, with `error` if the disk was full."""
        return self._log.close()
