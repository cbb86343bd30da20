"""Faults that depend on chance, on the start of the simulation, or on others; see dialogues/faults.txt."""

from __future__ import annotations

import pytest
from tests.kit.simulated_line import Line

from dxlsim.faults.fault import parse_fault
from dxlsim.faults.script import FaultScript
from dxlwire.exceptions import InputError, PortError

MS = 1_000_000


def ping(line: Line, servo_id: int = 1) -> bool:
    """Return whether a servo answers."""
    return line.request(servo_id, 0x01) == (servo_id, 0, b"")


def test_random_noise_is_that_of_the_seed():
    received = []
    for seed in (1, 1, 2):
        line = Line()
        line.inject("noise size=20", seed=seed)
        received.append(line.receive())
    assert {len(each) for each in received} == {20}
    assert received[0] == received[1] != received[2]


def test_an_unplugged_adapter_is_gone_and_comes_back():
    line = Line()
    line.inject("unplug at=1s for=2s")
    assert ping(line)
    line.clock.wait_until(1_000 * MS)
    line.bus.advance_to(1_000 * MS)
    with pytest.raises(PortError):
        line.instruct(1, 0x01)
    line.bus.advance_to(2_999 * MS)
    assert not line.bus.plugged
    line.bus.advance_to(3_000 * MS)
    assert line.bus.plugged
    assert line.faults == ["unplug at=1s for=2s"]


def test_times_count_from_the_start_of_the_simulation():
    line = Line(start_ns=7_000 * MS)
    FaultScript([parse_fault("silence servo=1 at=500ms")]).attach((line.bus,), start_ns=7_000 * MS)
    line.clock.wait_until(7_499 * MS)
    assert ping(line)
    line.clock.wait_until(7_501 * MS)
    assert not ping(line)


def test_faults_by_hand_overlap_with_those_of_the_script():
    line = Line()
    script = line.inject("silence servo=1 for=50ms")
    line.receive()
    script.add(parse_fault("silence servo=1 for=10ms"), line.clock.now_ns())
    line.receive(20 * MS)
    assert not ping(line)
    line.receive(20 * MS)
    assert ping(line)
    with pytest.raises(InputError, match="bus main has no servo 9; its servos are 1, 2"):
        script.add(parse_fault("silence servo=9"), line.clock.now_ns())


def test_a_loose_cable_may_have_contact_now_and_then_until_it_is_fixed():
    line = Line()
    line.inject("loose servo=1 low=-360deg high=360deg share=0.5 for=2s", seed=3)
    assert 30 < sum(ping(line) for _ in range(100)) < 70
    line.clock.wait_until(3_000 * MS)
    assert all(ping(line) for _ in range(30))


def test_a_lossy_line_loses_a_share_of_the_packets_of_every_servo():
    line = Line()
    line.inject("lossy share=0.2", seed=1)
    for servo_id in (1, 2):
        assert 140 < sum(ping(line, servo_id) for _ in range(200)) < 180
