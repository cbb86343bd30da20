"""Source processes: processes that sample the sources of features, and their readers in the loop.

A source is a sensor or device. Its process writes the newest sample into a slot of shared memory. A reader
copies it into the record.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import ClassVar, Protocol

import msgspec
import numpy as np

from dxlrun.channels.cycle import CycleRecord
from dxlrun.channels.event_records import EventSink
from dxlrun.channels.slot import Floats, SlotState, SlotWriter
from dxlrun.control.controllers.plugin_loading import PlugIns
from dxlrun.features import stages
from dxlrun.features.feature import Feature
from dxlrun.plan.loop_plan import LoopPlan
from dxlsim.motion.link_motion import Body

Slots = Mapping[str, Sequence[memoryview]]
"""Shared-memory slots of source processes, one for each process, by name of the feature."""
REOPEN_NS = 1_000_000_000
"""Pause after a failure before the source's device is opened again."""
_NUMBER = re.compile(r"\[Errno -?\d+\] ")


class SourceProcess(msgspec.Struct, frozen=True):
    """Description of a process that samples one source, such as a sensor."""

    source: str
    """Name of the source in the robot file."""
    kind: str
    """Noun for messages: `sensor`."""
    values: int
    """Number of states in a sample."""
    period_ns: int
    """Time between two samples."""
    plan: bytes
    """Encoded settings of the source, which the feature passes to its `build`."""
    has_body: bool = False
    """True if the source measures the simulated robot body in a virtual run."""

    @property
    def title(self) -> str:
        """Name of the source in messages: `sensor imu`."""
        return f"{self.kind} {self.source}"


class SourceContext(msgspec.Struct, frozen=True):
    """Objects that a source gets from its process when it is built."""

    plugins: PlugIns
    writer: SlotWriter
    now_ns: Callable[[], int]
    """Returns the time on the run's clock, ns."""
    body: Body | None
    """The simulated body; None without `SourceProcess.has_body`."""


class Driver(Protocol):
    """Driver of a source's device, such as the class of a plug-in. Its methods may raise anything."""

    @property
    def waits(self) -> bool:
        """True if `read` waits until the device has its next sample."""

    def read(self, values: Floats) -> int | None:
        """Write a sample into `values`, which are NaN; return its time, ns of the run's clock.

        None without.
        """

    def close(self) -> None:
        """Close the device. Also called after an attempt to open it has failed."""


class SampledSource:
    """A source that writes samples of its driver into a slot of shared memory. Only `open_first` raises.

    Args:
        driver: Driver of the device.
        open_driver: Opens the driver's device. Its argument is a function that reports a sentence.
        period_ns: Time between two samples.
        context: Slot and clock of the process.
    """

    def __init__(
        self,
        driver: Driver,
        open_driver: Callable[[Callable[[str], None]], None],
        period_ns: int,
        context: SourceContext,
    ) -> None:
        self.driver = driver
        self.is_open = False
        """True while the device is open."""
        self.reopen_ns = 0
        """Time of the next attempt to open the device, ns; meaningful only while `is_open` is False."""
        self._open_driver = open_driver
        self._period_ns = period_ns
        self._writer = context.writer
        self._now_ns = context.now_ns
        self._values: Floats = np.full(context.writer.values, np.nan)
        self._ahead = False

    def open_first(self) -> None:
        """Open the device at the start of a run, and report it as open; raise whatever the driver raises."""
        try:
            self._open_driver(self._say)
        except BaseException:
            self.close()
            raise
        self.is_open = True
        self._writer.write_state(SlotState.OPEN, "")

    def sample(self) -> bool:
        """Write one sample to the slot, or reopen a failed device; return True if a sample was written."""
        if not self.is_open and not self._reopen():
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
                self._say(f"its timestamps are {ahead_ns / 1e6:.0f} ms in the future; arrival times are used")
            # A time in the future would make the sample younger than it is.
            self._writer.write_sample(min(int(t_ns), now_ns), self._values)
        except Exception as error:  # every error of a driver becomes an event
            self.close_after_error(error)
            return False
        return True

    def close(self) -> None:
        """Close the device; report an exception of the driver in the slot instead of raising it."""
        self.is_open = False
        try:
            self.driver.close()
        except Exception as error:  # as above
            self._writer.write_state(SlotState.FAILED, f"cannot be closed: {describe_error(error)}")

    def close_after_error(self, error: Exception) -> None:
        """Close the device after an exception, report the error, and reopen after REOPEN_NS."""
        self.close()
        self.reopen_ns = self._now_ns() + REOPEN_NS
        self._writer.write_state(SlotState.FAILED, describe_error(error))

    def _reopen(self) -> bool:
        if self._now_ns() < self.reopen_ns:
            return False
        try:
            self._open_driver(self._say)
        except Exception as error:  # as above
            self.close_after_error(error)
            return False
        self.is_open = True
        self._writer.write_state(SlotState.OPEN, "is open again")
        return True

    def _say(self, text: str) -> None:
        self._writer.write_state(SlotState.OPEN if self.is_open else SlotState.STARTING, text)


class ProcessStage(msgspec.Struct, frozen=True):
    """Processes of a feature: the object `STAGE` of its `process.py`.

    On virtual time, they run in the loop's process.
    """

    FILE: ClassVar[str] = "process"

    processes: Callable[[bytes], Sequence[SourceProcess]]
    """Returns the processes to start, from the feature's encoded plan (`Contribution.plan`)."""
    build: Callable[[bytes, SourceContext], SampledSource]
    """Builds the source in its process, from `SourceProcess.plan`. Raises PlugInError."""
    refuse_virtual_time: Callable[[bytes], str] = lambda plan: ""
    """Returns why a run with the feature's plan cannot use virtual time; empty if it can."""


class PlannedProcess(msgspec.Struct, frozen=True):
    """A source process of a run, with its feature and its index among that feature's processes."""

    feature: Feature
    stage: ProcessStage
    index: int
    process: SourceProcess


def planned_processes(loop: LoopPlan) -> Iterator[PlannedProcess]:
    """Yield the source processes of all features of a robot, in order of features and processes."""
    for feature, stage in stages(ProcessStage, loop.features):
        for index, process in enumerate(stage.processes(loop.feature_plans.get(feature.name, b""))):
            yield PlannedProcess(feature, stage, index, process)


class SourceReader(Protocol):
    """Copies the newest samples of a feature's source processes into the cycle's record."""

    def read_sources(self) -> None:
        """Copy the newest samples into the record.

        Called in each cycle after the servos were read. Never waits.
        """


class ReaderContext(msgspec.Struct, frozen=True):
    """Objects that a reader gets in the loop's process when it is built."""

    plan: bytes
    """The feature's encoded plan (`Contribution.plan`)."""
    slots: Sequence[memoryview]
    """Shared-memory slots of the feature's processes, in the order of the processes."""
    record: CycleRecord
    now_ns: Callable[[], int]
    """Returns the time, ns, on the clock that stamps the samples in the slots."""
    events: EventSink


class ReaderStage(msgspec.Struct, frozen=True):
    """Reader of a feature: the object `STAGE` of its `reader.py`. A replay has no readers."""

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
    """Return an error as one line of text, with its type unless it is an OSError with a message."""
    text = _NUMBER.sub("", " ".join(str(error).split()))
    return text if isinstance(error, OSError) and text else f"{type(error).__name__}: {text}"
