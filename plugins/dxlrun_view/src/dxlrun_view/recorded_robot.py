"""Log as the source of the page. All columns are kept in memory; the cycles of a long log are downsampled."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from dxlrun import DxlrunError, LogError, open_log
from dxlrun.tooling.live import joint_servos
from dxlrun.tooling.plans import Plan, from_json
from dxlrun.tooling.records import Event
from dxlrun.tooling.topics import BUS_PREFIX, LogTopic
from dxlrun_view.curves import (
    CYCLE,
    JOINT_COLUMNS,
    LATE,
    Curve,
    History,
    Moment,
    columns_of,
    numbers_in,
    thinned,
)
from dxlrun_view.shown import (
    LiveEvent,
    SourceProperties,
    TimelineMark,
    ViewedController,
    ViewedRobot,
)

MOST_CYCLES = 100_000
"""Cycles that are at least kept of a log: at twice this number, every second one is dropped. With 20 joints,
they take some 120 MB."""
_IN_COLUMNS = (
    LogTopic.CYCLE,
    LogTopic.ACTIVATION,
    LogTopic.COMMANDS,
    LogTopic.EVENT,
    LogTopic.JOINT_STATES,
    LogTopic.JOINT_COMMANDS,
)
"""Topics that offer no curves: they have no numbers, or their numbers are columns of the cycles already."""
_NONE = np.zeros(0, [("cycle", "i8")])
WORST = 8
"""Number of marks on the time line, at the cycles with the latest wake-ups"""


class RecordedRobot:
    """Log of dxlrun as the source of the page, read into memory. Times are s from its first cycle."""

    def __init__(self, path: Path, progress: Callable[[float], object] = lambda share: None) -> None:
        """Read a log.

        Args:
            path: Log file, or directory of parts.
            progress: Called with the fraction that has been read, 0..1.

        Raises:
            LogError: The log is not readable, is of another program, or has no cycle.
        """
        reader = open_log(path)
        if reader.header is None:
            raise LogError(f"{path} is an MCAP file of another program; give a log of dxlrun")
        self._reader = reader
        self._header = reader.header
        read = _CycleReader()
        for part in reader.slices():
            read.add_cycles(part.cycles)
            read.events += part.events
            progress(reader.share)
        cycles = read.cycles
        if not len(cycles):
            raise LogError(f"{path} has no cycles; give the log of a longer run")
        self._begin_ns = int(cycles["woken_ns"][0])
        self._every, self._skipped = read.every, read.skipped
        self._marks = self._worst(read.worst)
        self._times = self._seconds(cycles["woken_ns"])
        self._history = self._columns(cycles)
        self._events = tuple(
            LiveEvent(number, time_s, int(event.severity), event.source, event.text, time_s)
            for number, event in enumerate(sorted(read.events, key=lambda each: each.t_ns), 1)
            for time_s in (float(self._seconds(event.t_ns)),)
        )
        self._plan = self._planned()
        self._info = self._of_run(reader.metadata.get("run", {}).get("robot_file", ""))
        self._fields = tuple(sorted(self._drawable()))
        self._topics: dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]] = {}

    @property
    def folder(self) -> Path | None:
        """Directory of the robot file that was run, or None if it no longer exists"""
        folder = Path(self._info.file).parent
        return folder if folder.is_dir() else None

    def describe_page(self) -> SourceProperties:
        """Return the properties of the robot and the log that the page shows in addition to the curves."""
        frames = self._plan.frames if self._plan is not None else None
        return SourceProperties(
            info=self._info,
            live=False,
            columns=self._history.columns,
            span=self._history.span,
            every=self._every,
            units=self._header.source_units,
            fields=self._fields,
            marks=self._marks,
            imu=frames.imu if frames is not None else "",
            imu_link=frames.imu_link if frames is not None else "",
        )

    def moment_at(self, time_s: float | None) -> Moment:
        """Return all columns in the last cycle not after a time (s), by default in the last of the log."""
        return self._history.at(time_s)

    def curve(self, name: str, begin: float, end: float, points: int) -> Curve:
        """Return a column, or a number of a topic such as `/arm/state:error[0]`, between two times (s).

        Raises KeyError for an unknown curve.
        """
        if name in self._history:
            return self._history.curve(name, begin, end, points)
        times, values = self._field(name)
        inside = (times >= begin) & (times <= end)
        return thinned(name, times[inside], values[inside], points)

    def events(self, after: int) -> tuple[LiveEvent, ...]:
        """Return the events with a number greater than `after`."""
        return self._events[after:]

    def urdf(self) -> str:
        """Return the URDF in the log's plan; empty if there is none."""
        return self._plan.urdf or "" if self._plan is not None else ""

    def close(self) -> None:
        """Do nothing: the log is in memory."""

    def _field(self, name: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return times (s) and values of a topic's number; NaN where an array is shorter. Raises KeyError."""
        if name not in self._topics:
            topic, _, field = name.partition(":")
            field, _, index = field.partition("[")
            try:
                found = self._reader.columns(topic, field)
                values = found[field]
                if index:
                    place = int(index.rstrip("]"))
                    values = np.array([row[place] if place < len(row) else np.nan for row in values])
                self._topics[name] = self._seconds(found["t_ns"].astype(np.int64)), values.astype(np.float64)
            except (LogError, ValueError, TypeError, IndexError) as error:
                raise KeyError(name) from error
        return self._topics[name]

    def _drawable(self) -> Iterator[str]:
        """Yield the names of the topics' numbers that can be drawn, from the first message of each topic."""
        for topic in self._reader.topics:
            if topic in _IN_COLUMNS or topic.startswith(BUS_PREFIX):
                continue
            with suppress(LogError):
                for batch in self._reader.batches(topic):
                    first = {field: values[0] for field, values in batch.items() if field != "t_ns"}
                    yield from numbers_in(first, f"{topic}:")
                    break

    def _seconds(self, t_ns: NDArray[np.int64] | int) -> NDArray[np.float64]:
        """Return times since the first cycle, s."""
        return np.asarray(t_ns - self._begin_ns, np.float64) * 1e-9

    def _columns(self, cycles: NDArray[np.void]) -> History:
        header = self._header
        layout, times = header.layout, self._times
        active = [f"{one.name}/active" for one in header.controllers]
        columns = columns_of(header.joints, layout.source_states, (*header.references, *active))
        history = History(columns, len(cycles))
        history.fill_column(times, CYCLE, cycles["cycle"].astype(np.float64))
        history.fill_column(times, LATE, (cycles["woken_ns"] - cycles["scheduled_ns"]) * 1e-9)
        for column in JOINT_COLUMNS:
            for row, joint in enumerate(header.joints):
                history.fill_column(times, f"{joint}/{column}", cycles[column][:, row])
        for row, state in enumerate(layout.source_states):
            history.fill_column(times, state, cycles["source_state"][:, row])
        for row, reference in enumerate(header.references):
            history.fill_column(times, reference, cycles["reference"][:, row])
        for row, name in enumerate(active):
            is_active = (cycles["active"] >> np.uint64(row)) & np.uint64(1)
            history.fill_column(times, name, is_active.astype(np.float64))
        return history

    def _worst(self, cycles: NDArray[np.void]) -> tuple[TimelineMark, ...]:
        late = _late_s(cycles)
        times = self._seconds(cycles["woken_ns"])
        return tuple(
            TimelineMark(float(time_s), f"cycle {int(number)}, {late_s * 1e3:.2f} ms late")
            for time_s, number, late_s in zip(times, cycles["cycle"], late, strict=True)
            if late_s > 0.0
        )

    def _planned(self) -> Plan | None:
        """Return the run's plan from the log, or None if it is missing, damaged or of an older version."""
        try:
            return from_json(self._reader.attachments["plan.json"])
        except (KeyError, DxlrunError, msgspec.MsgspecError, ValueError):
            return None

    def _of_run(self, file: str) -> ViewedRobot:
        """Return the robot's information from log header and plan; `file` is the path of the robot file."""
        header, plan = self._header, self._plan
        info = ViewedRobot(
            header.robot,
            1e9 / header.period_ns,
            skipped=self._skipped,
            joints=header.joints,
            controllers=tuple(ViewedController(one.name, "", active=False) for one in header.controllers),
            file=file,
        )
        if plan is None:
            return info
        joints, controllers = plan.loop.joints, {one.name: one for one in plan.loop.controllers}
        return msgspec.structs.replace(
            info,
            units={joint.name: joint.unit.si for joint in joints},
            effort_units={
                joint.name: joint.servo_model.effort_unit.replace("1", "")
                for joint in joints
                if joint.servo_model is not None
            },
            limits={joint.name: (joint.lower, joint.upper) for joint in joints if joint.bounded},
            servos=joint_servos(plan),
            controllers=tuple(
                msgspec.convert(controllers.get(row.name, row), ViewedController, from_attributes=True)
                for row in info.controllers
            ),
        )


class _CycleReader:
    """Cycles and events of a log while it is read. Every second cycle is dropped when there are too many."""

    def __init__(self) -> None:
        self.every = 1
        """Number of cycles in the log per kept cycle"""
        self.skipped = 0
        """Number of periods of the loop that were skipped"""
        self.events: list[Event] = []
        self.worst = _NONE
        """The WORST cycles with the latest wake-ups, the latest first"""
        self._parts: list[NDArray[np.void]] = []
        self._seen = self._kept = 0

    def add_cycles(self, cycles: NDArray[np.void]) -> None:
        """Add the cycles of the next slice of the log."""
        if not len(cycles):
            return
        self.skipped += int(cycles["skipped"].sum())
        both = np.concatenate([self.worst, cycles]) if len(self.worst) else cycles
        self.worst = both[np.argsort(_late_s(both))[::-1][:WORST]]
        # The first index continues the stride of the previous slice.
        self._parts.append(cycles[-self._seen % self.every :: self.every].copy())
        self._seen += len(cycles)
        self._kept += len(self._parts[-1])
        if self._kept > 2 * MOST_CYCLES:
            self._parts = [self.cycles[::2].copy()]
            self._kept = len(self._parts[0])
            self.every *= 2

    @property
    def cycles(self) -> NDArray[np.void]:
        """All cycles that were kept, in one array"""
        return np.concatenate(self._parts) if self._parts else _NONE


def _late_s(cycles: NDArray[np.void]) -> NDArray[np.float64]:
    found: NDArray[np.float64] = (cycles["woken_ns"] - cycles["scheduled_ns"]) * 1e-9
    return found
