"""Recording plan: directory of the log, its split into files, and their deletion."""

from __future__ import annotations

import msgspec

PART_NAME, PART_END_NAME = "part", "part_end"
"""Metadata records at the begin and at the end of each part."""
PART_PATTERN = "part_[0-9][0-9][0-9][0-9]*.mcap"


class RecordingPlan(msgspec.Struct, frozen=True):
    """Settings of logs from the section `recording` of the robot file."""

    directory: str = "logs"
    split_bytes: int | None = None  # Size at which a new part begins
    split_ns: int | None = None  # Duration after which a new part begins
    keep_ns: int | None = None
    """Age of its newest record after which a part is deleted; None: never."""
    keep_bytes: int | None = None
    """Size limit of the directory; the oldest logs are deleted at the end of a run. None: unlimited."""

    @property
    def in_parts(self) -> bool:
        """True if the log is a directory of parts."""
        return self.split_bytes is not None or self.split_ns is not None


def part_name(index: int) -> str:
    """Return the file name of a log's part with this index."""
    return f"part_{index:04d}.mcap"
