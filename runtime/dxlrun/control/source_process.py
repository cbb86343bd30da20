"""Source processes: what a feature samples beside the loop, and the readers of its samples in the loop.

Each process writes its newest sample into a slot of shared memory, and a reader copies it into the record.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, Protocol

import msgspec

from dxlrun.channels.cycle import CycleRecord
from dxlrun.channels.events import EventSink
from dxlrun.channels.slot import SlotWriter
from dxlrun.control.controllers.plugins import PlugIns
from dxlrun.features import stages
from dxlrun.features.feature import Feature
from dxlrun.plan.loop_plan import LoopPlan
from dxlsim.motion.link_motion import Body

Slots = Mapping[str, Sequence[memoryview]]
"""Slots of the processes of each feature, by its name."""
_NUMBER = re.compile(r"\[Errno -?\d+\] ")


class SourceProcess(msgspec.Struct, frozen=True):
    """A process that samples one source."""

    source: str
    """Name of the source."""
    kind: str
    """Word for it in sentences: `sensor`."""
    values: int
    """States of a sample."""
    period_ns: int
    """Time between two samples."""
    plan: bytes
    """What the feature needs to open the source."""
    has_body: bool = False
    """It senses the simulated body."""

    @property
    def title(self) -> str:
        """The source as sentences name it: `sensor imu`."""
        return f"{self.kind} {self.source}"


class SampledSource(Protocol):
    """A source at work, which writes its samples into a slot. Only `open_first` raises what it raises."""

    reopen_ns: int
    """When it is opened again; of use only while it is not `open`."""

    @property
    def driver(self) -> object:
        """Object of a plug-in that samples."""

    @property
    def open(self) -> bool:
        """True while its device is open."""

    @property
    def waits(self) -> bool:
        """True if `sample` waits for the next sample of the device."""

    def open_first(self) -> None:
        """Open the device at the start of a run."""

    def sample(self) -> bool:
        """Take one sample, or open the device again when that is due; return whether there was a sample."""

    def fail(self, error: Exception) -> None:
        """Close the device for what was raised, and open it again after a while."""

    def close(self) -> None:
        """Close the device."""


@dataclass(frozen=True, slots=True)
class SourceContext:
    """What a source gets from the process that samples it."""

    plugins: PlugIns
    writer: SlotWriter
    now_ns: Callable[[], int]
    """The run's clock."""
    body: Body | None
    """The simulated body; None without `SourceProcess.has_body`."""


@dataclass(frozen=True)
class ProcessStage:
    """`STAGE` of `process.py`: processes of a feature beside the loop; in the loop's own on virtual time."""

    FILE: ClassVar[str] = "process"

    processes: Callable[[bytes], Sequence[SourceProcess]]
    """Returns the processes of `Contribution.plan`."""
    build: Callable[[bytes, SourceContext], SampledSource]
    """Builds the source of `SourceProcess.plan`, in its process. Raises PlugInError."""
    refuse_virtual_time: Callable[[bytes], str] = lambda plan: ""
    """Returns why a run with `Contribution.plan` cannot be on virtual time; empty if it can."""


@dataclass(frozen=True, slots=True)
class PlannedProcess:
    """A process of a run, with its place among those of its feature."""

    feature: Feature
    stage: ProcessStage
    index: int
    process: SourceProcess


def planned_processes(loop: LoopPlan) -> Iterator[PlannedProcess]:
    """Yield the processes of all features of a robot, in their order."""
    for feature, stage in stages(ProcessStage, loop.features):
        for index, process in enumerate(stage.processes(loop.feature_plans.get(feature.name, b""))):
            yield PlannedProcess(feature, stage, index, process)


class SourceReader(Protocol):
    """Copies newest samples into the record."""

    def read(self) -> None:
        """Fill the rows of its sources. Called in each cycle after the servos were read; never waits."""


@dataclass(frozen=True, slots=True)
class ReaderContext:
    """What a reader gets in the loop's process."""

    plan: bytes
    """`Contribution.plan` of the feature."""
    slots: Sequence[memoryview]
    """Slots of its processes, in their order."""
    record: CycleRecord
    now_ns: Callable[[], int]
    """The clock by which the slots have times."""
    events: EventSink


@dataclass(frozen=True)
class ReaderStage:
    """`STAGE` of `reader.py`: the loop's end of the processes of a feature. A replay has no readers."""

    FILE: ClassVar[str] = "reader"

    build: Callable[[ReaderContext], SourceReader]


def build_readers(
    loop: LoopPlan, slots: Slots, record: CycleRecord, now_ns: Callable[[], int], events: EventSink
) -> tuple[SourceReader, ...]:
    """Return the readers of the features that have processes."""
    readers: list[SourceReader] = []
    for feature, stage in stages(ReaderStage, loop.features):
        if own := slots.get(feature.name):
            plan = loop.feature_plans.get(feature.name, b"")
            readers.append(stage.build(ReaderContext(plan, own, record, now_ns, events)))
    return tuple(readers)


def describe_error(error: BaseException) -> str:
    """Return an error in one line."""
    text = _NUMBER.sub("", " ".join(str(error).split()))
    return text if isinstance(error, OSError) and text else f"{type(error).__name__}: {text}"
