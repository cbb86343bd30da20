"""Reader of foreign recordings: JointState and JointTrajectory messages in MCAP files and ROS 2 bags.

A bag is a directory with metadata.yaml and files of one of rosbag2's two storages, MCAP or sqlite3. Messages
are CDR. The time of a JointState is that of its header, or the recording time if the header has 0. A
JointTrajectory begins at its header's time (if 0, the recording time) and replaces the remainder of the
preceding one, as in joint_trajectory_controller of ros2_controllers (control.ros.org).
"""

from __future__ import annotations

import sqlite3
from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import ClassVar, NamedTuple, cast

import msgspec
import numpy as np
import yaml

from dxlrun import InputError, LogError, open_log
from dxlrun.tooling.logs import LogWalk
from dxlrun.tooling.topics import ENCAPSULATION, Codec, declared_message, messages
from dxlrun_analysis.playback.recorded_motion import Floats, Series, What


class JointTrajectory(msgspec.Struct):
    """Fields of the ROS 2 message trajectory_msgs/msg/JointTrajectory."""

    ros_type: ClassVar[str] = "trajectory_msgs/msg/JointTrajectory"
    header: messages.Header
    joint_names: tuple[str, ...]
    points: tuple[messages.JointTrajectoryPoint, ...]


JOINT_STATE = declared_message(messages.JointState, "").type
JOINT_TRAJECTORY = declared_message(JointTrajectory, "").type
_TYPES: Mapping[str, tuple[What, Codec]] = {
    JOINT_STATE.name: ("states", Codec(JOINT_STATE)),
    JOINT_TRAJECTORY.name: ("goals", Codec(JOINT_TRAJECTORY)),
}
BAG_FILE = "metadata.yaml"
_MCAP, _SQLITE = b"\x89MCAP0\r\n", b"SQLite format 3\0"
_JUST_BEFORE_S = 1e-6  # Keeps times ascending where a trajectory replaces another
_CDR = b"\x00\x01"  # CDR, little-endian; the next two bytes are the number of padding bytes at the end


class _PositionMessage(NamedTuple):
    """JointState or JointTrajectory message, still as bytes."""

    topic: str
    type: str
    t_ns: int  # Recording time
    data: bytes


class _Recording(msgspec.Struct, frozen=True):
    """Content of a foreign recording: messages with joint positions, and all topics."""

    path: Path
    messages: list[_PositionMessage]
    topics: dict[str, str]  # All topics, with their types
    remarks: list[str]  # One sentence for each problem of reading


class _Moments(NamedTuple):
    """Positions and times from one message: a single one of a JointState, all of a JointTrajectory."""

    topic: str
    what: What
    start_ns: int
    joints: tuple[str, ...]
    after_s: Floats  # Time since the start, shape (moments,)
    position: Floats  # rad, shape (moments, joints)


def is_foreign(path: Path) -> bool:
    """Return whether a recording is a ROS 2 bag, or a file that dxlrun did not write.

    Raises:
        LogError: The file is neither MCAP nor sqlite3.
    """
    if path.is_dir():
        return (path / BAG_FILE).is_file()
    try:
        with path.open("rb") as stream:
            if stream.read(len(_SQLITE)) == _SQLITE:
                return True
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror or error}") from error
    return open_log(path).header is None


def foreign_series(
    path: Path, what: What | None, topic: str | None
) -> tuple[dict[str, Series], tuple[str, ...]]:
    """Return each joint's positions in a foreign recording, and a sentence for each problem of reading.

    Args:
        path: The recording.
        what: Goals or states; None: states if it has any.
        topic: Topic to read; None: all.

    Raises:
        InputError: The recording has no joints, or a joint is in several topics and none was chosen.
    """
    recording = _Recording(path, [], {}, [])
    for file in _files(path):
        _read(file, recording)
    playable = {name: _TYPES[kind][0] for name, kind in recording.topics.items() if kind in _TYPES}
    chosen = {name for name, kind in playable.items() if topic in (None, name) and what in (None, kind)}
    if what is None and "states" in {playable[name] for name in chosen}:
        chosen = {name for name in chosen if playable[name] == "states"}
    messages = [message for message in recording.messages if message.topic in chosen]
    if not messages:
        raise InputError(_nothing(recording, sorted(playable), what, topic))
    try:
        moments = [_moments(message) for message in messages]
    except (ValueError, OverflowError) as error:
        raise InputError(f"{path}: a message cannot be read: {error}") from error
    return _series(path, moments), tuple(recording.remarks)


def _nothing(recording: _Recording, playable: Sequence[str], what: What | None, topic: str | None) -> str:
    asked = f" on {topic}" if topic is not None else ""
    asked += f" with --what {what}" if what is not None else ""
    names = playable if playable and asked else sorted(recording.topics)
    shown = ", ".join(f"{name} ({recording.topics[name]})" for name in names[:10])
    more = f" and {len(names) - 10} more" if len(names) > 10 else ""
    damage = "".join(f"; {remark}" for remark in recording.remarks)
    return (
        f"{recording.path}: no motion: no sensor_msgs/JointState or trajectory_msgs/JointTrajectory "
        f"message in CDR{asked}; its topics are {shown or 'none'}{more}{damage}"
    )


# Messages


def _moments(message: _PositionMessage) -> _Moments:
    what, codec = _TYPES[message.type]
    if message.data[: len(_CDR)] != _CDR:
        raise ValueError(f"the bytes of {message.topic} are not little-endian CDR")
    values = codec.unpack(ENCAPSULATION + message.data[len(ENCAPSULATION) :])
    start_ns = _time_ns(cast("Mapping[str, object]", values["header"])["stamp"]) or message.t_ns
    names = cast("Sequence[str]", values["name" if what == "states" else "joint_names"])
    if what == "states":
        rows = [cast("Floats", values["position"])] if len(cast("Floats", values["position"])) else []
        after_s = np.zeros(len(rows))
    else:
        points = cast("Sequence[Mapping[str, object]]", values["points"])
        rows = [cast("Floats", point["positions"]) for point in points]
        after_s = np.array([_time_ns(point["time_from_start"]) * 1e-9 for point in points])
    if any(len(row) != len(names) for row in rows):
        raise ValueError(f"{message.topic} has a message with unequal numbers of joints and positions")
    positions = np.array(rows, dtype=np.float64).reshape(len(rows), len(names))
    return _Moments(message.topic, what, start_ns, tuple(map(str, names)), after_s, positions)


def _time_ns(stamp: object) -> int:
    values = cast("Mapping[str, int]", stamp)
    return int(values["sec"]) * 1_000_000_000 + int(values["nanosec"])


def _series(path: Path, moments: Sequence[_Moments]) -> dict[str, Series]:
    topics: dict[str, set[str]] = {}
    for one in moments:
        for joint in one.joints:
            topics.setdefault(joint, set()).add(one.topic)
    twice = sorted(joint for joint, names in topics.items() if len(names) > 1)
    if twice:
        shown = ", ".join(sorted(topics[twice[0]]))
        raise InputError(f"{path}: {twice[0]} is in several topics ({shown}); choose a topic by --topic")
    began_ns = min(one.start_ns for one in moments)
    times: dict[str, list[Floats]] = {joint: [] for joint in topics}
    positions: dict[str, list[Floats]] = {joint: [] for joint in topics}
    for one in sorted(moments, key=lambda each: each.start_ns):
        start_s = (one.start_ns - began_ns) * 1e-9
        for column, joint in enumerate(one.joints):
            if one.what == "goals":
                _end_before(times[joint], positions[joint], start_s)
            times[joint].append(start_s + one.after_s)
            positions[joint].append(one.position[:, column])
    what = {joint: one.what for one in moments for joint in one.joints}
    return {
        joint: Series(
            np.concatenate(times[joint]),
            np.concatenate(positions[joint]),
            what[joint],
            what[joint] == "goals",
        )
        for joint in topics
    }


def _end_before(times: list[Floats], positions: list[Floats], start_s: float) -> None:
    """Truncate a joint's trajectory at the start of the next one, and add the position reached by then."""
    if not times:
        return
    time, position = np.concatenate(times), np.concatenate(positions)
    if not len(time):
        return
    kept = time < start_s - _JUST_BEFORE_S
    held = np.interp(start_s, time, position)
    times[:] = [np.append(time[kept], start_s - _JUST_BEFORE_S)]
    positions[:] = [np.append(position[kept], held)]


# Files


def _files(path: Path) -> list[Path]:
    """Return the files with messages of a recording, in order of time.

    Raises:
        InputError: The directory is not a ROS 2 bag.
    """
    if path.is_file():
        return [path]
    try:
        content = yaml.safe_load((path / BAG_FILE).read_text(encoding="utf-8"))
        names = [str(name) for name in content["rosbag2_bagfile_information"]["relative_file_paths"]]
    except (OSError, UnicodeDecodeError, yaml.YAMLError, LookupError, TypeError) as error:
        raise InputError(f"{path}: not a ROS 2 bag: {BAG_FILE} is invalid: {_said(error)}") from error
    # The files are next to metadata.yaml, whatever path it contains.
    files = [path / Path(name).name for name in names]
    missing = [file.name for file in files if not file.is_file()]
    if missing or not files:
        raise InputError(f"{path}: the bag lacks {', '.join(missing) or 'its files'}")
    return files


def _read(file: Path, recording: _Recording) -> None:
    """Add the messages of one MCAP or sqlite3 file to a recording.

    Raises:
        InputError: The file has an unknown format.
    """
    try:
        with file.open("rb") as stream:
            head = stream.read(len(_SQLITE))
            if head == _SQLITE:
                _read_sqlite(file, recording)
            elif head.startswith(_MCAP):
                _read_mcap(file, recording)
            elif head[: len(_ZSTD)] == _ZSTD:
                raise InputError(
                    f"{file}: the whole file is compressed; expand it with `zstd -d {file.name}`"
                )
            else:
                raise InputError(
                    f"{file}: neither MCAP nor sqlite3; play a recording in one of these formats"
                )
    except OSError as error:
        raise InputError(f"{file}: cannot be read: {error.strerror or error}") from error


_ZSTD = b"\x28\xb5\x2f\xfd"


def _read_sqlite(file: Path, recording: _Recording) -> None:
    """Add the messages of one file of rosbag2's sqlite3 storage (its schema) to a recording."""
    try:
        with closing(
            sqlite3.connect(f"{file.absolute().as_uri()}?mode=ro&immutable=1", uri=True)
        ) as database:
            topics = list(database.execute("SELECT id, name, type, serialization_format FROM topics"))
            for _, name, kind, _ in topics:
                recording.topics[str(name)] = str(kind)
            for number, name, kind, form in topics:
                if kind in _TYPES and form == "cdr":
                    query = "SELECT timestamp, data FROM messages WHERE topic_id = ? ORDER BY timestamp"
                    rows = database.execute(query, (number,))
                    recording.messages.extend(
                        _PositionMessage(str(name), str(kind), int(t), bytes(data)) for t, data in rows
                    )
    except (sqlite3.Error, ValueError, TypeError) as error:
        recording.remarks.append(f"{file.name} cannot be read to its end: {error}")


def _read_mcap(file: Path, recording: _Recording) -> None:
    walk = LogWalk(file)
    for batch in walk.messages():
        for number, channel in walk.file.channels.items():
            if channel.type_name in _TYPES and channel.encoding == "cdr":
                rows = np.flatnonzero(batch.channel == number)
                bodies = zip(batch.t_ns[rows].tolist(), batch.bodies(rows), strict=True)
                kind = channel.type_name
                recording.messages.extend(
                    _PositionMessage(channel.topic, kind, t_ns, data) for t_ns, data in bodies
                )
    recording.topics.update({one.topic: one.type_name for one in walk.file.channels.values()})
    recording.remarks.extend(walk.file.damage)
    if not walk.file.finished:
        recording.remarks.append(walk.no_end)


def _said(error: Exception) -> str:
    return str(error) or type(error).__name__
