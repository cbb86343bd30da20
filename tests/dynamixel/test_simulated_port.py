"""Deadlines of simulated servos: extended only as far as their process proves that it did not run."""

from __future__ import annotations

import os
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest

from dxlrun.channels.heartbeat import (
    LineProgress,
    SimulationProgress,
    create_progress,
)
from dxlrun.run.guardian import make_ports
from dxlwire.bus_plan import SIMULATED
from dxlwire.port.ports import LONGEST_STALL_NS, SerialPort, SimulatedPort, StallCounter

MS = 1_000_000
ENDLESS_NS = 1 << 62  # nothing is due to the host
SENT = 1_000 * MS  # when the request is off the wire
DEADLINE = SENT + 12 * MS


@pytest.fixture
def memory() -> Iterator[int]:
    descriptor = create_progress(2)
    yield descriptor
    os.close(descriptor)


@pytest.fixture
def simulation(memory: int) -> LineProgress:
    """The simulation's side of a line."""
    return SimulationProgress(memory).line(1)


def publish_received(line: LineProgress, off_wire_ns: int) -> None:
    line.words[0] = off_wire_ns


def publish_served(line: LineProgress, until_ns: int) -> None:
    line.words[1] = until_ns


def publish_delivery(line: LineProgress, due_ns: int, now_ns: int) -> None:
    line.words[3], line.words[2] = due_ns, now_ns


@pytest.fixture
def stalls() -> StallCounter:
    return StallCounter()


@pytest.fixture
def port(memory: int, stalls: StallCounter) -> Iterator[SimulatedPort]:
    ours, theirs = os.pipe()
    yield SimulatedPort(ours, "sim", SimulationProgress(memory).line(1), stalls)
    os.close(ours)
    os.close(theirs)


def extended(port: SerialPort, now: int, heard: int = 0) -> int:
    return port.extend_deadline(DEADLINE, SENT, heard, now)


def test_request_that_was_not_taken_is_awaited(port, simulation):
    publish_received(simulation, SENT - 1)
    publish_served(simulation, ENDLESS_NS)
    assert extended(port, DEADLINE) == DEADLINE + MS


def test_deadline_counts_from_when_the_request_was_taken(port, simulation):
    publish_served(simulation, SENT + 100 * MS)
    publish_received(simulation, SENT + 100 * MS)
    assert extended(port, SENT + 101 * MS) > SENT + 101 * MS
    publish_served(simulation, ENDLESS_NS)  # nothing is due any more: the servo is silent on purpose
    assert extended(port, SENT + 102 * MS) <= SENT + 102 * MS


def test_each_simulated_bus_has_its_own_progress(memory, simulation, stalls):
    ours, theirs = os.pipe()
    buses: Any = [SimpleNamespace(port=SIMULATED)] * 2
    lines: Any = SimpleNamespace(simulation=memory)
    first, second = make_ports(buses, ("one", "two"), (ours, theirs), lines, stalls)
    publish_served(simulation, ENDLESS_NS)
    publish_received(simulation, SENT + MS // 10)
    assert extended(second, DEADLINE) <= DEADLINE < extended(first, DEADLINE)
    os.close(ours)
    os.close(theirs)


def test_silent_servo_of_a_running_process_is_given_up_at_once(port, simulation, stalls):
    publish_served(simulation, ENDLESS_NS)
    publish_received(simulation, SENT + MS // 10)
    assert extended(port, DEADLINE) <= DEADLINE
    assert (stalls.times, stalls.waited_ns) == (0, 0)


def test_reply_that_is_late_on_purpose_is_given_up_at_once(port, simulation):
    """A latency timer of 16 ms: the process sleeps until the reply is due, which is behind the deadline."""
    publish_served(simulation, SENT + 16 * MS)
    publish_received(simulation, SENT)
    assert extended(port, DEADLINE) <= DEADLINE


def test_reply_that_was_due_and_was_not_handed_over_is_awaited(port, simulation):
    publish_served(simulation, SENT + MS)  # when the reply is due; the process has not run since
    publish_received(simulation, SENT)
    assert extended(port, DEADLINE) > DEADLINE


def test_bytes_that_the_kernel_still_has_are_awaited(port, simulation):
    publish_received(simulation, SENT)
    publish_delivery(simulation, SENT + MS, SENT + 11 * MS)
    publish_served(simulation, ENDLESS_NS)
    assert extended(port, DEADLINE, heard=SENT - MS) > DEADLINE
    assert extended(port, DEADLINE, heard=SENT + 11 * MS) <= DEADLINE


def test_wait_is_bounded_and_not_repeated_for_the_same_stall(port, simulation):
    assert extended(port, SENT + LONGEST_STALL_NS - MS // 2) == SENT + LONGEST_STALL_NS
    late = SENT + LONGEST_STALL_NS
    assert extended(port, late) <= late
    later, sent = late + 100 * MS, late + 80 * MS
    assert port.extend_deadline(sent + 12 * MS, sent, 0, later) <= later
    publish_received(simulation, late)  # the process runs again
    assert port.extend_deadline(sent + 12 * MS, sent, 0, later) > later


def test_waits_of_several_lines_count_once():
    stalls = StallCounter()
    for begin in (100, 101, 102):
        for _line in range(3):
            stalls.count(begin * MS, (begin + 1) * MS)
    stalls.count(200 * MS, 201 * MS)
    assert (stalls.times, stalls.waited_ns) == (2, 4 * MS)
    stalls.count(203 * MS, 204 * MS)  # the same wait goes on, after a wake-up that was late
    assert (stalls.times, stalls.waited_ns) == (2, 7 * MS)


def test_real_port_never_extends_a_deadline(port):
    real = SerialPort(port.descriptor, "/dev/ttyUSB0")
    assert extended(real, DEADLINE) == DEADLINE
    assert (real.late_ns(0, 9), real.stalled_ns(0, 9)) == (0, 0)


def test_late_reply_is_split_into_what_its_process_was_late(port, simulation):
    publish_received(simulation, SENT + 5 * MS)
    publish_delivery(simulation, SENT + 6 * MS, SENT + 9 * MS)
    assert port.late_ns(SENT, SENT + 10 * MS) == (5 + 4) * MS


def test_stalls_count_as_far_as_they_overlap(memory, port):
    progress = SimulationProgress(memory)
    for second in range(20):  # more than are kept
        progress.note_stall(second * 1_000 * MS, (second * 1_000 + 100) * MS)
    assert port.stalled_ns(18_050 * MS, 19_050 * MS) == (50 + 50) * MS
    assert port.stalled_ns(18_200 * MS, 18_900 * MS) == 0
    assert port.stalled_ns(0, 2_000 * MS) == 0  # forgotten


def test_port_of_a_line_that_is_back_keeps_its_progress(port, simulation):
    publish_received(simulation, SENT - 1)
    assert extended(port.renewed(), DEADLINE) > DEADLINE
