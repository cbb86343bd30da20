"""Sensor reader: copies each sensor's newest sample from shared memory into the cycle's record."""

from __future__ import annotations

import math

import numpy as np

from dxlrun.channels.cycle import CycleRecord
from dxlrun.channels.event_records import EventSink
from dxlrun.channels.slot import Floats, SlotReader, SlotState
from dxlrun.control.sampled_sources import ReaderContext, ReaderStage
from dxlrun.features.sensors import texts
from dxlrun.features.sensors.plan import SensorPlan, decode_sensors

_GONE = (SlotState.FAILED, SlotState.ENDED)
"""States of a sensor's shared memory in which no sample can come: its device or process is gone."""


MOST_EQUAL = 20
"""A sensor is stuck only after this many equal samples in a row. With noise of only 0.3 units of the last
digit the six values of an IMU repeat in 2 of 5 samples, so 20 times in a row once in 10^8 samples. [i]"""
STUCK_NS = 200_000_000
"""Shortest duration of equal samples, ns, after which a sensor can count as stuck."""
STUCK_INTERVALS = 4
"""The same duration in multiples of the longest time between two changes so far: a driver may be called more
often than its device measures."""
FIRST_STUCK_NS = 2_000_000_000
"""Duration of equal samples, ns, that always counts as stuck, and the limit before the first change; a
Phidget measures every 250 ms by default."""
QUIET_NS = 100_000_000
"""Shortest time between two messages of a working sensor in the log, ns; others are dropped."""


class Readings:
    """Reads the samples of all sensors in the loop process; emits an event when one is lost or back.

    A row is valid if its sensor is present, and its newest sample is finite and younger than its timeout.
    Values and age remain those of the last finite sample. The samples of a stuck sensor, whose noisy values
    stay constant, have the age of the first of them.
    """

    def __init__(self, context: ReaderContext) -> None:
        self._now_ns = context.now_ns
        self._rows = tuple(
            _SensorRow(sensor, SlotReader(memory), context.record, context.events)
            for sensor, memory in zip(decode_sensors(context.plan), context.slots, strict=True)
        )

    def read_sources(self) -> None:
        """Copy each sensor's newest sample, age and validity into the cycle's record; never blocks."""
        now_ns = self._now_ns()
        for row in self._rows:
            row.read_sample(now_ns)


STAGE = ReaderStage(Readings)


class _SensorRow:
    def __init__(self, plan: SensorPlan, reader: SlotReader, record: CycleRecord, events: EventSink) -> None:
        if reader.values != len(plan.states):
            raise ValueError(f"the slot of sensor {plan.name} has {reader.values} values, not {plan.states}")
        self._plan, self._reader, self._events = plan, reader, events
        self._values: Floats = record.sources.values[record.layout.source_slice(plan.name)]
        self._place = record.layout.sources.index(plan.name)
        self._valid, self._age_ns = record.sources.valid, record.sources.age_ns
        self._are_finite = np.zeros(len(plan.states), np.bool_)
        self._t_ns = self._begun_ns = -1
        self._noisy = np.array([plan.states.index(state) for state in plan.noisy], dtype=np.intp)
        quantities = [state.partition(".")[0] for state in plan.noisy]
        self._quantities = [self._noisy[[one == each for each in quantities]] for one in {*quantities}]
        """Indices of the noisy states, one array for each quantity."""
        self._equal, self._since_ns = 0, -1
        """Number of samples since the last change of the noisy states, and the time of that change, ns."""
        self._stuck_ns = FIRST_STUCK_NS
        """Duration of equal samples, ns, after which this sensor counts as stuck."""
        self._longest_ns = 0
        """Longest time between two changes of the noisy states so far, ns."""
        self._quiet_ns = 0
        self._finite = True
        self._lost = False

    def read_sample(self, now_ns: int) -> None:
        reader = self._reader
        t_ns = reader.read_sample()
        if t_ns is not None:
            self._finite = bool(np.isfinite(reader.sample, out=self._are_finite).all())
            if self._finite:
                self._store_sample(reader.sample, min(t_ns, now_ns))
        if self._begun_ns < 0:
            self._begun_ns = now_ns
        known = self._t_ns >= 0
        age_ns = max(0, now_ns - self._t_ns) if known else -1
        silent = (age_ns if known else now_ns - self._begun_ns) > self._plan.timeout_ns
        self._age_ns[self._place] = age_ns
        lost = silent or not self._finite or reader.state in _GONE
        self._valid[self._place] = known and not lost
        if (reader.state in _GONE or now_ns >= self._quiet_ns) and (text := reader.read_text()):
            self._quiet_ns = now_ns + QUIET_NS
            self._say(text)
        if lost != self._lost:
            self._lost = lost
            self._report_state(silent, age_ns)

    @property
    def _stuck(self) -> bool:
        return self._equal >= MOST_EQUAL and self._t_ns == self._since_ns

    def _store_sample(self, sample: Floats, t_ns: int) -> None:
        """Store a sample with its time; if the sensor is stuck, the time of its last change is stored."""
        noisy = self._noisy
        if noisy.size and np.array_equal(sample[noisy], self._values[noisy]):
            self._equal += 1
        else:
            if self._since_ns >= 0:
                if self._equal:  # otherwise samples were missing, so the interval of the device is unknown
                    self._longest_ns = max(self._longest_ns, t_ns - self._since_ns)
                self._stuck_ns = min(max(STUCK_NS, STUCK_INTERVALS * self._longest_ns), FIRST_STUCK_NS)
            self._equal, self._since_ns = 0, t_ns
        stuck = self._equal >= MOST_EQUAL and t_ns - self._since_ns >= self._stuck_ns
        # A chip with a dead band returns exactly 0 at rest, which proves nothing.
        stuck = stuck and all(sample[of].any() for of in self._quantities)
        self._t_ns = self._since_ns if stuck else t_ns
        np.copyto(self._values, sample)

    def _say(self, text: str) -> None:
        row = texts.sensor_failed if self._reader.state in _GONE else texts.sensor_says
        self._events.emit_event(self._plan.name, row(self._plan.name, text))

    def _report_state(self, silent: bool, age_ns: int) -> None:
        name = self._plan.name
        if not self._lost:
            self._events.emit_event(name, texts.sensor_back(name))
            return
        if not self._finite:
            values = zip(self._plan.states, self._reader.sample.tolist(), strict=True)
            wrong = ", ".join(f"{state} is {value}" for state, value in values if not math.isfinite(value))
            event = texts.sensor_not_finite(name, wrong)
        elif silent and self._stuck:
            event = texts.sensor_stuck(name, age_ns)
        elif silent:
            event = texts.sensor_silent(name, age_ns) if age_ns >= 0 else texts.sensor_never_answered(name)
        else:
            event = texts.sensor_gone(name)
        self._events.emit_event(name, event)
