"""Log reader: opens MCAP logs, also unfinished, damaged or foreign ones, and reports damage."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
import numpy as np
from numpy.typing import NDArray

from dxlrun.errors import InputError, LogError, missing_extra, suggestion
from dxlrun.log import schemas
from dxlrun.log.reading.chunks import McapFile, gathered
from dxlrun.log.reading.slices import Log, Slicer, joined
from dxlrun.log.reading.walk import LogWalk
from dxlrun.log.schemas import LogHeader, from_metadata
from dxlrun.messages.cdr_columns import ColumnReader, FieldColumn

if TYPE_CHECKING:
    import pyarrow as pa

__all__ = ["UNREADABLE", "Log", "LogFollower", "LogReader", "Topic", "open_log", "read_log"]

UNREADABLE = (msgspec.MsgspecError, ValueError, RecursionError)
"""Exceptions of msgspec for damaged or too deep JSON in a log, such as a plan or a command's data."""
SLICE_BYTES = 8 << 20
"""Size to which chunks are joined before they are decoded, bytes, because each slice costs a number of NumPy
calls."""


class Topic(msgspec.Struct, frozen=True):
    """Message type and number of messages of a topic in a log."""

    type: str
    """Name of the message type, such as `sensor_msgs/msg/JointState`."""
    count: int | None
    """Number of messages; None if the file was not finished."""


class LogReader:
    """An open log file or directory: metadata, and records that are read piece by piece.

    Any MCAP file can be opened. A file of another program has no header and no slices, only columns. No file
    stays open between calls.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        walk = LogWalk(path)
        walk.survey()
        self._file = walk.file
        self._about: Log | None = None
        self._searched = False
        self.share = 0.0
        """Share of the file that has been read by `slices`, 0 to 1, for a progress bar."""
        self.header = _header(path, self._file)
        """Robot, joints and buses of a log of dxlrun; None for a file of another program."""

    def __enter__(self) -> LogReader:
        """Return the reader, for `with`."""
        return self

    def __exit__(self, *_: object) -> None:
        """Do nothing: the file is open only during reads."""

    @property
    def metadata(self) -> dict[str, dict[str, str]]:
        """Metadata records by name, such as versions, kernel and scheduler, each as key and value."""
        return self._file.metadata

    @property
    def attachments(self) -> dict[str, bytes]:
        """Attached files by name, such as the robot file and the plan."""
        return self._file.attachments

    @property
    def topics(self) -> dict[str, Topic]:
        """Type and message count of each topic. In an unfinished file this reads all data."""
        if not self._file.finished:
            self._file_of_all()
        topics: dict[str, Topic] = {}
        for channel, known in sorted(self._file.channels.items()):
            count = self._file.counts.get(channel, 0) if self._file.counts else None
            before = topics.get(known.topic)
            if before is not None and before.count is not None and count is not None:
                count += before.count
            topics[known.topic] = Topic(known.type_name, count)
        return topics

    @property
    def damage(self) -> tuple[str, ...]:
        """A sentence for each missing or unreadable piece of the log. The first access reads all data."""
        return self.about.damage if self.header else tuple(self._file_of_all().damage)

    @property
    def about(self) -> Log:
        """The log with metadata and damage, but no cycles, packets or events.

        The first access reads all data.

        Raises LogError for a file of another program.
        """
        if self._about is None:
            for _ in self.slices():
                pass
        if self._about is None:
            raise LogError(_foreign(self.path))
        return self._about

    def slices(self, *, packets: bool = True) -> Iterator[Log]:
        """Yield the log piece by piece, each with its cycles, packets, events, commands and topics.

        Each slice has complete cycles with all their packets, including those of the idle time after a cycle.
        `about` has all that belongs to no slice (attachments, damage). Without `packets`, packets are not
        read. Raises LogError for a file of another program.
        """
        if self.header is None:
            raise LogError(_foreign(self.path))
        known = McapFile(metadata=dict(self.metadata), attachments=dict(self.attachments))
        walk = LogWalk(self.path, known)
        slicer = Slicer(self.header, walk, packets=packets)
        with _readable(self.path):
            for messages in gathered(walk.messages(), SLICE_BYTES):
                self.share = walk.share
                part = slicer.add_messages(messages)
                # Free the memory of the messages while the caller uses the slice.
                del messages
                yield part
            yield slicer.remaining_slice()
        if packets or self._about is None:
            self._about = slicer.about()

    def columns(self, topic: str, *fields: str) -> dict[str, NDArray[np.generic]]:
        """Return fields (default: all) of a topic's messages as arrays, one row per message, plus `t_ns`.

        A field that is not an array of constant length becomes an array of objects.
        """
        parts = list(self._trees(topic, fields or None))
        chosen = fields or self._column_reader(topic).leaves
        found: dict[str, NDArray[np.generic]] = {
            "t_ns": np.concatenate([times for times, _ in parts]) if parts else np.zeros(0, np.int64)
        }
        for name in chosen:
            columns = [tree.leaf(name) for _, tree in parts]
            found[name] = FieldColumn.joined(columns).array() if columns else np.zeros(0)
        return found

    def batches(self, topic: str, *fields: str) -> Iterator[dict[str, NDArray[np.generic]]]:
        """Yield the same arrays as `columns`, but for one piece of the file after another, to save memory.

        `t_ns` is added: ns of the run's clock; in files of other programs, the time in the file. Fields of
        nested messages have dots: `pose.pose.position.x`. Rows of a sequence of messages, `status.name`, are
        arrays. Messages that do not fit their definition are skipped.

        Raises:
            LogError: The log does not have the topic or a field, or its messages are not CDR with a ROS 2
                definition.
        """
        for times, tree in self._trees(topic, fields or None):
            chosen = fields or tree.leaves
            yield {"t_ns": times, **{name: tree.leaf(name).array() for name in chosen}}

    def arrow(self, topic: str, *fields: str) -> pa.RecordBatchReader:
        """Return a topic's messages as an Arrow stream, read piece by piece, with nested fields as structs.

        Raises InputError without pyarrow, which the extra `logs` has.
        """
        try:
            import pyarrow as pa
        except ImportError as error:
            raise InputError(missing_extra("Arrow", "logs", "pyarrow") or str(error)) from error
        from dxlrun.log.reading.arrow import batch_of, schema_of

        reader = self._column_reader(topic)
        schema = schema_of(reader, fields or None)
        return pa.RecordBatchReader.from_batches(
            schema, (batch_of(schema, times, tree) for times, tree in self._trees(topic, fields or None))
        )

    def _trees(
        self, topic: str, fields: Sequence[str] | None
    ) -> Iterator[tuple[NDArray[np.int64], FieldColumn]]:
        """Yield times (ns of the run's clock) and decoded columns of a topic, for one piece after another."""
        reader = self._column_reader(topic)
        missing = reader.find_unknown(fields or ())
        if missing is not None:
            raise LogError(
                f"{self.path}: messages of {topic} have no field {missing}; "
                f"{suggestion(missing, reader.leaves)}"
            )
        offset_ns = self.header.epoch_offset_ns if self.header is not None else 0
        walk = LogWalk(self.path)
        for messages in gathered(walk.messages(), SLICE_BYTES):
            channels = walk.file.channels.items()
            same = [at for at, one in channels if one.topic == topic and one.type == reader.message]
            rows = np.flatnonzero(np.isin(messages.channel, same))
            if not len(rows):
                continue
            try:
                whole, tree = reader.read_columns(
                    messages.data, messages.start[rows], messages.size[rows], fields
                )
            except ValueError as error:
                raise LogError(f"{self.path}: messages of {topic} cannot be read: {error}") from error
            if len(whole):
                yield messages.t_ns[rows[whole]] - offset_ns, tree

    def _column_reader(self, topic: str) -> ColumnReader:
        """Return the decoder for a topic's messages. Raises LogError for an unknown topic or encoding."""
        channels = self._file.channels.values()
        if not any(known.topic == topic for known in channels):
            self._file_of_all()
        known = next((known for known in self._file.channels.values() if known.topic == topic), None)
        if known is None:
            names = tuple({one.topic for one in self._file.channels.values()})
            raise LogError(f"{self.path}: no topic {topic}; {suggestion(topic, names)}")
        if known.encoding != "cdr" or known.schema_encoding != schemas.SCHEMA_ENCODING:
            raise LogError(
                f"{self.path}: messages of {topic} have the encoding {known.encoding!r} and a schema in "
                f"{known.schema_encoding!r}; dxlrun reads only 'cdr' with 'ros2msg'"
            )
        try:
            return ColumnReader(known.type)
        except ValueError as error:
            raise LogError(f"{self.path}: messages of {topic} cannot be read: {error}") from error

    def _file_of_all(self) -> McapFile:
        """Read the whole file once, because some channels and damage are only found among the messages."""
        if not self._searched:
            self._searched = True
            walk = LogWalk(self.path)
            for _ in walk.messages():
                pass
            self._file = walk.file
        return self._file


def open_log(path: str | Path) -> LogReader:
    """Open a log or any other MCAP file for reading.

    Raises:
        LogError: The file is missing, empty or not MCAP, or is a log of dxlrun that this version cannot read.
    """
    return LogReader(Path(path))


def read_log(path: str | Path) -> Log:
    """Read a whole log of dxlrun into memory. Raises LogError for any other or unreadable file."""
    reader = LogReader(Path(path))
    slices = list(reader.slices())
    return joined(reader.about, slices)


class LogFollower:
    """Reads a log while it is being written; each call of `new` returns what was added, without packets.

    Raises LogError as read_log, at each call.
    """

    def __init__(self, path: str | Path) -> None:
        self._path = Path(path)
        self._walk = LogWalk(self._path)
        self._slicer: Slicer | None = None

    def new(self) -> Log:
        """Return cycles, events, commands and topics that were added since the last call."""
        self._walk.file.damage.clear()
        with _readable(self._path):
            slices = [self._made().add_messages(messages) for messages in self._walk.messages()]
            return joined(self._made().about(), slices)

    def _made(self) -> Slicer:
        if self._slicer is None:
            header = _header(self._path, self._walk.file)
            if header is None:
                raise LogError(_foreign(self._path))
            self._slicer = Slicer(header, self._walk, packets=False)
        return self._slicer


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    try:
        yield
    except LogError:
        raise
    except ValueError as error:
        raise LogError(f"{path}: this version of dxlrun cannot read the log: {error}") from error


def _header(path: Path, file: McapFile) -> LogHeader | None:
    """Return the header of a log of dxlrun; None for another program's file.

    If the header in the metadata is damaged, its copy in the attachments is used.
    """
    text = file.metadata.get(schemas.METADATA_NAME)
    attached = file.attachments.get(schemas.HEADER_ATTACHMENT)
    if text is None and attached is None:
        return None
    with _readable(path):
        try:
            if text is not None:
                return from_metadata(text)
        except ValueError:
            if attached is None:
                raise
        return from_metadata(_attached(attached or b""))


def _attached(data: bytes) -> dict[str, str]:
    try:
        return msgspec.json.decode(data, type=dict[str, str])
    except msgspec.MsgspecError as error:
        raise ValueError(f"its header is damaged: {error}") from error


def _foreign(path: Path) -> str:
    return f"{path}: this MCAP file is not a log of dxlrun: it has no metadata '{schemas.METADATA_NAME}'"
