"""What a log says about itself: who moved, in which order the rows are, where wall time lies."""

from __future__ import annotations

from dataclasses import dataclass, field

import msgspec

from dxlrun.log.schemas import FORMAT


@dataclass(frozen=True, slots=True)
class LoggedController:
    """One controller of the run; its index is its bit in the masks of a cycle."""

    name: str
    joints: tuple[str, ...]
    publishes: tuple[str, ...]
    """Topics that it writes in the cycles it marks."""


@dataclass(frozen=True, slots=True)
class LogHeader:
    """Everything that is known before the first record; JSON on its way to the recorder."""

    robot: str
    joints: tuple[str, ...]
    buses: tuple[str, ...]
    controllers: tuple[LoggedController, ...]
    period_ns: int
    epoch_offset_ns: int
    """Wall time (ns since 1970) = time of the run's clock + this."""
    attachments: dict[str, bytes] = field(default_factory=dict)
    """Robot file, plan: by name."""
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    """Versions, kernel, scheduler: records of text by name."""
    robot_description: str | None = None
    """The robot's URDF."""


@dataclass(frozen=True, slots=True)
class RecorderJob:
    """What a recorder works on, as JSON through a descriptor."""

    path: str
    header: LogHeader
    rings: dict[str, int]
    """Descriptors of the rings that it reads, by their names."""


@dataclass(frozen=True, slots=True)
class LogSummary:
    """What was written, and what was not."""

    messages: int
    bytes: int
    """Size of the file."""
    gaps: int
    """Records that the recorder did not get from the rings."""
    error: str | None = None
    """Why the log is not whole: a full disk, a file that was deleted."""
    unwritten: int = 0
    """Messages that were lost with the unfinished chunk when writing stopped, and records that came later."""


def to_metadata(header: LogHeader) -> dict[str, str]:
    """Return the header, without attachments and metadata, as the text that the log's metadata carries."""
    return {
        "format": FORMAT,
        "robot": header.robot,
        "joints": msgspec.json.encode(header.joints).decode(),
        "buses": msgspec.json.encode(header.buses).decode(),
        "controllers": msgspec.json.encode(header.controllers).decode(),
        "period_ns": str(header.period_ns),
        "epoch_offset_ns": str(header.epoch_offset_ns),
    }


def from_metadata(text: dict[str, str]) -> LogHeader:
    """Return the header that `to_metadata` wrote. Raises ValueError when something is missing or wrong."""
    if text.get("format") != FORMAT:
        raise ValueError(
            f"it has format {text.get('format', 'none')}, this version reads format {FORMAT}; "
            "read it with the dxlrun that made it"
        )
    try:
        return LogHeader(
            robot=text["robot"],
            joints=msgspec.json.decode(text["joints"], type=tuple[str, ...]),
            buses=msgspec.json.decode(text["buses"], type=tuple[str, ...]),
            controllers=msgspec.json.decode(text["controllers"], type=tuple[LoggedController, ...]),
            period_ns=int(text["period_ns"]),
            epoch_offset_ns=int(text["epoch_offset_ns"]),
        )
    except (KeyError, ValueError, msgspec.MsgspecError) as error:
        raise ValueError(f"the metadata {error} is missing or wrong") from error
