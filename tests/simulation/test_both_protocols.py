"""What servos of both protocols do alike: which answer, registered writes, another ID or rate."""

from __future__ import annotations

import pytest

from dxlrun.simulation import ServoConfig
from dxlrun.simulation.servo.making import make_servo

PING, READ, WRITE, REG_WRITE, ACTION = 1, 2, 3, 4, 5
BROADCAST = 0xFE


def test_an_id_that_is_not_there_gets_no_reply(both):
    assert both.request(9, PING) is None


@pytest.mark.parametrize(
    ("level", "ping", "read", "write"),
    [(0, True, False, False), (1, True, True, False), (2, True, True, True)],
)
def test_status_return_level(both, level, ping, read, write):
    both.request(1, WRITE, both.at("status_return_level", level))
    assert (both.request(1, PING) is not None) == ping
    assert (both.request(1, READ, both.at("present_position")) is not None) == read
    assert (both.request(1, WRITE, both.at("led", 1)) is not None) == write
    assert both.servo().registers["led"] == 1


def test_reg_write_waits_for_action(both):
    registered = "registered" if both.WORD == 1 else "registered_instruction"
    for servo_id in (1, 2):
        assert both.request(servo_id, REG_WRITE, both.at("led", 1)) == (servo_id, 0, b"")
        assert (both.get(registered, servo_id), both.get("led", servo_id)) == (1, 0)
    assert both.request(BROADCAST, ACTION) is None
    for servo_id in (1, 2):
        assert (both.get(registered, servo_id), both.get("led", servo_id)) == (0, 1)


def test_a_new_id_counts_from_the_next_instruction(both):
    assert both.request(1, WRITE, both.at("id", 9)) == (1, 0, b"")
    assert both.request(1, PING) is None
    assert both.request(9, PING) is not None


def test_a_new_baud_rate_counts_from_the_next_instruction(both):
    value, rate = (9, 200_000) if both.WORD == 1 else (4, 2_000_000)
    assert both.request(1, WRITE, both.at("baud_rate", value)) == (1, 0, b"")
    assert both.request(1, PING) is None
    both.bus.baud_rate = rate
    assert both.request(1, PING) is not None
    assert both.request(2, PING) is None


@pytest.mark.parametrize(
    ("model", "protocol", "rate", "value"),
    [
        ("AX-12A", 1.0, 1_000_000, 1),
        ("AX-12A", 1.0, 57_600, 34),
        ("AX-12A", 1.0, 117_647, 16),  # by the formula 2,000,000 / (value + 1)
        ("AX-12A", 1.0, 2_000_000, 0),
        ("XM430-W350", 2.0, 9_600, 0),
        ("XM430-W350", 2.0, 57_600, 1),
        ("XM430-W350", 2.0, 1_000_000, 3),
        ("XM430-W350", 2.0, 4_500_000, 7),
    ],
)
def test_baud_rate_register_follows_the_line(model, protocol, rate, value):
    servo = make_servo(ServoConfig(1, model, 0.0), rate, 0, protocol=protocol)
    assert servo.registers["baud_rate"] == value
    assert servo.baud_rate == pytest.approx(rate, rel=0.03)


@pytest.mark.parametrize(("model", "protocol", "rate"), [("AX-12A", 1.0, 5000), ("XM430-W350", 2.0, 500_000)])
def test_a_baud_rate_that_no_servo_has_is_refused(model, protocol, rate):
    with pytest.raises(ValueError, match=f"no baud rate near {rate}"):
        make_servo(ServoConfig(1, model, 0.0), rate, 0, protocol=protocol)
