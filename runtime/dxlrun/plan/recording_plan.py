"""Recording: where a run's log is written, in how many files, and which of these are kept."""

from __future__ import annotations

import msgspec

PART_NAME, PART_END_NAME = "part", "part_end"
"""Metadata records of a part: the first is written at its begin, the second at its end."""
PART_PATTERN = "part_[0-9][0-9][0-9][0-9]*.mcap"


class RecordingPlan(msgspec.Struct, frozen=True):
    """What the robot file says about the log."""

    directory: str = "logs"
    split_bytes: int | None = None  # A part that is so long ends
    split_ns: int | None = None  # A part that is so old ends
    keep_ns: int | None = None
    """A part whose newest record is older than this is deleted; None: every part is kept."""
    keep_bytes: int | None = None
    """At the end of a run the oldest logs of the directory beyond this are deleted; None: all are kept."""

    @property
    def in_parts(self) -> bool:
        """The log is a directory of parts."""
        return self.split_bytes is not None or self.split_ns is not None


def part_name(index: int) -> str:
    """Return the file name of a part."""
    return f"part_{index:04d}.mcap"
