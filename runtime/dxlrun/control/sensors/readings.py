"""Readings: the newest samples of all sensors into the cycle's record; it copies, and never waits."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from dxlrun.channels.cycle import CycleRecord
from dxlrun.channels.events import EventCode, EventSink, Severity
from dxlrun.channels.slot import Floats, SlotReader, SlotState
from dxlrun.plan.loop_plan import LoopPlan, SensorPlan

_GONE = (SlotState.FAILED, SlotState.ENDED)
"""The device is not there, or the process is not."""


QUIET_NS = 100_000_000
"""Between two sentences of a sensor that is there: one that says something in each cycle fills no log."""


class Readings:
    """The loop's end of all slots.

    A row is valid while its sensor is there, and its newest sample is finite and younger than its timeout.
    Values and age are those of the last finite sample for ever. What changes is an event, once.
    """

    def __init__(
        self,
        plan: LoopPlan,
        slots: Sequence[memoryview],
        record: CycleRecord,
        now_ns: Callable[[], int],
        events: EventSink,
    ) -> None:
        """`slots` in the order of the plan's sensors; `now_ns` is the clock by which they give times."""
        self._now_ns = now_ns
        self._rows = tuple(
            _Row(sensor, SlotReader(memory), record, events)
            for sensor, memory in zip(plan.sensors, slots, strict=True)
        )

    def read(self) -> None:
        """Fill the rows of the record."""
        now_ns = self._now_ns()
        for row in self._rows:
            row.read(now_ns)


class _Row:
    def __init__(self, plan: SensorPlan, reader: SlotReader, record: CycleRecord, events: EventSink) -> None:
        if reader.values != len(plan.states):
            raise ValueError(f"the slot of sensor {plan.name} has {reader.values} values, not {plan.states}")
        self._plan, self._reader, self._events = plan, reader, events
        self._values: Floats = record.sources.values[record.layout.source_slice(plan.name)]
        self._place = record.layout.sources.index(plan.name)
        self._valid, self._age_ns = record.sources.valid, record.sources.age_ns
        self._are_finite = np.zeros(len(plan.states), np.bool_)
        self._t_ns = self._begun_ns = -1
        self._quiet_ns = 0
        self._finite = True
        self._lost = False

    def read(self, now_ns: int) -> None:
        reader = self._reader
        t_ns = reader.read()
        if t_ns is not None:
            self._finite = bool(np.isfinite(reader.sample, out=self._are_finite).all())
            if self._finite:
                np.copyto(self._values, reader.sample)
                self._t_ns = min(t_ns, now_ns)
        if self._begun_ns < 0:
            self._begun_ns = now_ns
        known = self._t_ns >= 0
        age_ns = max(0, now_ns - self._t_ns) if known else -1
        silent = (age_ns if known else now_ns - self._begun_ns) > self._plan.timeout_ns
        self._age_ns[self._place] = age_ns
        lost = silent or not self._finite or reader.state in _GONE
        self._valid[self._place] = known and not lost
        if (reader.state in _GONE or now_ns >= self._quiet_ns) and (text := reader.hear()):
            self._quiet_ns = now_ns + QUIET_NS
            self._say(text)
        if lost != self._lost:
            self._lost = lost
            self._report(silent, age_ns)

    def _say(self, text: str) -> None:
        severity = Severity.ERROR if self._reader.state in _GONE else Severity.INFO
        self._events.emit(EventCode.SENSOR, severity, self._plan.name, f"sensor {self._plan.name}: {text}")

    def _report(self, silent: bool, age_ns: int) -> None:
        name = self._plan.name
        if not self._lost:
            text = f"sensor {name} brings samples again"
            self._events.emit(EventCode.SENSOR_BACK, Severity.INFO, name, text)
            return
        if not self._finite:
            values = zip(self._plan.states, self._reader.sample.tolist(), strict=True)
            wrong = ", ".join(f"{state} is {value}" for state, value in values if not math.isfinite(value))
            text = f"sensor {name}: {wrong}; its values are not used"
        elif silent:
            since = f"for {age_ns / 1e6:.0f} ms" if age_ns >= 0 else "since the start"
            text = f"sensor {name} brought no sample {since}"
        else:
            text = f"sensor {name} is gone; its values are not valid"
        self._events.emit(EventCode.SENSOR_LOST, Severity.ERROR, name, text)
