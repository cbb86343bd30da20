"""What simulated devices measure, and faults that turn them; see dialogues/devices.txt."""

from __future__ import annotations

import math
import struct

import pytest
from tests.kit.simulated_line import Line

from dxlsim.bus.ledger import Ledger
from dxlsim.bus.simulated_bus import SimulatedBus
from dxlsim.device.device_quantities import on_the_wire
from dxlsim.faults.fault import parse_fault
from dxlsim.simulation_plan import BusConfig, DeviceConfig, DeviceReadings
from dxlwire.exceptions import InputError


def line_with(*devices: DeviceConfig, model: str = "XM430-W350") -> Line:
    line = Line(model, 1)
    for device in devices:
        line.bus.add_device(device)
    return line


def floats(line: Line, servo_id: int, count: int) -> tuple[float, ...]:
    """Return what a board of the Wolfgang has from address 36 on."""
    return struct.unpack(f"<{count}f", line.read_bytes(36, 4 * count, servo_id))


def test_states_say_what_is_measured():
    states = DeviceReadings(states={"register_1": "voltage", "register_2": "temperature"})
    line = line_with(DeviceConfig(241, "bitbots-imu"), DeviceConfig(7, "generic", shown=states))
    assert floats(line, 241, 10) == pytest.approx((0, 0, 0, 0, 0, 9.80665, 0, 0, 0, 1), abs=1e-6)
    imu = line.bus.device(241)
    imu.world.angular_velocity = (0.5, -1.0, 2.0)
    assert floats(line, 241, 3) == (0.5, -1.0, 2.0)
    imu.world.orientation = (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))
    assert imu.world.roll_pitch_yaw == pytest.approx((math.pi / 2, 0, 0))
    assert line.read_bytes(128, 4, 7) == bytes((12, 0, 25, 0))


@pytest.mark.parametrize(("axis", "seen"), [("x", 0), ("y", 1), ("z", 2)])
def test_a_device_tips_about_its_own_axis_and_stays_so(axis, seen):
    line = line_with(DeviceConfig(241, "bitbots-imu"))
    imu, tip = line.bus.device(241), f"tip servo=241 by=60deg about={axis} for=500ms"
    turn = [1.0 if index == seen else 0.0 for index in range(3)]
    line.inject(tip)
    line.wait(0.25)
    rates = floats(line, 241, 3)
    assert rates == pytest.approx([2 * math.radians(60) * each for each in turn], abs=1e-5)
    assert imu.world.roll_pitch_yaw[seen] == pytest.approx(math.radians(30), abs=0.01)
    for times in (1, 2):  # a second one begins where the first one ended
        line.wait(0.6)
        tipped = math.radians(60 * times)
        down = {
            "x": (0.0, math.sin(tipped), math.cos(tipped)),
            "y": (-math.sin(tipped), 0.0, math.cos(tipped)),
            "z": (0.0, 0.0, 1.0),
        }
        measured = floats(line, 241, 6)
        assert measured[:3] == pytest.approx([0, 0, 0], abs=1e-6)
        assert measured[3:] == pytest.approx([9.80665 * each for each in down[axis]], abs=1e-4)
        if times == 1:
            assert imu.world.roll_pitch_yaw == pytest.approx([tipped * each for each in turn], abs=1e-6)
        line.inject(tip)
    assert str(parse_fault("tip servo=241 by=-1rad")) == "tip servo=241 by=-57.29577951308232deg"


@pytest.mark.parametrize(
    ("fault", "refusal"),
    [
        ("tip servo=1 by=60deg", "tip is not possible: 1 on bus main is a servo"),
        ("turn servo=241 by=10deg", "turn is not possible: 241 on bus main is not a servo"),
        ("lose servo=5", "its servos are 1, its other devices 241"),
    ],
)
def test_faults_of_another_kind_of_unit_are_refused(fault, refusal):
    with pytest.raises(InputError, match=refusal):
        line_with(DeviceConfig(241, "bitbots-imu")).inject(fault)


def test_bits_of_one_byte_are_buttons():
    line = line_with(DeviceConfig(200, "OpenCR", shown=DeviceReadings(values={"button_start": 1.0})))
    assert line.read_bytes(30, 1, 200) == b"\x02"
    line.bus.device(200).poke("button_reset", 1)
    assert line.read_bytes(30, 1, 200) == b"\x0a"


def test_noise_is_around_the_value_and_repeats_itself():
    shown = DeviceReadings(values={"sensor_0": 40.0}, noise={"sensor_0": 2.0})
    readings = []
    for _ in range(2):
        line = line_with(DeviceConfig(101, "bitbots-foot", shown=shown))
        readings.append([floats(line, 101, 1)[0] for _ in range(400)])
    first, again = readings
    assert first == again
    mean = sum(first) / len(first)
    assert mean == pytest.approx(40.0, abs=0.4)
    spread = math.sqrt(sum((each - mean) ** 2 for each in first) / len(first))
    assert spread == pytest.approx(2.0, rel=0.15)


def test_values_end_at_the_range_of_the_item():
    gyro = line_with(DeviceConfig(200, "CM-730"), model="AX-12A").item("gyro_x", 200)
    assert [on_the_wire(gyro, value) for value in (-100.0, 0.0, 100.0, math.nan)] == [0, 512, 1023, 0]


def test_a_device_has_only_the_rates_of_its_table():
    config = BusConfig("main", 1_234_567, (), 2.0, devices=(DeviceConfig(200, "OpenCR"),))
    with pytest.raises(ValueError, match="OpenCR: no baud rate near 1234567 bit/s"):
        SimulatedBus(config, Ledger(), 0)
