"""What the loop makes of samples: values, validity, age, and an event where that changes."""

from __future__ import annotations

import math
import tracemalloc
from dataclasses import dataclass, field

import numpy as np
import pytest

from dxlrun.channels import slot
from dxlrun.channels.cycle import CycleRecord
from dxlrun.channels.event_records import EventBody, Severity
from dxlrun.channels.slot import SlotState, SlotWriter
from dxlrun.control.sampled_sources import ReaderContext
from dxlrun.features.sensors.events import SensorEvent
from dxlrun.features.sensors.plan import SensorPlan, encode_sensors
from dxlrun.features.sensors.reader import Readings
from dxlrun.plan.loop_plan import LoopPlan, SchedulerPlan, SourcePlan

MS = 1_000_000
STATES = ("angular_velocity.x", "angular_velocity.y")


@dataclass
class Desk:
    """Two sensors and a device before them, as the loop has them."""

    now_ns: int = 1_000 * MS
    noisy: tuple[str, ...] = ()
    events: list[tuple[SensorEvent, Severity, str, str]] = field(default_factory=list)

    def __post_init__(self) -> None:
        sensors = tuple(
            SensorPlan(name, "any", "", "{}", STATES, 10 * MS, timeout_ns=50 * MS, noisy=noisy)
            for name, noisy in (("imu", self.noisy), ("other", ()))
        )
        sources = (
            SourcePlan("foot", "device", ("force.x",)),
            *(SourcePlan(one.name, "sensor", one.states) for one in sensors),
        )
        scheduler = SchedulerPlan("other", 31, False)
        plan = LoopPlan(20 * MS, scheduler, (), (), (), None, sources=sources)
        self.record = CycleRecord(plan.layout)
        slots = [slot.private(2), slot.private(2)]
        self.writer, self.other = (SlotWriter(memory) for memory in slots)
        context = ReaderContext(encode_sensors(sensors), slots, self.record, lambda: self.now_ns, self)
        self.readings = Readings(context)

    def emit_event(self, source: str, event: EventBody, data: bytes = b"") -> None:
        self.events.append((event.code, event.severity, source, event.text))

    def cycle(self, ms: int = 20) -> tuple[list[float], bool, int]:
        """Let a cycle read; return values, validity and age of the first sensor."""
        self.now_ns += ms * MS
        self.readings.read_sources()
        sources = self.record.sources
        return sources.values[1:3].tolist(), bool(sources.valid[1]), sources.age_ns.item(1)

    def sample(self, x: float, y: float = 0.0, *, age_ms: int = 0) -> None:
        self.writer.write_sample(self.now_ns - age_ms * MS, np.array((x, y)))

    def told(self) -> list[tuple[SensorEvent, str]]:
        found = [(code, text) for code, _, source, text in self.events if source == "imu"]
        self.events.clear()
        return found


@pytest.fixture
def desk() -> Desk:
    return Desk()


def test_a_sample_is_valid_until_its_timeout_and_its_age_is_true(desk):
    desk.sample(1.0, 2.0, age_ms=3)
    assert desk.cycle(0) == ([1.0, 2.0], True, 3 * MS)
    assert desk.cycle() == ([1.0, 2.0], True, 23 * MS)
    assert desk.cycle() == ([1.0, 2.0], True, 43 * MS)
    assert desk.told() == []
    assert desk.cycle() == ([1.0, 2.0], False, 63 * MS)
    assert desk.told() == [(SensorEvent.SENSOR_LOST, "sensor imu delivered no sample for 63 ms")]
    assert desk.cycle()[1:] == (False, 83 * MS)
    assert desk.told() == []
    desk.sample(3.0)
    assert desk.cycle(5) == ([3.0, 0.0], True, 5 * MS)
    assert desk.told() == [(SensorEvent.SENSOR_BACK, "sensor imu delivers samples again")]
    assert math.isnan(desk.record.sources.values[0])


def test_before_the_first_sample_there_is_nothing_and_the_silence_is_an_event(desk):
    values, valid, age_ns = desk.cycle()
    assert all(map(math.isnan, values))
    assert (valid, age_ns) == (False, -1)
    for _ in range(3):
        desk.cycle()
    assert desk.told() == [(SensorEvent.SENSOR_LOST, "sensor imu delivered no sample since the start")]


def bring(desk: Desk, x: float, y: float, seconds: float) -> list[tuple[bool, int]]:
    """Bring the same sample every 10 ms; return validity and age of each cycle."""
    found = []
    for _ in range(round(seconds * 100)):
        desk.sample(x, y)
        found.append(desk.cycle(10)[1:])
    return found


def test_a_sensor_whose_noise_does_not_show_is_stuck_until_it_changes():
    desk = Desk(noisy=STATES)
    bring(desk, 1.0, 2.1, 0.01)
    assert all(valid for valid, _ in bring(desk, 1.0, 2.0, 0.2))
    valid, ages = zip(*bring(desk, 1.0, 2.0, 0.3), strict=True)
    assert not any(valid[1:])
    assert list(ages[1:]) == [(200 + 10 * more) * MS for more in range(2, 31)]
    ((code, text),) = desk.told()
    assert (code, text) == (
        SensorEvent.SENSOR_LOST,
        "sensor imu has returned the same sample for 210 ms; check its cable and its driver",
    )
    desk.sample(1.0, 2.5)
    assert desk.cycle(10) == ([1.0, 2.5], True, 10 * MS)
    assert [code for code, _ in desk.told()] == [SensorEvent.SENSOR_BACK]


def test_a_sensor_is_not_stuck_while_one_noisy_value_changes_or_it_has_no_noise():
    desk = Desk(noisy=STATES)
    for turn in range(100):
        desk.sample(1.0, 0.1 * (turn % 2))
        assert desk.cycle(10)[1:] == (True, 10 * MS)
    assert all(valid for valid, _ in bring(Desk(), 1.0, 2.0, 3.0))


def test_few_equal_samples_of_a_slow_sensor_and_many_of_a_fast_poll_are_no_sign():
    slow, polled = Desk(noisy=STATES), Desk(noisy=STATES)
    for _ in range(19):  # 380 ms
        slow.sample(1.0)
        assert slow.cycle(20)[1]
    for turn in range(400):  # a device at 10 Hz, asked every ms
        polled.sample(float(turn // 100))
        assert polled.cycle(1)[1]


def test_a_chip_with_a_dead_band_is_not_stuck_at_rest():
    desk = Desk(noisy=STATES)
    bring(desk, 0.1, 0.2, 0.01)
    assert all(valid for valid, _ in bring(desk, 0.0, 0.0, 3.0))


def test_a_sensor_that_measures_each_250_ms_and_is_read_each_10_ms_is_not_stuck():
    desk = Desk(noisy=STATES)
    assert all(valid for turn in range(1, 9) for valid, _ in bring(desk, 0.1 * turn, 2.0, 0.25))
    valid = [valid for valid, _ in bring(desk, 0.9, 2.0, 1.2)]
    assert all(valid[:100])
    assert not valid[-1]


def test_a_sensor_that_never_changes_is_stuck_after_two_seconds():
    valid = [valid for valid, _ in bring(Desk(noisy=STATES), 1.0, 2.0, 2.2)]
    assert all(valid[:200])
    assert not valid[-1]


@pytest.mark.parametrize("wrong", [math.nan, math.inf, -math.inf])
def test_a_sample_that_is_not_finite_is_an_event_and_never_in_the_record(desk, wrong):
    desk.sample(1.0)
    desk.cycle(1)
    desk.sample(2.0, wrong)
    assert desk.cycle(1) == ([1.0, 0.0], False, 2 * MS)
    what = f"sensor imu: angular_velocity.y is {wrong}; its values are not used"
    assert desk.told() == [(SensorEvent.SENSOR_LOST, what)]
    desk.sample(wrong)
    assert desk.cycle(1) == ([1.0, 0.0], False, 3 * MS)
    assert desk.told() == []
    desk.sample(4.0)
    assert desk.cycle(1) == ([4.0, 0.0], True, MS)
    assert [code for code, _ in desk.told()] == [SensorEvent.SENSOR_BACK]


def test_the_end_of_its_process_is_an_event_and_its_row_is_not_valid_at_once(desk):
    desk.sample(1.0)
    desk.cycle(1)
    desk.writer.write_state(SlotState.ENDED, "its process exited (signal SIGKILL) and is restarted")
    assert desk.cycle(1)[1] is False
    assert desk.events[0][:2] == (SensorEvent.SENSOR, Severity.ERROR)
    assert [code for code, _ in desk.told()] == [SensorEvent.SENSOR, SensorEvent.SENSOR_LOST]
    desk.writer.write_state(SlotState.OPEN, "")
    desk.sample(2.0)
    assert desk.cycle(1)[1] is True
    assert [code for code, _ in desk.told()] == [SensorEvent.SENSOR_BACK]


def test_a_sentence_of_a_sensor_is_an_event_once(desk):
    desk.writer.write_state(SlotState.OPEN, "calibrated")
    desk.cycle(1)
    desk.cycle(1)
    assert desk.told() == [(SensorEvent.SENSOR, "sensor imu: calibrated")]


def test_a_sensor_that_never_is_silent_fills_no_log(desk):
    for number in range(100):
        desk.sample(1.0)
        desk.writer.write_state(SlotState.OPEN, f"sample {number}")
        desk.cycle(10)
    told = desk.told()
    assert len(told) == 10
    assert told[-1][1] == "sensor imu: sample 90"
    desk.writer.write_state(SlotState.FAILED, "gone")  # what matters is not kept back
    desk.cycle(1)
    assert desk.told()[0] == (SensorEvent.SENSOR, "sensor imu: gone")


def test_a_time_in_the_future_is_now_and_hides_no_silence(desk):
    desk.sample(1.0, age_ms=-5000)
    assert desk.cycle(0) == ([1.0, 0.0], True, 0)
    assert desk.cycle(60) == ([1.0, 0.0], False, 60 * MS)
    assert desk.told() == [(SensorEvent.SENSOR_LOST, "sensor imu delivered no sample for 60 ms")]


def test_reading_allocates_nothing_that_stays(desk):
    """Threads beside the test allocate as well, but not in each of five rounds."""
    sizes = []
    desk.other.write_sample(desk.now_ns, np.zeros(2))
    tracemalloc.start()
    try:
        for _ in range(6):
            for _ in range(400):
                desk.sample(1.0)
                desk.cycle(1)
            desk.events.clear()
            sizes.append(tracemalloc.get_traced_memory()[0])
    finally:
        tracemalloc.stop()
    assert min(np.diff(sizes)) < 400  # a byte for each cycle would be as much
