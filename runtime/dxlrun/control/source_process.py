"""Source processes: processes that sample the sources of features, and their readers in the loop.

Each process writes its newest sample into a slot of shared memory. A reader copies it into the record.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
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
"""Slots of the processes of each feature, by name of the feature."""
_NUMBER = re.compile(r"\[Errno -?\d+\] ")


class SourceProcess(msgspec.Struct, frozen=True):
    """A process that samples one source."""

    source: str
    """Name of the source."""
    kind: str
    """Noun for messages: `sensor`."""
    values: int
    """Number of states in a sample."""
    period_ns: int
    """Time between two samples."""
    plan: bytes
    """Data with which the feature opens the source."""
    has_body: bool = False
    """True if it senses the simulated body."""

    @property
    def title(self) -> str:
        """Name of the source in messages: `sensor imu`."""
        return f"{self.kind} {self.source}"


class SampledSource(Protocol):
    """A running source, which writes its samples into a slot.

    Only `open_first` may raise exceptions of the driver.
    """

    reopen_ns: int
    """Time of the next attempt to open the device. Valid only while it is not `open`."""

    @property
    def driver(self) -> object:
        """Driver object of a plug-in."""

    @property
    def open(self) -> bool:
        """True while the device is open."""

    @property
    def waits(self) -> bool:
        """True if `sample` waits for the next sample of the device."""

    def open_first(self) -> None:
        """Open the device at the start of a run."""

    def sample(self) -> bool:
        """Sample once, or reopen the device when that is due; return whether there was a sample."""

    def fail(self, error: Exception) -> None:
        """Close the device after an error, and schedule an attempt to reopen it."""

    def close(self) -> None:
        """Close the device."""


class SourceContext(msgspec.Struct, frozen=True):
    """Objects that a source gets from its process."""

    plugins: PlugIns
    writer: SlotWriter
    now_ns: Callable[[], int]
    """The run's clock."""
    body: Body | None
    """The simulated body; None without `SourceProcess.has_body`."""


class ProcessStage(msgspec.Struct, frozen=True):
    """`STAGE` of `process.py`: processes of a feature. On virtual time, they run in the loop's process."""

    FILE: ClassVar[str] = "process"

    processes: Callable[[bytes], Sequence[SourceProcess]]
    """Returns the processes for `Contribution.plan`."""
    build: Callable[[bytes, SourceContext], SampledSource]
    """Builds the source for `SourceProcess.plan`, in its process. Raises PlugInError."""
    refuse_virtual_time: Callable[[bytes], str] = lambda plan: ""
    """Returns the reason why a run with `Contribution.plan` cannot use virtual time; empty if it can."""


class PlannedProcess(msgspec.Struct, frozen=True):
    """A process of a run, with its index among the processes of its feature."""

    feature: Feature
    stage: ProcessStage
    index: int
    process: SourceProcess


def planned_processes(loop: LoopPlan) -> Iterator[PlannedProcess]:
    """Yield the processes of all features of a robot, in order of features and processes."""
    for feature, stage in stages(ProcessStage, loop.features):
        for index, process in enumerate(stage.processes(loop.feature_plans.get(feature.name, b""))):
            yield PlannedProcess(feature, stage, index, process)


class SourceReader(Protocol):
    """Copies the newest samples into the record."""

    def read(self) -> None:
        """Update the rows of its sources. Called in each cycle after the servos were read. Never waits."""


class ReaderContext(msgspec.Struct, frozen=True):
    """Objects that a reader gets in the loop's process."""

    plan: bytes
    """`Contribution.plan` of the feature."""
    slots: Sequence[memoryview]
    """Slots of its processes, in the order of the processes."""
    record: CycleRecord
    now_ns: Callable[[], int]
    """Clock of the times in the slots."""
    events: EventSink


class ReaderStage(msgspec.Struct, frozen=True):
    """`STAGE` of `reader.py`: reads the samples of a feature in the loop. A replay has no readers."""

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
    """Return an error as one line of text."""
    text = _NUMBER.sub("", " ".join(str(error).split()))
    return text if isinstance(error, OSError) and text else f"{type(error).__name__}: {text}"
