"""What a dialogue cannot say: settings of a simulated servo, firmware, rates and damaged instructions."""

from __future__ import annotations

import pytest
from tests.kit.simulated_line import Line

from dxlsim.servo.making import make_servo
from dxlsim.simulation_plan import ServoConfig

BACKUP, FAST_SYNC_READ, ACCESS = 0x20, 0x8A, 7
BACK_UP = bytes.fromhex("01 4354524c")
"""An instruction with a wrong checksum, and the error of its answer."""


@pytest.mark.parametrize(("model", "most_ns"), [("AX-12A", 100_000_000), ("XM430-W350", 1_500_000)])
def test_a_pause_inside_an_instruction_ends_it(model, most_ns):
    line = Line(model)
    ping, at_ns = line.packet(1, 1), 0
    for pause_ns, answered in ((most_ns, True), (most_ns + 1, False)):
        line.bus.receive_bytes(ping[:3], at_ns)
        line.bus.receive_bytes(ping[3:], at_ns + 30_000 + pause_ns)
        at_ns += 10**9
        assert (line.bus.drain_bytes(at_ns) != b"") == answered
    assert line.notes == ["incomplete instruction of 3 bytes discarded"]


@pytest.mark.parametrize(
    ("model", "protocol", "rate", "value"),
    [
        ("AX-12A", 1.0, 1_000_000, 1),
        ("AX-12A", 1.0, 57_600, 34),
        ("AX-12A", 1.0, 117_647, 16),  # by the formula 2,000,000 / (value + 1)
        ("AX-12A", 1.0, 2_000_000, 0),
        ("AX-12A", 1.0, 5000, None),
        ("XM430-W350", 2.0, 9_600, 0),
        ("XM430-W350", 2.0, 57_600, 1),
        ("XM430-W350", 2.0, 1_000_000, 3),
        ("XM430-W350", 2.0, 4_500_000, 7),
        ("XM430-W350", 2.0, 500_000, None),
    ],
)
def test_baud_rate_register_follows_the_line_or_no_servo_has_it(model, protocol, rate, value):
    config = ServoConfig(1, model, 0.0)
    if value is None:
        with pytest.raises(ValueError, match=f"no baud rate near {rate}"):
            make_servo(config, rate, 0, protocol=protocol)
        return
    servo = make_servo(config, rate, 0, protocol=protocol)
    assert servo.registers["baud_rate"] == value
    assert servo.baud_rate == pytest.approx(rate, rel=0.03)


def test_waking_by_a_goal_can_be_switched_off():
    line = Line()
    line.servo().wakes_on_goal = False
    line.put(goal_position=700)
    line.wait(2)
    assert (line.get("torque_enable"), line.servo().shaft_angle) == (0, 2.0)
    line.put(torque_enable=1)  # and then it moves to the goal that is there
    line.wait(2)
    assert line.get("present_position") == pytest.approx(700, abs=2)


@pytest.mark.parametrize(
    ("model", "firmware", "backs_up", "reads_fast"),
    [
        ("XM430-W350", 44, False, False),
        ("XM430-W350", 45, True, True),
        ("XL330-M288", 45, False, False),
        ("XL330-M288", 46, True, True),
        ("XL330-M288", 52, True, True),
        ("PH54-200-S500", 11, False, False),
        ("PH54-200-S500", 12, True, True),
        ("2XL430-W250", 44, False, False),
        ("2XL430-W250", 45, True, False),
        ("MX-64", 45, False, False),
        ("XL-320", 45, False, False),
    ],
)
def test_backup_and_fast_reads_came_with_a_firmware(model, firmware, backs_up, reads_fast):
    line = Line(model, 1, protocol=2.0, firmware=firmware)
    assert line.request(1, BACKUP, BACK_UP) == ((1, 0, b"") if backs_up else (1, 2, b""))
    line.instruct(0xFE, FAST_SYNC_READ, bytes.fromhex("0000 0200 01"))
    assert bool(line.receive()) == reads_fast


@pytest.mark.parametrize(
    ("model", "firmware"), [("XM430-W350", 44), ("2XC430-W250", 44), ("XC330-T288", 45), ("MX-106", 60)]
)
def test_startup_configuration_came_with_a_firmware(model, firmware):
    line = Line(model, 1, protocol=2.0, firmware=firmware)
    assert "startup_configuration" not in line.servo().registers
    assert line.write_bytes(60, b"\x01") == ACCESS
    line.servo().power_cycle()
    assert line.get("torque_enable") == 0


@pytest.mark.parametrize(
    ("firmware", "model"), [(51, "XL330-M288-FW51"), (52, "XL330-M288"), (None, "XL330-M288")]
)
def test_the_firmware_decides_the_control_table(firmware, model):
    servo = make_servo(ServoConfig(1, "XL330-M288", 0.0, firmware=firmware), 57_600, 0, protocol=2.0)
    assert servo.registers.table.model == model
    assert servo.registers["firmware_version"] == (firmware or 52)
