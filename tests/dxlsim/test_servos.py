"""What a dialogue cannot say of simulated servos and devices: settings, rates, delays, what they measure."""

import math
import struct

import pytest
from tests.kit.simulated_line import Line

from dxlsim.bus.ledger import Ledger
from dxlsim.bus.simulated_bus import SimulatedBus
from dxlsim.device.device_quantities import on_the_wire
from dxlsim.faults.fault import parse_fault
from dxlsim.servo.making import make_servo
from dxlsim.servo.simulated_servo import SimulatedServo
from dxlsim.simulation_plan import BusConfig, DeviceConfig, DeviceReadings, ServoConfig, ServoTimes

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


@pytest.mark.parametrize(
    ("firmware", "model"), [(51, "XL330-M288-FW51"), (52, "XL330-M288"), (None, "XL330-M288")]
)
def test_the_firmware_decides_the_control_table(firmware, model):
    servo = make_servo(ServoConfig(1, "XL330-M288", 0.0, firmware=firmware), 57_600, 0, protocol=2.0)
    assert servo.registers.table.model == model
    assert servo.registers["firmware_version"] == (firmware or 52)


MS = 1_000_000
both = pytest.mark.parametrize(("model", "goal"), [("AX-12A", 700), ("XM430-W350", 3000)])


def bus_of(model: str, delay_ms: int = 0) -> SimulatedBus:
    servo = ServoConfig(1, model, 2.0, times=ServoTimes(response_delay_ns=delay_ms * MS))
    return SimulatedBus(
        BusConfig("main", 1_000_000, (servo,), 1.0 if model == "AX-12A" else 2.0), Ledger(), 0
    )


def command(servo: SimulatedServo, **items: int) -> None:
    for name, value in items.items():
        servo.registers[name] = value
        servo.shaft.plan((name,))


def way(bus: SimulatedBus, goal: int, until_ns: int) -> list[float]:
    """Give a goal with torque now; return how far the shaft is each 0.1 ms from now on."""
    servo, began_ns = bus.servo(1), bus.now_ns
    command(servo, torque_enable=1, goal_position=goal)
    before, moved = servo.shaft_angle, []
    for now_ns in range(began_ns, began_ns + until_ns, MS // 10):
        bus.advance_to(now_ns)
        moved.append(servo.shaft_angle - before)
    return moved


@both
@pytest.mark.parametrize("delay_ms", [1, 6, 20])
def test_a_servo_acts_a_response_delay_later_and_then_as_ever(model, goal, delay_ms):
    quick = way(bus_of(model), goal, 200 * MS)
    slow = way(bus_of(model, delay_ms), goal, 200 * MS)
    grid = 20  # points of 0.1 ms in a step of the mechanics
    shift = -(-10 * delay_ms // grid) * grid
    assert slow[shift:] == pytest.approx(quick[: len(slow) - shift], abs=1e-12)
    assert not any(slow[:shift])
    assert quick[grid]


def test_goals_act_in_the_order_and_at_the_distance_in_which_they_came():
    bus = bus_of("XM430-W350", delay_ms=50)
    way(bus, 1304, 400 * MS)  # 2 rad: it stays
    servo = bus.servo(1)
    unit = servo.registers.table.rad_per_tick
    for goal in (1400, 1500):
        command(servo, goal_position=goal)
        bus.advance_to(bus.now_ns + 30 * MS)
    # 60 ms after the first goal only this one acts
    assert servo.shaft.mechanics.servos["setpoint"][0] == pytest.approx(1400 * unit)
    bus.advance_to(bus.now_ns + 500 * MS)
    assert servo.shaft_angle == pytest.approx(1500 * unit, abs=0.01)


@both
def test_a_servo_receives_nothing_for_its_time_after_a_write(model, goal):
    line = Line(model, 1, write_time_ns=3 * MS)
    item = line.item("goal_position")
    ping, read = line.packet(1, 1), line.packet(1, 2, line.word(item.address) + line.word(item.size))
    goals = line.word(item.address) + line.word(item.size) + b"\x01" + goal.to_bytes(item.size, "little")

    def answers(packet: bytes) -> bool:
        line.send(packet)
        return bool(line.receive(5 * MS))

    assert answers(read)
    assert answers(read), "a read takes no such time"
    for packet, wait_ms, answered in ((ping, 2.8, False), (ping, 3.2, True), (read, 3.2, True)):
        line.instruct(0xFE, 0x83, goals)
        line.wait(wait_ms / 1000)
        assert answers(packet) is answered


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
