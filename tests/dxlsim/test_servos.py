"""What a dialogue cannot say: settings of a simulated servo, firmware, rates and damaged instructions."""

from __future__ import annotations

import pytest
from tests.kit.simulated_line import Line

from dxlsim.servo.making import make_servo
from dxlsim.simulation_plan import ServoConfig

BACKUP, FAST_SYNC_READ, ACCESS = 0x20, 0x8A, 7


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
    ("firmware", "model"), [(51, "XL330-M288-FW51"), (52, "XL330-M288"), (None, "XL330-M288")]
)
def test_the_firmware_decides_the_control_table(firmware, model):
    servo = make_servo(ServoConfig(1, "XL330-M288", 0.0, firmware=firmware), 57_600, 0, protocol=2.0)
    assert servo.registers.table.model == model
    assert servo.registers["firmware_version"] == (firmware or 52)
