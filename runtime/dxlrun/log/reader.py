"""Reading a log: whole, unfinished, damaged, or of another program; the unreadable is reported."""

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
from dxlrun.messages.cdr_columns import Column, ColumnReader

if TYPE_CHECKING:
    import pyarrow as pa

__all__ = ["UNREADABLE", "Log", "LogFollower", "LogReader", "Topic", "open_log", "read_log"]

UNREADABLE = (msgspec.MsgspecError, ValueError, RecursionError)
"""What msgspec raises for JSON in a log (the plan, data of a command) that is damaged or too deep."""
SLICE_BYTES = 8 << 20
"""Chunks are taken together until they are so long: what is done with a slice costs by calls of numpy."""


class Topic(msgspec.Struct, frozen=True):
    """What a log says about one of its topics."""

    type: str
    """Name of its messages: `sensor_msgs/msg/JointState`."""
    count: int | None
    """Messages; None where the file has no statistics: it was not finished."""


class LogReader:
    """A log that is open: what it says about itself, and its records one after the other in flat memory.

    Any MCAP file can be opened; one of another program has no header, no slices, and columns only. Nothing is
    held open between the calls.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        walk = LogWalk(path)
        walk.survey()
        self._file = walk.file
        self._about: Log | None = None
        self._searched = False
        self.share = 0.0
        """Of the file, how much the slices that were yielded have gone through."""
        self.header = _header(path, self._file)
        """Of a log of dxlrun; None: another program wrote the file."""

    def __enter__(self) -> LogReader:
        """Return the reader."""
        return self

    def __exit__(self, *_: object) -> None:
        """Nothing is left open."""

    @property
    def metadata(self) -> dict[str, dict[str, str]]:
        """Records of text by name: versions, kernel, scheduler."""
        return self._file.metadata

    @property
    def attachments(self) -> dict[str, bytes]:
        """Robot file, plan: by name."""
        return self._file.attachments

    @property
    def topics(self) -> dict[str, Topic]:
        """The topics of the file; of one that has no end its messages are gone through for that."""
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
        """A sentence for each thing that is missing or could not be read, by going through all of it once."""
        return self.about.damage if self.header else tuple(self._file_of_all().damage)

    @property
    def about(self) -> Log:
        """All that the file says about itself, as a log without records; the file is gone through for its
        damage, unless it was. Raises LogError for a file of another program."""
        if self._about is None:
            for _ in self.slices():
                pass
        if self._about is None:
            raise LogError(_foreign(self.path))
        return self._about

    def slices(self, *, packets: bool = True) -> Iterator[Log]:
        """Yield cycles, packets, events, commands and topics as logs of their own, in the order of the file.

        Each has whole cycles with all their packets, also those of the idle time after them; what belongs to
        no slice (attachments, damage) is in `about`. Without `packets` these are not looked at. Raises
        LogError for a file of another program.
        """
        if self.header is None:
            raise LogError(_foreign(self.path))
        known = McapFile(metadata=dict(self.metadata), attachments=dict(self.attachments))
        walk = LogWalk(self.path, known)
        slicer = Slicer(self.header, walk, packets=packets)
        with _readable(self.path):
            for messages in gathered(walk.messages(), SLICE_BYTES):
                self.share = walk.share
                part = slicer.take(messages)
                del messages  # what looks at the part does not need their memory
                yield part
            yield slicer.rest()
        if packets or self._about is None:
            self._about = slicer.about()

    def columns(self, topic: str, *fields: str) -> dict[str, NDArray[np.generic]]:
        """Return fields of all messages of a topic, without `fields` all, one row each: `batches`, joined.

        A field that is not an array of the same length everywhere becomes an array of objects.
        """
        parts = list(self._trees(topic, fields or None))
        chosen = fields or self._column_reader(topic).leaves
        found: dict[str, NDArray[np.generic]] = {
            "t_ns": np.concatenate([times for times, _ in parts]) if parts else np.zeros(0, np.int64)
        }
        for name in chosen:
            columns = [tree.leaf(name) for _, tree in parts]
            found[name] = Column.joined(columns).array() if columns else np.zeros(0)
        return found

    def batches(self, topic: str, *fields: str) -> Iterator[dict[str, NDArray[np.generic]]]:
        """Yield fields of the messages of a topic, without `fields` all, chunk by chunk in flat memory.

        Beside them `t_ns`: ns of the run's clock, in files of other programs the time in the file. Fields of
        nested messages have dots: `pose.pose.position.x`; of a sequence of messages, `status.name`, each row
        is an array. Raises LogError for a topic or a field that the log does not have, and for messages that
        are not CDR with a definition of ROS 2; messages that do not fit their definition are left out.
        """
        for times, tree in self._trees(topic, fields or None):
            chosen = fields or tree.leaves
            yield {"t_ns": times, **{name: tree.leaf(name).array() for name in chosen}}

    def arrow(self, topic: str, *fields: str) -> pa.RecordBatchReader:
        """Return the messages of a topic for Arrow, chunk by chunk; nested as they are. Raises as `batches`.

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

    def _trees(self, topic: str, fields: Sequence[str] | None) -> Iterator[tuple[NDArray[np.int64], Column]]:
        """Yield times and fields of the messages of a topic, chunk by chunk."""
        reader = self._column_reader(topic)
        missing = reader.check(fields or ())
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
                whole, tree = reader.read(messages.data, messages.start[rows], messages.size[rows], fields)
            except ValueError as error:
                raise LogError(f"{self.path}: messages of {topic} cannot be read: {error}") from error
            if len(whole):
                yield messages.t_ns[rows[whole]] - offset_ns, tree

    def _column_reader(self, topic: str) -> ColumnReader:
        """Return how messages of a topic are read. Raises LogError."""
        channels = self._file.channels.values()
        if not any(known.topic == topic for known in channels):
            self._file_of_all()
        known = next((known for known in self._file.channels.values() if known.topic == topic), None)
        if known is None:
            names = tuple({one.topic for one in self._file.channels.values()})
            raise LogError(f"{self.path}: no topic {topic}; {suggestion(topic, names)}")
        if known.encoding != "cdr" or known.schema_encoding != schemas.SCHEMA_ENCODING:
            raise LogError(
                f"{self.path}: messages of {topic} are {known.encoding or 'nothing'}, defined in "
                f"{known.schema_encoding or 'nothing'}; only cdr with ros2msg is read"
            )
        try:
            return ColumnReader(known.type)
        except ValueError as error:
            raise LogError(f"{self.path}: messages of {topic} cannot be read: {error}") from error

    def _file_of_all(self) -> McapFile:
        """Return what is in the file, channels and damage beside the messages included."""
        if not self._searched:
            self._searched = True
            walk = LogWalk(self.path)
            for _ in walk.messages():
                pass
            self._file = walk.file
        return self._file


def open_log(path: str | Path) -> LogReader:
    """Open an MCAP file. Raises LogError with one sentence when it is none, is missing or empty, or a log of
    dxlrun that this version cannot read."""
    return LogReader(Path(path))


def read_log(path: str | Path) -> Log:
    """Read a log of dxlrun at once. Raises LogError with one sentence when the file is none, or cannot be."""
    reader = LogReader(Path(path))
    slices = list(reader.slices())
    return joined(reader.about, slices)


class LogFollower:
    """A log that is being written: what came since the last look. Packets are left out.

    Raises LogError as read_log, at each look.
    """

    def __init__(self, path: str | Path) -> None:
        self._path = Path(path)
        self._walk = LogWalk(self._path)
        self._slicer: Slicer | None = None

    def new(self) -> Log:
        """Return what the file has in addition, as a log of its own."""
        self._walk.file.damage.clear()
        with _readable(self._path):
            slices = [self._made().take(messages) for messages in self._walk.messages()]
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
        raise LogError(f"{path}: a log that this version of dxlrun cannot read: {error}") from error


def _header(path: Path, file: McapFile) -> LogHeader | None:
    """Return the header of a log of dxlrun; where its metadata are damaged, that of the attachment."""
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
    return f"{path}: an MCAP file, but not written by dxlrun: it has no metadata '{schemas.METADATA_NAME}'"
