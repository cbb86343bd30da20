"""Simulated devices: their registers on the line, what they show, which instructions and faults they know."""

from __future__ import annotations

import math
import struct

import pytest

from dxlsim.bus.ledger import Ledger
from dxlsim.bus.simulated_bus import SimulatedBus
from dxlsim.device.device_quantities import on_the_wire
from dxlsim.faults.fault import parse_fault
from dxlsim.faults.script import FaultScript
from dxlsim.simulation_plan import BusConfig, DeviceConfig, DeviceReadings
from dxlwire.exceptions import InputError

PING, READ, WRITE, REBOOT, SYNC_READ, SYNC_WRITE = 0x01, 0x02, 0x03, 0x08, 0x82, 0x83
FAST_SYNC_READ, BULK_READ = 0x8A, 0x92


@pytest.fixture
def line(make_line2, make_line):
    """Return a function that makes a line of one servo, ID 1, and some devices."""

    def make(*devices: DeviceConfig, protocol: float = 2.0):
        line = make_line((1,)) if protocol == 1.0 else make_line2((1,))
        for device in devices:
            line.bus.add_device(device)
        return line

    return make


def inject(wire, text: str) -> str:
    """Let a fault happen now; return its line."""
    script = FaultScript([fault := parse_fault(text)])
    script.attach((wire.bus,), now_ns=wire.clock.now_ns())
    wire.wait(0.001)
    return str(fault)


def words(*values: int) -> bytes:
    return b"".join(value.to_bytes(2, "little") for value in values)


def test_a_device_answers_ping_read_and_write(line):
    wire = line(DeviceConfig(200, "OpenCR"))
    assert wire.request(200, PING).parameters == words(0x7400) + b"\x02"
    assert wire.read_bytes(200, 31, 1) == bytes((120,)), "12 V of the supply"
    assert wire.read_bytes(200, 32, 12) == words(0, 0, 0, 0, 0, 16384), "gravity along z"
    assert wire.write_bytes(200, 25, b"\x05") == 0
    assert wire.read_bytes(200, 25, 1) == b"\x05"


def test_writes_are_refused_as_of_servos(line):
    wire = line(DeviceConfig(200, "OpenCR"))
    assert wire.write_bytes(200, 25, b"\x08") == 4, "data range"
    assert wire.write_bytes(200, 30, b"\x01") == 7, "access: a button"
    assert wire.write_bytes(200, 26, b"\x01") == 5, "data length: half of an item"
    assert wire.write_bytes(200, 6, b"\x01") == 7, "access: no item"
    assert wire.read_bytes(200, 25, 2) == b"\x00\x00"
    refused = [note for note in wire.notes() if note.startswith("device 200 refuses 0x03 19 00 08: ")]
    assert len(refused) == 1


def test_protocol_1_has_its_own_errors(line):
    wire = line(DeviceConfig(200, "CM-730"), DeviceConfig(112, "OP-FSR"), protocol=1.0)
    assert wire.ask(200, PING).error == 0
    assert wire.ask(200, READ, 0, 3).parameters == words(29440) + b"\x01"
    assert wire.read(200, 50, 1) == 120
    assert wire.read(200, 48, 2) == 640, "1 g of 4 g, around 512"
    assert wire.write(200, 25, 8) == 0x08, "range error"
    assert wire.write(200, 25, 7) == 0
    assert wire.write(200, 50, 1) == 0x08, "range error: a voltage is only read"
    assert wire.ask(112, 0x04, 25, 1) is None, "it knows no reg write"


def test_boards_of_the_slave_class_answer_no_group_instruction(line):
    wire = line(DeviceConfig(241, "bitbots-imu"), DeviceConfig(200, "OpenCR"))
    read = words(0, 2) + bytes((200, 241))
    wire.instruct(0xFE, SYNC_READ, read)
    assert [answer.servo_id for answer in wire.statuses()] == [200], "those after it would wait in vain"
    wire.instruct(0xFE, PING)
    assert [answer.servo_id for answer in wire.statuses(1_000_000_000)] == [1, 200]
    wire.instruct(241, REBOOT)
    assert wire.statuses() == []
    wire.instruct(0xFE, SYNC_WRITE, words(10, 1) + bytes((241, 9)))
    assert wire.read_bytes(241, 10, 1) == b"\x00"


def test_a_device_takes_part_in_group_reads_with_servos(line):
    wire = line(DeviceConfig(7, "generic", shown=DeviceReadings(values={"register_1": 513.0})))
    wire.instruct(0xFE, SYNC_READ, words(128, 2) + bytes((7,)))
    (answer,) = wire.statuses()
    assert answer.parameters == words(513)
    wire.instruct(0xFE, BULK_READ, bytes((1,)) + words(144, 2) + bytes((7,)) + words(128, 4))
    assert [(each.servo_id, len(each.parameters)) for each in wire.statuses()] == [(1, 2), (7, 4)]
    wire.instruct(0xFE, SYNC_WRITE, words(130, 2) + bytes((7,)) + words(77))
    assert wire.read_bytes(7, 130, 2) == words(77)


def test_a_board_that_chains_waits_for_the_servo_ahead_until_the_line_is_silent(line):
    """ROBOTIS' OpenCR firmware: each other status restarts its 50 ms, so reads of servos keep it deaf."""
    wire = line(DeviceConfig(200, "OpenCR"))

    def answers(instruction: int, parameters: bytes, servo_id: int = 0xFE) -> list[int]:
        wire.instruct(servo_id, instruction, parameters)
        return [answer.servo_id for answer in wire.statuses()]

    chain = bytes((1,)) + words(132, 4) + bytes((200,)) + words(31, 1)
    assert answers(BULK_READ, chain) == [1, 200]
    assert answers(PING, b"", 200) == [200], "the servo ahead has answered"
    chain = bytes((9,)) + words(132, 4) + bytes((200,)) + words(31, 1)
    assert answers(BULK_READ, chain) == []
    for _ in range(20):  # 20 ms each
        assert answers(PING, b"", 1) == [1]
        assert answers(PING, b"", 200) == []
    wire.receive(25_000_000)
    assert answers(PING, b"", 200) == []
    assert answers(PING, b"", 200) == [200]
    assert answers(BULK_READ, bytes((200,)) + words(31, 1) + bytes((9,)) + words(0, 1)) == [200]
    assert answers(PING, b"", 200) == [200], "it was the first, so it waits for nothing"


def test_states_say_what_is_measured(line):
    wire = line(
        DeviceConfig(241, "bitbots-imu"),
        DeviceConfig(
            7, "generic", shown=DeviceReadings(states={"register_1": "voltage", "register_2": "temperature"})
        ),
    )
    shown = struct.unpack("<10f", wire.read_bytes(241, 36, 40))
    assert shown == pytest.approx((0, 0, 0, 0, 0, 9.80665, 0, 0, 0, 1), abs=1e-6)
    imu = wire.bus.device(241)
    imu.world.angular_velocity = (0.5, -1.0, 2.0)
    assert struct.unpack("<3f", wire.read_bytes(241, 36, 12)) == (0.5, -1.0, 2.0)
    imu.world.orientation = (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))
    assert imu.world.roll_pitch_yaw == pytest.approx((math.pi / 2, 0, 0))
    assert wire.read_bytes(7, 128, 4) == words(12, 25)


@pytest.mark.parametrize(("axis", "seen"), [("x", 0), ("y", 1), ("z", 2)])
def test_a_device_tips_about_its_own_axis_and_stays_so(line, axis, seen):
    wire = line(DeviceConfig(241, "bitbots-imu"))
    imu = wire.bus.device(241)

    def read() -> tuple[list[float], list[float], tuple[float, float, float]]:
        values = struct.unpack("<10f", wire.read_bytes(241, 36, 40))
        return [*values[:3]], [*values[3:6]], imu.world.roll_pitch_yaw

    turn = [1.0 if index == seen else 0.0 for index in range(3)]
    inject(wire, f"tip servo=241 by=60deg about={axis} for=500ms")
    wire.wait(0.25)
    rates, _, angles = read()
    assert rates == pytest.approx([2 * math.radians(60) * each for each in turn], abs=1e-5)
    assert angles[seen] == pytest.approx(math.radians(30), abs=0.01)
    for times in (1, 2):  # a second one begins where the first one ended
        wire.wait(0.6)
        rates, pull, angles = read()
        tipped = math.radians(60 * times)
        down = {
            "x": (0.0, math.sin(tipped), math.cos(tipped)),
            "y": (-math.sin(tipped), 0.0, math.cos(tipped)),
            "z": (0.0, 0.0, 1.0),
        }
        assert rates == pytest.approx([0, 0, 0], abs=1e-6)
        assert pull == pytest.approx([9.80665 * each for each in down[axis]], abs=1e-4)
        if times == 1:
            assert angles == pytest.approx([tipped * each for each in turn], abs=1e-6)
        inject(wire, f"tip servo=241 by=60deg about={axis} for=500ms")
    with pytest.raises(InputError, match="tip is not possible: 1 on bus main is a servo"):
        inject(wire, "tip servo=1 by=60deg")
    assert str(parse_fault("tip servo=241 by=-1rad")) == "tip servo=241 by=-57.29577951308232deg"


def test_bits_of_one_byte_are_buttons(line):
    wire = line(DeviceConfig(200, "OpenCR", shown=DeviceReadings(values={"button_start": 1.0})))
    assert wire.read_bytes(200, 30, 1) == b"\x02"
    wire.bus.device(200).poke("button_reset", 1)
    assert wire.read_bytes(200, 30, 1) == b"\x0a"


def test_noise_is_around_the_value_and_repeats_itself(make_line2):
    config = DeviceConfig(
        101, "bitbots-foot", shown=DeviceReadings(values={"sensor_0": 40.0}, noise={"sensor_0": 2.0})
    )

    def readings() -> list[float]:
        wire = make_line2((1,))
        wire.bus.add_device(config)
        return [struct.unpack("<f", wire.read_bytes(101, 36, 4))[0] for _ in range(400)]

    first = readings()
    assert first == readings()
    mean = sum(first) / len(first)
    spread = math.sqrt(sum((each - mean) ** 2 for each in first) / len(first))
    assert mean == pytest.approx(40.0, abs=0.4)
    assert spread == pytest.approx(2.0, rel=0.15)


def test_values_end_at_the_range_of_the_item(line):
    gyro = line(DeviceConfig(200, "CM-730"), protocol=1.0).bus.device(200).table.items["gyro_x"]
    assert [on_the_wire(gyro, value) for value in (-100.0, 0.0, 100.0, math.nan)] == [0, 512, 1023, 0]


def test_faults_happen_to_devices_too(line):
    wire = line(DeviceConfig(241, "bitbots-imu"))
    inject(wire, "silence servo=241 for=50ms")
    assert wire.request(241, PING) is None
    wire.wait(0.1)
    assert wire.request(241, PING) is not None
    inject(wire, "other_model servo=241 number=7")
    assert wire.request(241, PING).parameters[:2] == words(7)
    inject(wire, "lose servo=241")
    assert wire.request(241, PING) is None
    wire.write_bytes(241, 10, b"\x09")
    inject(wire, "reboot servo=241 for=50ms")
    wire.wait(0.1)
    assert wire.read_bytes(241, 10, 1) == b"\x00", "RAM is lost"
    with pytest.raises(InputError, match="turn is not possible: 241 on bus main is not a servo"):
        inject(wire, "turn servo=241 by=10deg")
    with pytest.raises(InputError, match="its servos are 1, its other devices 241"):
        inject(wire, "lose servo=5")


def test_the_voltage_of_the_line_is_shown(line):
    wire = line(DeviceConfig(42, "bitbots-core"))
    inject(wire, "voltage volts=15 for=50ms")
    wire.wait(0.01)
    assert wire.read_bytes(42, 32, 2) == words(776), "15 V * 1024 / 19.8 V"
    wire.wait(0.1)
    assert wire.read_bytes(42, 32, 2) == words(621)


def test_a_device_has_only_the_rates_of_its_table():
    config = BusConfig("main", 1_234_567, (), 2.0, devices=(DeviceConfig(200, "OpenCR"),))
    with pytest.raises(ValueError, match="OpenCR: no baud rate near 1234567 bit/s"):
        SimulatedBus(config, Ledger(), 0)
