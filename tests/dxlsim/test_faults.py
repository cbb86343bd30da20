"""Each kind of fault, as the host and the ledger see it, and when it happens."""

from __future__ import annotations

import math
from typing import Any

import pytest
from tests.kit.line_faults import turn_by_hand

from dxlsim.faults.fault import parse_fault
from dxlsim.faults.script import FaultScript
from dxlwire.exceptions import InputError, PortError

PING, READ, WRITE = 0x01, 0x02, 0x03
TORQUE_ENABLE, LED = 24, 25
MS = 1_000_000
PONG = {servo_id: bytes((0xFF, 0xFF, servo_id, 2, 0, ~(servo_id + 2) & 0xFF)) for servo_id in (1, 2)}
"""A ping's answer: e-Manual, Protocol 1.0, Status Packet."""


def inject(line: Any, *texts: str, seed: int = 0) -> FaultScript:
    """Hang faults on a line, now."""
    script = FaultScript([parse_fault(text) for text in texts], seed)
    script.attach((line.bus,), start_ns=0, now_ns=line.clock.now_ns())
    return script


def happened(line: Any) -> list[str]:
    return [note.removeprefix("fault: ") for note in line.notes() if note.startswith("fault: ")]


def ping(line: Any, servo_id: int = 1) -> bytes:
    """Return what the host receives after a ping."""
    line.send(servo_id, PING)
    received: bytes = line.receive()
    return received


def answered_after_ns(line: Any) -> int:
    """Return how long after a ping its answer has passed."""
    sent_ns = line.clock.now_ns()
    assert ping(line) == PONG[1]
    return int(next(e.t_ns for e in reversed(line.ledger.entries) if e.direction == "out")) - sent_ns


# Packets


def flipped(index: int, flip: int) -> bytes:
    return PONG[1][:index] + bytes((PONG[1][index] ^ flip,)) + PONG[1][index + 1 :]


@pytest.mark.parametrize(
    ("text", "received"),
    [
        ("lose servo=1", [b""]),
        ("lose servo=1 count=3", [b""] * 3),
        ("corrupt servo=1", [flipped(5, 0x01)]),
        ("corrupt servo=1 byte=2 flip=0x80", [flipped(2, 0x80)]),
        ("corrupt servo=1 byte=-6 flip=0xff", [flipped(0, 0xFF)]),
        ("corrupt servo=1 byte=99", [flipped(5, 0x01)]),
        ("corrupt servo=1 byte=-99", [flipped(0, 0x01)]),
        ("truncate servo=1 keep=4", [PONG[1][:4]]),
        ("duplicate servo=1", [PONG[1] * 2]),
        ("duplicate servo=1 copies=4", [PONG[1] * 4]),
        ("silence servo=1 packet=2", [PONG[1], PONG[1], b"", b""]),
        ("lose servo=1 at=15ms", [PONG[1], PONG[1], b""]),
    ],
)
def test_the_next_replies_of_a_servo_are_spoilt_and_it_is_noted_once(line, text, received):
    script = inject(line, text)
    if text.startswith("lose servo=1 count"):
        assert ping(line, 2) == PONG[2]  # another servo's is not touched, and nothing happened
        assert (happened(line), [str(fault) for fault in script.waiting]) == ([], [text])
    assert [ping(line) for _ in received] == received
    assert ping(line) == (b"" if text.startswith("silence") else PONG[1])
    assert happened(line) == [text]


def test_a_servo_whose_reply_is_lost_has_obeyed(line):
    inject(line, "lose servo=1")
    line.send(1, WRITE, LED, 1)
    assert line.receive() == b""
    assert line.servo(1).registers["led"] == 1


@pytest.mark.parametrize("text", ["lose from=host", "corrupt from=host byte=6"])
def test_a_spoilt_instruction_is_not_obeyed(line, text):
    inject(line, text)
    line.send(1, WRITE, LED, 1)
    line.receive()
    assert line.servo(1).registers["led"] == 0
    assert ping(line) == PONG[1]
    assert happened(line) == [text]


def test_replies_come_later_one_of_them_or_all_for_a_time(line):
    usual_ns = answered_after_ns(line)
    inject(line, "delay servo=1 by=5ms")
    assert answered_after_ns(line) == usual_ns + 5 * MS
    assert answered_after_ns(line) == usual_ns
    inject(line, "slow servo=1 by=700us for=100ms")
    assert [answered_after_ns(line) for _ in range(3)] == [usual_ns + 700_000] * 3
    line.receive(100 * MS)
    assert answered_after_ns(line) == usual_ns
    assert happened(line) == ["delay servo=1 by=5ms", "slow servo=1 by=700us for=100ms"]


# The line


def test_noise_comes_between_the_packets(line):
    inject(line, "noise data=ff00fd")
    assert line.receive() == b"\xff\x00\xfd"
    assert ping(line) == PONG[1]
    assert happened(line) == ["noise data=ff00fd"]


def test_random_noise_is_that_of_the_seed(make_line):
    received = []
    for seed in (1, 1, 2):
        line = make_line()
        inject(line, "noise size=20", seed=seed)
        received.append(line.receive())
    assert {len(each) for each in received} == {20}
    assert received[0] == received[1] != received[2]


def test_a_babbling_servo_talks_until_its_time_is_over_and_spoils_what_the_host_sends(line):
    inject(line, "babble servo=1 size=4 every=1ms for=10ms")
    assert len(line.receive(20 * MS)) == 40
    assert line.receive(20 * MS) == b""
    inject(line, "babble servo=1 size=100 every=1ms for=50ms")
    line.receive(MS // 2)
    line.send(2, WRITE, LED, 1)
    line.receive(100 * MS)
    assert line.servo(2).registers["led"] == 0
    assert any("collision" in note for note in line.notes())


def test_an_unplugged_adapter_is_gone_and_comes_back(line):
    inject(line, "unplug at=1s for=2s")
    assert ping(line) == PONG[1]
    line.clock.wait_until(1_000 * MS)
    line.bus.advance_to(1_000 * MS)
    with pytest.raises(PortError):
        line.send(1, PING)
    line.bus.advance_to(2_999 * MS)
    assert not line.bus.plugged
    line.bus.advance_to(3_000 * MS)
    assert line.bus.plugged
    assert happened(line) == ["unplug at=1s for=2s"]


# Servos


@pytest.mark.parametrize(
    ("text", "silent", "torque"),
    [
        ("silence servo=1 for=50ms", {1}, [1, 1]),
        ("reboot servo=1 for=50ms", {1}, [0, 1]),
        ("brownout for=50ms", {1, 2}, [0, 0]),
        ("wedge for=50ms", {1, 2}, [1, 1]),
    ],
)
def test_who_is_cut_off_is_back_after_its_time_without_its_ram_if_it_lost_power(line, text, silent, torque):
    for servo_id in (1, 2):
        line.write(servo_id, TORQUE_ENABLE, 1)
    inject(line, text)
    assert {servo_id for servo_id in (1, 2) if ping(line, servo_id) == b""} == silent
    line.receive(50 * MS)
    assert [line.read(servo_id, TORQUE_ENABLE, 1) for servo_id in (1, 2)] == torque
    assert happened(line) == [text]


def test_a_servo_is_silent_until_the_last_of_two_faults_ends(line):
    inject(line, "silence servo=1 at=0s for=20ms", "silence servo=1 at=10ms for=50ms")
    line.receive(40 * MS)
    assert ping(line) == b""
    line.receive(20 * MS)
    assert ping(line) == PONG[1]
    assert len(happened(line)) == 2


def test_a_servo_that_was_not_read_for_long_reboots_at_the_time_of_the_fault(line2):
    inject(line2, "reboot servo=1 at=1s")
    line2.wait(2.0)
    assert line2.get("realtime_tick", 1) == pytest.approx(1000, abs=15)


def test_after_a_brown_out_a_servo_counts_its_time_from_when_the_power_is_back(line2):
    inject(line2, "brownout servo=1 at=1s for=500ms")
    line2.wait(2.0)
    assert line2.get("realtime_tick", 1) == pytest.approx(500, abs=5)
    assert line2.get("realtime_tick", 2) == pytest.approx(2000, abs=15)


def test_a_wrong_voltage_is_an_error_as_long_as_it_lasts(line):
    inject(line, "voltage servo=1 volts=5.1 for=50ms")
    for wrong in (0x01, 0):  # e-Manual, Protocol 1.0, Error: bit 0, Input Voltage
        answer = line.ask(1, PING)
        assert answer.error == wrong
        line.receive(60 * MS)
    assert line.read(1, 42, 1) == 120
    assert happened(line) == ["voltage servo=1 volts=5.1 for=50ms"]


def test_two_wrong_voltages_leave_the_one_that_was_before(line):
    inject(line, "voltage volts=5 at=0s for=20ms", "voltage servo=1 volts=20 at=10ms for=50ms")
    line.receive(100 * MS)
    assert [line.read(servo_id, 42, 1) for servo_id in (1, 2)] == [120, 120]


def test_an_overloaded_servo_reports_it(line):
    inject(line, "overload servo=1")
    answer = line.ask(1, PING)
    assert answer.error == 0x20  # e-Manual, Protocol 1.0, Error: bit 5, Overload
    assert line.ask(2, PING).error == 0
    assert happened(line) == ["overload servo=1"]


def test_a_hot_servo_of_protocol_2_switches_off_and_reports_it(line2):
    line2.set("torque_enable", 1)
    inject(line2, "overheat servo=1")
    answer = line2.request(1, PING)
    assert answer.error == 0x80  # e-Manual, Protocol 2.0, Error: Alert
    assert line2.get("hardware_error_status") == 0x04  # e-Manual, XM430-W350: bit 2, OverHeating
    assert line2.get("torque_enable") == 0
    assert happened(line2) == ["overheat servo=1"]


@pytest.mark.parametrize(("model", "by"), [("XM430-W350", 30.0), ("XL430-W250", -90.0), ("XL-320", 20.0)])
def test_a_hand_turns_a_limp_shaft_evenly(make_line2, model, by):
    line2 = make_line2((1, 2), model)
    inject(line2, f"turn servo=1 by={by:g}deg for=1s")
    line2.wait(0.5)
    assert math.degrees(line2.servo(1).shaft_angle - 2.0) == pytest.approx(by / 2, rel=0.02)
    assert math.degrees(line2.servo(1).velocity) == pytest.approx(by)
    name = "present_speed" if model == "XL-320" else "present_velocity"
    shown = line2.get(name) * line2.servo(1).registers.table.rad_s_per_tick
    assert math.degrees(shown) == pytest.approx(by, abs=1.0)
    line2.wait(2.0)
    assert math.degrees(line2.servo(1).shaft_angle - 2.0) == pytest.approx(by)
    assert line2.servo(1).velocity == 0.0
    assert line2.get("present_position") * line2.servo(1).registers.table.rad_per_tick == pytest.approx(
        line2.servo(1).shaft_angle, abs=0.005
    )
    assert line2.servo(2).shaft_angle == 2.0
    assert happened(line2) == [f"turn servo=1 by={by:g}deg for=1s"]


@pytest.mark.parametrize(("mode", "goal"), [(3, None), (4, None), (5, None), (1, None), (0, 100), (16, 100)])
def test_a_hand_gives_way_to_a_servo_with_torque(line2, mode, goal):
    line2.put(operating_mode=mode, torque_enable=1)
    if goal is not None:
        line2.set("goal_current" if mode == 0 else "goal_pwm", goal)
    line2.wait(0.1)
    before = line2.servo(1).shaft_angle
    inject(line2, "turn servo=1 by=-30deg")
    line2.wait(0.5)
    moved = line2.servo(1).shaft_angle - before
    assert moved == pytest.approx(0.0, abs=0.002) if goal is None else moved > 0.01
    way = "servo 1: turned by hand only 0.0 of -30 deg, because the servo has torque"
    assert way in line2.notes()


@pytest.mark.parametrize(("mode", "name"), [(0, "goal_current"), (16, "goal_pwm")])
def test_a_hand_turns_a_shaft_whose_servo_is_commanded_to_no_torque(line2, mode, name):
    line2.put(operating_mode=mode, torque_enable=1)
    assert line2.get(name) == 0
    inject(line2, "turn servo=1 by=30deg")
    line2.wait(1.5)
    assert math.degrees(line2.servo(1).shaft_angle - 2.0) == pytest.approx(30.0, abs=0.1)


def test_torque_that_comes_on_midway_ends_the_turning(line):
    inject(line, "turn servo=1 by=30deg for=1s at=0s")
    line.clock.wait_until(500 * MS)
    line.write(1, 30, *line.servo(1).registers.data("present_position"))  # the goal where it is: torque on
    line.clock.wait_until(2000 * MS)
    assert math.degrees(line.servo(1).shaft_angle - 2.0) == pytest.approx(15.0, abs=1.0)
    (way,) = [note for note in line.notes() if "turned by hand" in note]
    assert way.startswith("servo 1: turned by hand only 15.")


def test_a_servo_that_lost_its_power_is_still_turned(line2):
    inject(line2, "turn servo=1 by=30deg for=1s", "reboot servo=1 at=500ms")
    line2.wait(1.5)
    assert math.degrees(line2.servo(1).shaft_angle - 2.0) == pytest.approx(30.0)


def test_two_servos_with_one_id_talk_at_once(line):
    inject(line, "duplicate_id servo=1")
    line.write(2, LED, 1)
    twins = [servo for servo in line.bus.servos if servo.servo_id == 1]
    assert len(twins) == 2
    twins[1].poke("led", 1)
    line.send(1, READ, LED, 1)
    line.receive()
    assert any("collision" in note for note in line.notes())
    assert happened(line) == ["duplicate_id servo=1"]


# When


def test_times_count_from_the_start_of_the_simulation(make_line):
    line = make_line(start_ns=7_000 * MS)
    FaultScript([parse_fault("silence servo=1 at=500ms")]).attach((line.bus,), start_ns=7_000 * MS)
    line.clock.wait_until(7_499 * MS)
    assert ping(line) == PONG[1]
    line.clock.wait_until(7_501 * MS)
    assert ping(line) == b""


def test_a_fault_by_hand_happens_now(line):
    line.clock.wait_until(5_000 * MS)
    inject(line, "silence servo=1")
    assert ping(line) == b""
    (noted,) = (entry for entry in line.ledger.entries if entry.note == "fault: silence servo=1")
    assert noted.t_ns == 5_000 * MS


def test_faults_by_hand_overlap_with_those_of_the_script(line):
    script = inject(line, "silence servo=1 for=50ms")
    line.receive()
    script.add(parse_fault("silence servo=1 for=10ms"), line.clock.now_ns())
    line.receive(20 * MS)
    assert ping(line) == b""
    line.receive(20 * MS)
    assert ping(line) == PONG[1]
    with pytest.raises(InputError, match="bus main has no servo 9; its servos are 1, 2"):
        script.add(parse_fault("silence servo=9"), line.clock.now_ns())


# What lasts: cables, replies, shafts, supplies, adapters


def test_a_loose_cable_has_no_contact_within_its_angles(line):
    inject(line, "loose servo=1 low=100deg high=120deg")
    heard = []
    for angle in (99.0, 101.0, 119.0, 121.0):
        turn_by_hand(line.servo(1), math.radians(angle))
        heard.append(ping(line) == PONG[1])
    assert heard == [True, False, False, True]
    assert ping(line, 2) == PONG[2]


def test_a_loose_cable_may_have_contact_now_and_then_until_it_is_mended(line):
    inject(line, "loose servo=1 low=-360deg high=360deg share=0.5 for=2s", seed=3)
    heard = [ping(line) for _ in range(100)]
    assert 30 < heard.count(b"") < 70
    line.clock.wait_until(3_000 * MS)
    assert all(ping(line) == PONG[1] for _ in range(30))


def test_a_lossy_line_loses_a_share_of_the_packets_of_every_servo(line):
    inject(line, "lossy share=0.2", seed=1)
    for servo_id in (1, 2):
        heard = [ping(line, servo_id) for _ in range(200)]
        assert 20 < heard.count(b"") < 60


def test_a_blocked_shaft_stays_until_it_is_free(line):
    servo = line.servo(1)
    line.send(1, WRITE, TORQUE_ENABLE, 1)
    line.receive(20 * MS)
    before = servo.shaft_angle
    inject(line, "jam servo=1 for=300ms")
    line.send(1, WRITE, 30, 100, 3)
    line.receive(250 * MS)
    line.bus.advance_to(line.clock.now_ns())
    assert servo.shaft_angle == pytest.approx(before, abs=1e-3)
    line.receive(2_000 * MS)
    line.bus.advance_to(line.clock.now_ns())
    assert abs(servo.shaft_angle - before) > 0.1


def test_a_supply_with_a_resistance_sags_for_all_when_one_draws(line):
    first, other = line.servo(1), line.servo(2)
    before = other.voltage
    inject(line, "sag ohms=2 for=400ms")
    line.send(1, WRITE, TORQUE_ENABLE, 1)
    line.receive(20 * MS)
    line.send(1, WRITE, 30, 100, 3)
    line.receive(100 * MS)
    assert other.voltage < before - 0.05
    assert first.voltage == other.voltage
    line.receive(1_000 * MS)
    assert other.voltage == before


def test_an_adapter_with_a_latency_timer_keeps_replies_back(line):
    inject(line, "timer by=8ms for=50ms")
    line.send(1, PING)
    assert line.receive(4 * MS) == b""
    assert line.receive(8 * MS) == PONG[1]
    line.clock.wait_until(200 * MS)
    line.receive(MS)
    line.send(1, PING)
    assert line.receive(4 * MS) == PONG[1]
