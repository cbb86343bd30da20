"""A bag directory of ROS 2: the log's MCAP files as they are, and the metadata.yaml that rosbag2 expects.

Source: rosbag2_storage's BagMetadata, version 8 (yaml.hpp of ROS 2 Jazzy): files with their times, topics
with type, type hash, quality of service and number of messages.
"""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import IO

import msgspec
import yaml
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.records import Channel
from mcap.summary import Summary

from dxlrun.errors import LogError
from dxlrun.log import schemas

VERSION = 8  # Of the metadata: the last one with the quality of service as text, which readers of 9 take too
_ROS_DISTRO = "jazzy"


class _Part(msgspec.Struct, frozen=True):
    """One MCAP file of a bag: how many messages of each channel it has, and when they were logged, ns."""

    path: Path
    channels: dict[int, Channel]
    types: dict[int, str]
    counts: dict[int, int]
    first_ns: int
    last_ns: int

    @property
    def count(self) -> int:
        return sum(self.counts.values())

    @property
    def file(self) -> dict[str, object]:
        return {
            "path": self.path.name,
            "starting_time": {"nanoseconds_since_epoch": self.first_ns},
            "duration": {"nanoseconds": self.last_ns - self.first_ns},
            "message_count": self.count,
        }


def write_bag(parts: Sequence[Path], directory: Path) -> int:
    """Copy the files of a log into a bag directory that is made; return how many messages it has.

    Raises LogError where a file has no end: rosbag2 reads by the index there. OSError.
    """
    found = [_part(path) for path in parts]
    directory.mkdir()
    for part in found:
        shutil.copyfile(part.path, directory / part.path.name)
    text = yaml.safe_dump({"rosbag2_bagfile_information": _information(found)}, sort_keys=False)
    (directory / "metadata.yaml").write_text(text, encoding="utf-8")
    return sum(part.count for part in found)


def _part(path: Path) -> _Part:
    with path.open("rb") as stream:
        summary = _summary(path, stream)
    statistics = summary.statistics
    if statistics is None:
        raise _without_end(path)
    types = {identifier: schema.name for identifier, schema in summary.schemas.items()}
    return _Part(
        path,
        summary.channels,
        types,
        statistics.channel_message_counts,
        statistics.message_start_time,
        statistics.message_end_time,
    )


def _summary(path: Path, stream: IO[bytes]) -> Summary:
    try:
        summary = make_reader(stream).get_summary()
    except (McapError, EOFError, ValueError) as error:
        raise _without_end(path) from error
    if summary is None:
        raise _without_end(path)
    return summary


def _without_end(path: Path) -> LogError:
    return LogError(
        f"{path}: it has no end, and readers of bags need the index there; `mcap recover {path}` of the MCAP "
        "tools makes a whole log of it"
    )


def _information(parts: Sequence[_Part]) -> dict[str, object]:
    timed = [part for part in parts if part.count]
    first_ns = min((part.first_ns for part in timed), default=0)
    last_ns = max((part.last_ns for part in timed), default=0)
    return {
        "version": VERSION,
        "storage_identifier": "mcap",
        "duration": {"nanoseconds": last_ns - first_ns},
        "starting_time": {"nanoseconds_since_epoch": first_ns},
        "message_count": sum(part.count for part in parts),
        "topics_with_message_count": _topics(parts),
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": [part.path.name for part in parts],
        "files": [part.file for part in parts],
        "custom_data": {},
        "ros_distro": _ROS_DISTRO,
    }


def _topics(parts: Sequence[_Part]) -> list[dict[str, object]]:
    counts: Counter[tuple[str, str, str, str]] = Counter()
    for part in parts:
        for identifier, channel in part.channels.items():
            quality = channel.metadata.get("offered_qos_profiles", "")
            type_hash = channel.metadata.get("topic_type_hash", "")
            if channel.schema_id not in part.types:
                raise LogError(
                    f"{part.path}: its topic {channel.topic!r} has no type, and a bag needs one; csv and "
                    "parquet take what dxlrun knows of the log"
                )
            key = (channel.topic, part.types[channel.schema_id], type_hash, quality)
            counts[key] += part.counts.get(identifier, 0)
    return [
        {
            "topic_metadata": {
                "name": topic,
                "type": kind,
                "serialization_format": schemas.ENCODING,
                "offered_qos_profiles": quality,
                "type_description_hash": type_hash,
            },
            "message_count": count,
        }
        for (topic, kind, type_hash, quality), count in counts.items()
    ]
