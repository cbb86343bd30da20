"""A slot has the newest whole sample, or says that there is none; its reader never waits."""

from __future__ import annotations

import fcntl
import os
import random
import signal
import subprocess
import sys

import numpy as np
import pytest

from dxlrun.channels import slot
from dxlrun.channels.shared_memory import mapped
from dxlrun.channels.slot import SlotReader, SlotState, SlotWriter

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


def slot_memory(writer: SlotWriter) -> memoryview:
    """Return the whole memory of a writer's slot."""
    memory = writer._text.obj
    assert isinstance(memory, bytearray)
    return memoryview(memory)


@pytest.mark.parametrize("place", [0, 1, 2, -1], ids=["number", "time", "value", "checksum"])
def test_a_torn_sample_is_not_used(ends, place):
    writer, reader = ends
    writer.write_sample(1, np.ones(VALUES))
    writer._places[1][place] += np.uint64(1)
    assert reader.read_sample() is None
    writer.write_sample(2, np.full(VALUES, 2.0))
    assert reader.read_sample() == 2


def test_a_torn_sample_is_read_once_it_is_whole(ends):
    writer, reader = ends
    writer.write_sample(1, np.ones(VALUES))
    writer._places[1][-1] ^= np.uint64(1)
    assert reader.read_sample() is None
    writer._places[1][-1] ^= np.uint64(1)
    assert (reader.read_sample(), reader.sample.tolist()) == (1, [1.0] * VALUES)


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
