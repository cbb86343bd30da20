"""Slots, and what the loop makes of their samples: values, validity, age, and an event where that changes."""

import fcntl
import math
import os
import random
import signal
import subprocess
import sys
import tracemalloc
from dataclasses import dataclass, field

import numpy as np
import pytest

from dxlrun.channels import slot
from dxlrun.channels.cycle import CycleRecord
from dxlrun.channels.event_records import EventBody, Severity
from dxlrun.channels.shared_memory import mapped
from dxlrun.channels.slot import SlotReader, SlotState, SlotWriter
from dxlrun.control.sampled_sources import ReaderContext
from dxlrun.features.sensors.events import SensorEvent
from dxlrun.features.sensors.plan import SensorPlan, encode_sensors
from dxlrun.features.sensors.reader import Readings
from dxlrun.plan.loop_plan import LoopPlan, SchedulerPlan, SourcePlan

VALUES = 6
HAMMER = """
import sys, numpy as np
from dxlrun.channels import shared_memory, slot
writer, values, number = slot.SlotWriter(shared_memory.mapped(int(sys.argv[1]))), np.zeros(6), 0
while True:
    number += 1
    values.fill(number)
    writer.write_sample(number, values)
    writer.write_state(slot.SlotState.OPEN, "%d " % number * 20)
"""


@pytest.fixture
def ends() -> tuple[SlotWriter, SlotReader]:
    memory = slot.private(VALUES)
    return SlotWriter(memory), SlotReader(memory)


def test_the_newest_sample_is_read_once(ends):
    writer, reader = ends
    assert reader.read_sample() is None
    for number in range(1, 6):
        writer.write_sample(100 * number, np.full(VALUES, 1.5 * number))
        assert reader.read_sample() == 100 * number
        assert reader.sample.tolist() == [1.5 * number] * VALUES
        assert reader.read_sample() is None
    writer.write_sample(1, np.zeros(VALUES))
    writer.write_sample(2, np.ones(VALUES))
    assert (reader.read_sample(), reader.sample.tolist()) == (2, [1.0] * VALUES)


def test_a_later_writer_goes_on_where_one_was_killed_in_the_middle(ends):
    writer, reader = ends
    writer.write_sample(1, np.ones(VALUES))
    reader.read_sample()
    writer._places[0].fill(7)  # half a sample, not counted yet
    assert reader.read_sample() is None
    later = SlotWriter(slot_memory(writer))
    later.write_sample(3, np.full(VALUES, 3.0))
    assert (reader.read_sample(), reader.sample.tolist()) == (3, [3.0] * VALUES)
    for number in (4, 5, 6):
        later.write_sample(number, np.zeros(VALUES))
    count = slot_memory(writer)[:8].cast("Q")
    count[0], newest = count[0] - 2, count[0]  # as a reader has it that two samples overtake in its copy
    assert reader.read_sample() is None
    count[0] = newest
    assert (reader.read_sample(), reader.read_sample()) == (6, None)


def slot_memory(writer: SlotWriter) -> memoryview:
    """Return the whole memory of a writer's slot."""
    memory = writer._text.obj
    assert isinstance(memory, bytearray)
    return memoryview(memory)


@pytest.mark.parametrize("place", [0, 1, 2, -1], ids=["number", "time", "value", "checksum"])
def test_a_torn_sample_is_read_once_it_is_whole(ends, place):
    writer, reader = ends
    writer.write_sample(1, np.ones(VALUES))
    writer._places[1][place] ^= np.uint64(1)
    assert reader.read_sample() is None
    writer._places[1][place] ^= np.uint64(1)
    assert (reader.read_sample(), reader.sample.tolist()) == (1, [1.0] * VALUES)
    writer.write_sample(2, np.full(VALUES, 2.0))
    assert reader.read_sample() == 2


def test_a_sample_is_whole_before_its_count_and_read_behind_it(ends, monkeypatch):
    writer, reader = ends
    seen = []

    def stored(words, index, value):
        seen.append((words[index], writer._places[1].copy(), bytes(writer._text[:4])))
        words[index] = value

    monkeypatch.setattr(slot, "store", stored)
    writer.write_sample(7, np.full(VALUES, 1.0))
    ((count, sample, _),) = seen
    assert count == 0
    assert sample.tolist() == writer._places[1].tolist()
    writer._places[1].fill(0)

    def loaded(words, index):  # the sample comes to be seen with its count
        np.copyto(writer._places[1], sample)
        return words[index]

    monkeypatch.setattr(slot, "load", loaded)
    assert reader.read_sample() == 7
    writer.write_state(SlotState.OPEN, "said")
    number = writer._words[2]
    writer.write_state(SlotState.OPEN, "more")
    assert (seen[-1][0], seen[-1][2]) == (number, b"more")


def test_texts_are_heard_once_and_cut(ends):
    writer, reader = ends
    assert (reader.read_text(), reader.state) == ("", SlotState.STARTING)
    writer.write_state(SlotState.FAILED, "cannot be opened")
    assert (reader.read_text(), reader.state) == ("cannot be opened", SlotState.FAILED)
    assert reader.read_text() == ""
    writer.write_state(SlotState.OPEN, "é" * 1000)
    assert len(reader.read_text()) <= slot.LONGEST_TEXT
    writer.write_state(SlotState.OPEN, "torn")
    writer._text[0] = 0
    assert reader.read_text() == ""


def test_garbage_is_no_sample_and_ends_no_reader():
    """A sensor's native code wrote over its memory; what follows it is a sensor's again."""
    memory = slot.private(VALUES)
    reader, chance = SlotReader(memory), random.Random(1)
    for turn in range(300):
        memory[:] = b"\xff" * len(memory) if turn == 0 else chance.randbytes(len(memory))
        assert (reader.read_sample(), reader.read_text(), reader.state) == (None, "", SlotState.FAILED)
        writer = SlotWriter(memory)
        writer.write_state(SlotState.ENDED, "its process exited")
        assert (reader.read_text(), reader.state) == ("its process exited", SlotState.ENDED)
        writer.write_sample(turn + 1, np.full(VALUES, 3.0))
        assert (reader.read_sample(), SlotReader(memory).values) == (turn + 1, VALUES)


def test_the_memory_of_a_sensor_keeps_its_size():
    """A reader that touches a page behind the end of its file is killed (SIGBUS)."""
    descriptor = slot.create("test", VALUES)
    for length in (0, 1 << 20):
        with pytest.raises(PermissionError):
            os.ftruncate(descriptor, length)
    with pytest.raises(PermissionError):  # F_SEAL_FUTURE_WRITE: its end could not be written any more
        fcntl.fcntl(descriptor, fcntl.F_ADD_SEALS, 0x10)
    os.close(descriptor)


def test_a_reader_beside_a_writer_that_never_rests_gets_whole_samples_only():
    descriptor = slot.create("test", VALUES)
    reader = SlotReader(mapped(descriptor))
    child = subprocess.Popen([sys.executable, "-c", HAMMER, str(descriptor)], pass_fds=[descriptor])
    try:
        got, heard, last = 0, 0, 0
        while got < 300 or heard < 20:
            t_ns = reader.read_sample()
            if t_ns is not None:
                assert reader.sample.tolist() == [t_ns] * VALUES
                assert t_ns > last
                got, last = got + 1, t_ns
            if text := reader.read_text():
                assert len(set(text.split())) == 1
                heard += 1
    finally:
        os.kill(child.pid, signal.SIGKILL)
        child.wait()
        os.close(descriptor)


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


STUCK: dict[str, tuple[list[tuple[float, float, float]], int]] = {
    "one noisy value changes": ([(1.0, 0.1 * (turn % 2), 0.01) for turn in range(100)], 100),
    "a chip with a dead band at rest": ([(0.1, 0.2, 0.01), (0.0, 0.0, 3.0)], 301),
    "it measures each 250 ms, once after 20 ms": (
        [*((0.1 * turn, 2.0, 0.25) for turn in range(1, 9)), (0.85, 2.0, 0.02), (0.9, 2.0, 1.2)],
        302,
    ),
    "it never changes": ([(1.0, 2.0, 2.2)], 200),
}
"""Samples and for how long, s; and how many of them are valid at least."""


@pytest.mark.parametrize("case", STUCK)
def test_a_sensor_is_stuck_only_after_more_equal_samples_than_before(case):
    samples, fine = STUCK[case]
    desk = Desk(noisy=STATES)
    valid = [valid for one in samples for valid, _ in bring(desk, *one)]
    assert all(valid[:fine])
    assert valid[-1] is (len(valid) == fine)


def test_few_equal_samples_many_of_a_fast_poll_and_no_noise_are_no_sign():
    slow, polled = Desk(noisy=STATES), Desk(noisy=STATES)
    slow.sample(0.9)
    slow.cycle(20)
    for _ in range(19):  # 380 ms
        slow.sample(1.0)
        assert slow.cycle(20)[1]
    for turn in range(400):  # a device at 10 Hz, asked every ms
        polled.sample(float(turn // 100))
        assert polled.cycle(1)[1]
    assert all(valid for valid, _ in bring(Desk(), 1.0, 2.0, 3.0))


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
