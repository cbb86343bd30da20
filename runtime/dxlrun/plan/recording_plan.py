"""Recording: what of a run is kept, in how many files, and what each of these says about itself."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import msgspec

MOST_HELD = 256 << 20
"""Bytes of records that a recorder holds back while it waits for a fault; more are left out sooner."""
HELD_RECORD = 160
"""Bytes that a record takes in memory beside its own."""
PART_NAME, PART_END_NAME = "part", "part_end"
"""Metadata records of a part: the first is written at its begin, the second at its end."""
RECOVERED_NAME = "recovered"
"""Metadata record of a file that `dxlrun recover` made: what is lost."""
PART_PATTERN = "part_[0-9][0-9][0-9][0-9]*.mcap"

Began = Literal["start", "size", "time", "fault"]
"""Why a part begins: it is the first one, the one before was full or old, a fault was reported."""


class RecordingPlan(msgspec.Struct, frozen=True):
    """What the robot file says about the log."""

    directory: str = "logs"
    split_bytes: int | None = None
    """A part that is so long ends."""
    split_ns: int | None = None
    """A part that is so old ends."""
    trigger: Literal["fault"] | None = None
    """Cycles, packets and topics are only kept around what it names; None: always."""
    before_ns: int = 0
    """So much before a fault is kept ..."""
    after_ns: int = 0
    """... and so much after it."""

    @property
    def in_parts(self) -> bool:
        """The log is a directory of parts."""
        return self.trigger is not None or self.split_bytes is not None or self.split_ns is not None


class LeftOut(msgspec.Struct, frozen=True):
    """What a trigger left out on purpose in one piece of a run."""

    cycles: int = 0
    first: int = 0
    """Number of the first of these cycles."""
    last: int = 0
    batches: int = 0
    """Batches of packets: one a cycle, as a rule."""
    messages: int = 0
    """Of topics."""

    def to_metadata(self) -> dict[str, str]:
        """Return it as keys of a part's records."""
        return {
            "left_out_cycles": str(self.cycles),
            "left_out_first": str(self.first),
            "left_out_last": str(self.last),
            "left_out_batches": str(self.batches),
            "left_out_messages": str(self.messages),
        }

    @classmethod
    def from_metadata(cls, text: dict[str, str]) -> LeftOut:
        """Return what `to_metadata` wrote. Raises ValueError when it is wrong."""
        return cls(
            *(
                int(text.get(f"left_out_{name}", "0"))
                for name in ("cycles", "first", "last", "batches", "messages")
            )
        )


class PartBegin(msgspec.Struct, frozen=True):
    """What a part says about itself at its begin."""

    index: int
    """From 0"""
    began: Began
    fault: str = ""
    """The sentence of the event that triggered it."""
    before_ns: int = 0
    """How long before that the part reaches back."""
    left_out: LeftOut = LeftOut()
    """Between it and the part before."""

    def to_metadata(self) -> dict[str, str]:
        """Return the record `part`."""
        return {
            "index": str(self.index),
            "began": self.began,
            "fault": self.fault,
            "before_ns": str(self.before_ns),
            **self.left_out.to_metadata(),
        }


class PartEnd(msgspec.Struct, frozen=True):
    """What a part says about itself at its end; one that was cut off has none."""

    last: bool
    """The run ends with it."""
    faults: int = 0
    """Of the whole run up to here."""
    left_out: LeftOut = LeftOut()
    """Between it and the end of the run."""

    def to_metadata(self) -> dict[str, str]:
        """Return the record `part_end`."""
        return {
            "last": "yes" if self.last else "no",
            "faults": str(self.faults),
            **self.left_out.to_metadata(),
        }


def part_name(index: int) -> str:
    """Return the file name of a part."""
    return f"part_{index:04d}.mcap"


def recovered_sentences(record: Mapping[str, str]) -> list[str]:
    """Return what the record of a recovered file says is lost."""
    source = f"recovered from {record.get('from', 'another file')}"
    lost = record.get("lost_messages", "0")
    sentences = [] if lost == "0" else [f"{source}: {lost} messages are lost"]
    return [*sentences, *(f"{source}: {text}" for key, text in record.items() if key.startswith("lost "))]
