"""Slow registers, reboots that cost no reply, jumps, and shutdowns: judged by the simulated bus."""

import math

import numpy as np
import pytest
from msgspec.structs import replace
from tests.kit.rigs import make_plan, start_rig

from dxlrun.channels.event_records import EventCode
from dxlwire.control_table import find_table
from dxlwire.plan.reads import slow_items

SECOND_NS = 1_000_000_000


def start(model="XM430-W350", ids=(11, 12), *, protocol=2.0, period_ns=SECOND_NS, items=(), **change):
    returning = change.pop("returning", False)
    x = {"reference": math.pi, "lower": -2.5, "upper": 2.5, "return_delay_ns": 0}
    plan = make_plan(ids, protocol=protocol, model=model, **(x if protocol == 2.0 else {}) | change)
    slow = items or slow_items(find_table(model, protocol))
    servos = tuple(replace(servo, slow=slow, torque_on_return=returning) for servo in plan.servos)
    return start_rig(replace(plan, servos=servos, slow_period_ns=period_ns))


@pytest.mark.parametrize(("model", "protocol"), [("XM430-W350", 2.0), ("AX-12A", 1.0), ("XL-320", 2.0)])
def test_temperature_and_voltage_come_into_the_states_at_their_own_rate(model, protocol):
    change = {"reference": 2.6, "lower": -2.0, "upper": 2.0} if model == "XL-320" else {}
    rig = start(model, protocol=protocol, **change)
    servo = rig.buses[0].servos[1]
    rig.cycles(60)
    assert rig.states.temperature[1] == pytest.approx(servo.temperature, abs=0.6)
    assert rig.states.voltage[1] == pytest.approx(servo.voltage, abs=0.2)
    count = len(rig.into_bus())
    rig.cycles(500)
    sent = rig.into_bus()[count:]
    reading = [packet for packet in sent if packet[4] == servo.servo_id]
    blocks = {bytes(packet) for packet in reading}
    assert len(blocks) <= 3
    for block in blocks:
        assert 9 <= reading.count(block) <= 11  # once a second


def test_slow_registers_make_no_cycle_late_and_wait_for_ever_where_there_is_no_time():
    rig = start(period_ns=20_000_000)
    rig.period_ns = 2_000_000
    rig.cycles(200)  # `cycle` asserts that it ends in time
    assert not np.isnan(rig.states.voltage).any()
    rig = start(period_ns=20_000_000)
    rig.period_ns = 1_000_000  # the exchange takes 0.85 ms of it
    rig.cycles(300)
    assert np.isnan(rig.states.voltage).all()
    assert rig.events.of(EventCode.OVERRUN) == []
    rig.period_ns = 2_000_000
    rig.cycles(200)
    assert not np.isnan(rig.states.voltage).any()


def test_a_hot_servo_is_reported_ten_degrees_before_its_limit_and_when_it_has_cooled():
    rig = start()
    servo = rig.servo(12)
    rig.cycles(100)
    assert rig.events.of(EventCode.SERVO_HOT) == []
    servo.temperature = servo.registers["temperature_limit"] - 8
    rig.cycles(70)
    ((source, text),) = rig.events.of(EventCode.SERVO_HOT)
    assert source == "main_12_joint"
    assert "above 80 deg C (Temperature Limit (31))" in text
    servo.temperature = servo.registers["temperature_limit"] - 12
    rig.cycles(70)
    assert len(rig.events.of(EventCode.SERVO_HOT)) == 1, "it is not cooled yet"
    servo.temperature = 40.0
    rig.cycles(70)
    assert len(rig.events.of(EventCode.SERVO_HOT)) == 2


def test_another_item_is_reported_when_it_changes():
    rig = start(items=("position_p_gain",))
    rig.cycles(120)
    rig.servo(12).poke("position_p_gain", 640)
    rig.cycles(60)
    ((source, text),) = rig.events.of(EventCode.REGISTER_DIFFERS)
    assert source == "main_12_joint"
    assert "Position P Gain (84) changed from 800 to 640" in text


@pytest.mark.parametrize("returning", [False, True])
def test_a_reboot_that_no_read_missed_is_seen_by_the_tick(returning):
    rig = start(returning=returning)
    rig.period_ns = 250_000_000  # it boots between two reads
    rig.cycles(12)
    rig.servo(12).boot_ns = 0
    rig.servo(12).power_cycle()
    rig.cycles(12)
    assert rig.events.sources(EventCode.SERVO_REBOOTED) == ["main_12_joint"]
    assert rig.events.of(EventCode.READ_LOST) == []
    assert rig.torque() == [True, returning]
    assert rig.states.valid.all()
    rig.goals.position[:] += 0.05
    rig.cycles(2)
    goals = [packet for packet in rig.into_bus() if packet[7] == 0x83][-1]
    assert (12 in goals[12:-2:9]) == returning


def test_ten_minutes_pass_without_a_false_reboot():
    rig = start(ids=(11,), period_ns=SECOND_NS)
    rig.period_ns = 500_000_000  # the tick does not care how often the states are read
    rig.cycles(10 * 60 * 2)
    assert rig.events.of(EventCode.SERVO_REBOOTED) == []
    assert rig.events.of(EventCode.SERVO_LIMP) == []


def test_a_hardware_error_is_in_the_states_as_long_as_it_stands():
    rig = start()
    rig.cycles(5)
    rig.servo(12).poke("hardware_error_status", 0x20)
    rig.cycles(5)
    assert rig.states.hardware_error.tolist() == [0, 0x20]
    rig.servo(12).poke("hardware_error_status", 0x24)  # the alert stands as before
    rig.cycles(55)
    assert rig.states.hardware_error.tolist() == [0, 0x24]


@pytest.mark.parametrize(
    ("hurt", "error"),
    [
        (lambda servo: servo.trigger_overload(), 0x20),
        (lambda servo: servo.set_temperature(99.0), 0x04),
    ],
)
def test_a_servo_of_protocol_1_that_shut_down_gets_no_goals(hurt, error):
    rig = start("AX-12A", (1, 3), protocol=1.0)
    rig.cycles(5)
    hurt(rig.servo(3))
    rig.cycles(10)
    assert rig.states.hardware_error[1] & error
    ((source, text),) = rig.events.of(EventCode.SERVO_LIMP)
    assert source == "main_3_joint"
    assert "Torque Limit (34) = 0" in text
    count = len(rig.into_bus())
    rig.goals.position[:] += 0.1
    rig.cycles(5)
    goals = [packet for packet in rig.into_bus()[count:] if packet[4] == 0x83]
    assert goals
    assert all(3 not in packet[7:-1:5] for packet in goals)
