"""Slow registers, reboots that cost no reply, and alerts: judged by the simulated bus."""

import numpy as np
import pytest
from msgspec.structs import replace
from tests.kit.rigs import every_servo, make_plan, make_x, start_rig

from dxlrun.channels.event_records import EventCode
from dxlwire.control_table import find_table
from dxlwire.plan.reads import slow_items

SECOND_NS = 1_000_000_000


def start(plan=None, *, slow_period_ns=SECOND_NS, items=(), returning=False):
    plan = plan or make_x((11, 12))
    slow = items or slow_items(find_table(plan.servos[0].model, plan.protocol))
    plan = replace(plan, slow_period_ns=slow_period_ns)
    return start_rig(every_servo(plan, slow=slow, torque_on_return=returning))


@pytest.mark.parametrize(
    "plan",
    [
        make_x((11, 12)),
        make_plan((11, 12)),
        make_x((11, 12), model="XL-320", reference=2.6, lower=-2.0, upper=2.0),
    ],
    ids=["XM430-W350", "AX-12A", "XL-320"],
)
def test_temperature_and_voltage_come_into_the_states_at_their_own_rate(plan):
    rig = start(plan)
    servo = rig.buses[0].servos[1]
    rig.cycles(60)
    assert rig.states.temperature[1] == pytest.approx(servo.temperature, abs=0.6)
    assert rig.states.voltage[1] == pytest.approx(servo.voltage, abs=0.2)
    count = len(rig.into_bus())
    rig.cycles(500)
    reading = [packet for packet in rig.into_bus()[count:] if packet[4] == servo.servo_id]
    blocks = set(reading)
    assert len(blocks) <= 3
    assert all(9 <= reading.count(block) <= 11 for block in blocks)  # once a second


def test_values_of_a_second_bus_are_shown_at_its_joints():
    slow = slow_items(find_table("XM430-W350", 2.0))
    plans = [make_x((11,)), make_x((21,), name="leg", first_row=1)]
    rig = start_rig(*(every_servo(replace(plan, slow_period_ns=SECOND_NS), slow=slow) for plan in plans))
    rig.servo(21, bus=1).set_voltage(11.0)
    rig.cycles(60)
    assert rig.states.voltage.tolist() == pytest.approx([12.0, 11.0])


def test_slow_registers_make_no_cycle_late_and_wait_for_ever_where_there_is_no_time():
    for period_ns, known in ((2_000_000, True), (1_000_000, False)):  # the exchange takes 0.85 ms
        rig = start(slow_period_ns=20_000_000)
        rig.period_ns = period_ns
        rig.cycles(200)  # `cycle` asserts that it ends in time
        assert np.isfinite(rig.states.voltage).tolist() == [known] * 2
    assert rig.events.of(EventCode.OVERRUN) == []
    rig.period_ns = 2_000_000
    rig.cycles(200)
    assert np.isfinite(rig.states.voltage).all()


def test_a_hot_servo_is_reported_ten_degrees_before_its_limit_and_when_it_has_cooled():
    rig = start()
    servo = rig.servo(12)
    limit = servo.registers["temperature_limit"]
    for temperature, events in (
        (30, 0),
        (limit - 8, 1),
        (limit - 12, 1),
        (40, 2),
    ):  # at 12 it is not cooled yet
        servo.temperature = temperature
        rig.cycles(70)
        assert len(rig.events.of(EventCode.SERVO_HOT)) == events
    assert rig.events.sources(EventCode.SERVO_HOT) == ["arm_12_joint"] * 2
    assert "above 80 deg C (Temperature Limit (31))" in rig.events.texts(EventCode.SERVO_HOT)[0]


def test_another_item_is_reported_when_it_changes():
    rig = start(items=("position_p_gain",))
    rig.cycles(120)
    rig.servo(12).poke("position_p_gain", 640)
    rig.cycles(60)
    ((source, text),) = rig.events.of(EventCode.REGISTER_DIFFERS)
    assert source == "arm_12_joint"
    assert "Position P Gain (84) changed from 800 to 640" in text


@pytest.mark.parametrize("returning", [False, True])
def test_a_reboot_that_no_read_missed_is_seen_by_the_tick(returning):
    rig = start(returning=returning)
    rig.period_ns = 250_000_000  # it boots between two reads
    rig.cycles(12)
    rig.servo(12).boot_ns = 0
    rig.servo(12).power_cycle()
    rig.cycles(12)
    assert rig.events.sources(EventCode.SERVO_REBOOTED) == ["arm_12_joint"]
    assert rig.events.of(EventCode.READ_LOST) == []
    assert rig.torque() == [True, returning]
    assert rig.states.valid.all()
    rig.goals.position[:] += 0.05
    rig.cycles(2)
    assert (12 in rig.goals_sent()[-1][1]) == returning


def test_a_hardware_error_is_in_the_states_as_long_as_it_stands():
    rig = start()
    rig.cycles(5)
    for error, cycles in ((0x20, 5), (0x24, 55)):  # the alert stands as before
        rig.servo(12).poke("hardware_error_status", error)
        rig.cycles(cycles)
        assert rig.states.hardware_error.tolist() == [0, error]
