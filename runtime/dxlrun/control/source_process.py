"""Source processes: processes that sample the sources of features, and their readers in the loop.

Each process writes its newest sample into a slot of shared memory. A reader copies it into the record.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import ClassVar, Protocol

import msgspec
import numpy as np

from dxlrun.channels.cycle import CycleRecord
from dxlrun.channels.events import EventSink
from dxlrun.channels.slot import Floats, SlotState, SlotWriter
from dxlrun.control.controllers.plugins import PlugIns
from dxlrun.features import stages
from dxlrun.features.feature import Feature
from dxlrun.plan.loop_plan import LoopPlan
from dxlsim.motion.link_motion import Body

Slots = Mapping[str, Sequence[memoryview]]
"""Slots of the processes of each feature, by name of the feature."""
REOPEN_NS = 1_000_000_000
"""Pause before a failed source is opened again."""
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


class SourceContext(msgspec.Struct, frozen=True):
    """Objects that a source gets from its process."""

    plugins: PlugIns
    writer: SlotWriter
    now_ns: Callable[[], int]
    """The run's clock."""
    body: Body | None
    """The simulated body; None without `SourceProcess.has_body`."""


class Driver(Protocol):
    """Driver of a source's device, such as the class of a plug-in. Its methods may raise anything."""

    @property
    def waits(self) -> bool:
        """True if `read` waits for the next sample of the device."""

    def read(self, values: Floats) -> int | None:
        """Read a sample into values that are NaN; return its time on the run's clock, None without one."""

    def close(self) -> None:
        """Close the device, also after an incomplete opening."""


class SampledSource:
    """A source that writes its samples into a slot. Only `open_first` raises exceptions of the driver.

    Args:
        driver: Driver of its device.
        open_driver: Opens the driver; the argument logs a sentence.
        period_ns: Time between two samples.
        context: Objects of its process.
    """

    def __init__(
        self,
        driver: Driver,
        open_driver: Callable[[Callable[[str], None]], None],
        period_ns: int,
        context: SourceContext,
    ) -> None:
        self.driver = driver
        self.open = False
        """True while the device is open."""
        self.reopen_ns = 0
        """Time of the next attempt to open the device; meaningful only while it is not `open`."""
        self._open_driver = open_driver
        self._period_ns = period_ns
        self._writer = context.writer
        self._now_ns = context.now_ns
        self._values: Floats = np.full(context.writer.values, np.nan)
        self._ahead = False

    def open_first(self) -> None:
        """Open the device at the start of a run; raise whatever the driver raises."""
        try:
            self._open_driver(self._say)
        except BaseException:
            self.close()
            raise
        self.open = True
        self._writer.say(SlotState.OPEN, "")

    def sample(self) -> bool:
        """Sample once, or reopen the device if that is due; return True if there was a sample."""
        if not self.open and not self._reopen():
            return False
        # A value that the driver does not set must be invalid, not old.
        self._values.fill(np.nan)
        try:
            t_ns = self.driver.read(self._values)
            if t_ns is None:
                return False
            now_ns = self._now_ns()
            ahead_ns = int(t_ns) - now_ns
            if ahead_ns > self._period_ns and not self._ahead:
                self._ahead = True
                self._say(f"its times are {ahead_ns / 1e6:.0f} ms in the future: times of arrival are used")
            # A time in the future would make the sample younger than it is.
            self._writer.write(min(int(t_ns), now_ns), self._values)
        except Exception as error:  # every error of a driver becomes an event
            self.fail(error)
            return False
        return True

    def close(self) -> None:
        """Close the device and report any exception."""
        self.open = False
        try:
            self.driver.close()
        except Exception as error:  # as above
            self._writer.say(SlotState.FAILED, f"cannot be closed: {describe_error(error)}")

    def fail(self, error: Exception) -> None:
        """Close the device after an exception, and schedule its reopening."""
        self.close()
        self.reopen_ns = self._now_ns() + REOPEN_NS
        self._writer.say(SlotState.FAILED, describe_error(error))

    def _reopen(self) -> bool:
        if self._now_ns() < self.reopen_ns:
            return False
        try:
            self._open_driver(self._say)
        except Exception as error:  # as above
            self.fail(error)
            return False
        self.open = True
        self._writer.say(SlotState.OPEN, "is open again")
        return True

    def _say(self, text: str) -> None:
        self._writer.say(SlotState.OPEN if self.open else SlotState.STARTING, text)


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
