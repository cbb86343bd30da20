"""Settings that another program left: every item that can be written has a judgement, which inspection obeys.

Generated from all control tables; the servo is a simulated one, and the inspection that of a start.
"""

import re
from pathlib import Path

import pytest
from msgspec.structs import replace
from tests.kit.rigs import make_rig, make_x, start_rig

from dxlrun.channels.event_records import EventCode
from dxlrun.dynamixel.findings import Findings
from dxlrun.dynamixel.servo.checks import inspect_servo
from dxlrun.dynamixel.servo.item_access import first_reach
from dxlrun.dynamixel.servo.torque_limits import restore_torque_limits
from dxlrun.errors import StartUpError, help_link
from dxlrun.features.registers.settings import register_value
from dxlwire.bus_plan import BusPlan, RegisterValue
from dxlwire.control_table import (
    ControlItem,
    ControlTable,
    all_tables,
    find_deviations,
    find_table,
    read_control_table,
)
from dxlwire.control_table.deviation import UNDESCRIBED, Deviation, deviation_of, deviations_by_name
from dxlwire.exchange.bus_engine import Lines
from dxlwire.modes import Mode
from dxlwire.plan.planning import Wiring, bus_plan, position_layout

TABLES = all_tables()
ADDRESSES = {"id", "baud_rate", "baud_rate_bus", "protocol_type"}
"""With another value of these a servo does not answer at its place at all."""
every_table = pytest.mark.parametrize("table", TABLES, ids=lambda table: f"{table.model} {table.protocol}")
LIMITS = {"cw_angle_limit": 1, "min_position_limit": 1, "ccw_angle_limit": -1, "max_position_limit": -1}
"""Which way a position limit becomes narrower."""
REFUSALS = {"torque_enable": "holds torque already"}
"""Sentences that name no item."""


def full_range(table: ControlTable) -> BusPlan:
    """Return the plan of one joint that moves as far as the factory's limits of its servo let it."""
    ends = [table.min_tick, table.max_tick]
    for name, end in (("min_position_limit", 0), ("max_position_limit", 1)):
        if name in table.items:
            initial = table.items[name].initial or 0
            ends[end] = min(max(ends[end], initial), initial) if end else max(ends[end], initial)
    joint = Wiring(
        joint="joint",
        row=0,
        servo_id=1,
        table=table,
        reference=0.0,
        direction=1,
        lower=ends[0] * table.rad_per_tick,
        upper=ends[1] * table.rad_per_tick,
        continuous=False,
    )
    plan = bus_plan(
        name="main",
        port="sim",
        baud_rate=1_000_000,
        latency_ns=0,
        return_delay_ns=500_000,
        joints=[joint],
        protocol=table.protocol,
    )
    return replace(plan, fast=(False,) * len(plan.groups))


class Bench:
    """One simulated servo that is inspected again and again."""

    def __init__(self, table: ControlTable) -> None:
        self.plan = full_range(table)
        self.rig = make_rig(self.plan)
        self.servo = self.rig.servo(1)
        self.one = first_reach(self.plan, self.plan.servos[0])
        self.lines = Lines([self.plan], self.rig.ports, self.rig.clock, self.rig.packets)

    def inspect(self, **left: int) -> Findings:
        """Inspect the servo with other values in its items, and give them back what they had."""
        before = {name: self.servo.registers[name] for name in left}
        for name, value in left.items():
            self.servo.poke(name, value)
        found = Findings()
        self.lines.run_programs([inspect_servo(self.one, found, take_over=False)])
        for name, value in before.items():
            self.servo.poke(name, value)
        return found


def said(found: Findings) -> list[str]:
    """Return what would become events, beside the line that the servo is there."""
    remarks = [text for _, text in found.texts(EventCode.REGISTER_DIFFERS)]
    return remarks + [text for _, text in found.describe_deviations()]


def another_value(item: ControlItem, start: int) -> int:
    """Return a value that is neither the factory's nor equivalent to it, nor one that is always refused."""
    if item.name in LIMITS:
        return start + LIMITS[item.name] * 9
    rule = deviation_of(item.name)
    taken = {item.initial, start, *rule.equivalent, *rule.refused}
    steps = (-1, 1, -2, 2, item.minimum - start, item.maximum - start)
    values = [start + step for step in steps if item.minimum <= start + step <= item.maximum]
    return next((value for value in values if value not in taken), start)


@every_table
def test_every_item_that_can_be_written_has_a_judgement_with_a_reason(table):
    for item in table.items.values():
        if item.access == "R":
            assert item.deviation is None, item.name
        else:
            assert deviation_of(item.name) is not UNDESCRIBED, f"{item.name} is not in deviations.toml"
            assert item.deviation is not None
            assert item.deviation.effect, item.name
            assert item.limited_by in {"", *table.items} or item.initial is not None, item.name


def test_every_judgement_is_of_an_item_that_a_table_has():
    names = {re.sub(r"_\d+$", "", name) for table in TABLES for name in table.items}
    assert deviations_by_name().keys() <= names


def test_an_item_of_a_plugin_without_a_judgement_is_reported():
    text = Path("runtime/dxlwire/control_table/tables/protocol1/AX-12A.toml").read_text()
    items = read_control_table(text.replace("\npunch = ", "\nshove = ")).items
    (found,) = find_deviations(items.values(), {"shove": 33})
    assert (found.item.name, found.judgement, found.factory) == ("shove", "report", 32)
    assert find_deviations(items.values(), {"shove": 32}) == ()


@pytest.mark.parametrize(("value", "factory"), [(799, 800), (800, None), (1023, None), (0, 800)])
def test_an_item_without_an_initial_value_begins_with_that_of_the_item_that_bounds_it(value, factory):
    """A value beyond that of the other item is no deviation: the other one may have been lowered later."""
    text = Path("runtime/dxlwire/control_table/tables/protocol1/AX-12A.toml").read_text()
    rule = 'deviation = {judgement = "report", limited_by = "max_torque", effect = "makes it weak"}'
    items = read_control_table(text.replace("torque_limit = {", f"torque_limit = {{{rule}, ")).items
    found = find_deviations([items["torque_limit"]], {"torque_limit": value, "max_torque": 800})
    assert [one.factory for one in found] == ([] if factory is None else [factory])


@every_table
def test_a_setting_of_another_program_is_refused_reported_or_silent_as_its_table_says(table):
    bench = Bench(table)
    fresh = bench.inspect()
    assert (fresh.problems, said(fresh)) == ([], []), "a servo with the factory's settings"
    judged = 0
    for item in table.items.values():
        if item.access == "R" or item.name in ADDRESSES or item.name.endswith(tuple("23456789")):
            continue
        rule, start = item.deviation, bench.servo.registers.ticks(item.name)
        values = {another_value(item, start): rule.judgement} | dict.fromkeys(rule.refused, "refuse")
        for value, judgement in values.items():
            if value == start or (item.initial is None and not rule.limited_by):
                continue
            found = bench.inspect(**{item.name: value})
            named = REFUSALS.get(item.name, item.title)
            if item.name in LIMITS:
                named = "limits "
            if judgement == "refuse":
                (problem,) = found.problems
                assert named in problem, (item.name, value)
                assert problem.startswith("joint (ID 1 on bus main) ")
                assert not said(found), (item.name, value)
            elif judgement == "report":
                (text,) = said(found)
                assert item.title in text, (item.name, value)
                assert found.problems == [], (item.name, value)
            else:
                assert (found.problems, said(found)) == ([], []), (item.name, value)
            judged += 1
        for value in rule.equivalent:
            if item.minimum <= value <= item.maximum:
                found = bench.inspect(**{item.name: value})
                assert (found.problems, said(found)) == ([], []), (item.name, value)
    assert judged > 10


@every_table
def test_a_reported_setting_that_the_robot_file_then_declares_is_no_longer_reported(table):
    bench = Bench(table)
    items = [item for item in table.items.values() if item.access == "RW" and item.deviation]
    for item in items:
        rule, start = item.deviation, bench.servo.registers.ticks(item.name)
        value = another_value(item, start)
        if rule.planned or rule.judgement != "report" or rule.remedy != Deviation("report", "").remedy:
            continue
        if value == start or (item.initial is None and not rule.limited_by):
            continue
        declared = register_value(table, item.name, value)
        servo = replace(bench.plan.servos[0], settings=(declared,))
        bench.one = first_reach(bench.plan, servo)
        assert said(bench.inspect(**{item.name: value})) == [], item.name


def test_a_setting_that_cannot_be_declared_is_reported_with_its_own_remedy():
    bench = Bench(find_table("AX-12A", 1.0))
    (text,) = said(bench.inspect(lock=1))
    assert text.endswith("; switch its power off and on")
    (text,) = said(bench.inspect(lock=1, punch=40))
    assert text.endswith(
        "; switch its power off and on (Lock (47)); declare what the robot needs in `registers`, or "
        "write it by `dxlrun servo` (Punch (48))"
    )


@pytest.mark.parametrize(
    ("model", "protocol", "item"),
    [
        ("AX-12A", 1.0, "torque_limit"),
        ("XL-320", 2.0, "torque_limit"),
        ("XL430-W250", 2.0, "goal_pwm"),
        ("PM42-010-S260", 2.0, "goal_pwm"),
    ],
)
def test_a_start_restores_a_torque_limit_and_reports_what_it_was(model, protocol, item):
    bench = Bench(find_table(model, protocol))
    full = bench.servo.registers[item]
    bench.servo.poke(item, 20)
    bench.rig.hardware.start()
    assert bench.servo.registers[item] == full > 20
    title = bench.one.items[item].title
    assert f"{title} was restored from 20 to {full}" in bench.rig.events.texts(EventCode.SETUP)
    assert bench.rig.events.of(EventCode.REGISTER_DIFFERS) == []


@every_table
def test_a_torque_limit_is_restored_or_reported(table):
    bench = Bench(table)
    place = bench.plan.servos[0].torque_limit
    if place is None:
        (item,) = (item for item in table.items.values() if item.name in {"torque_limit", "goal_pwm"})
        assert item.deviation.judgement == "report"
        return
    (item,) = (item for item in table.items.values() if item.address == place.address)
    bench.servo.poke(item.name, 20)
    full = bench.servo.registers["max_torque" if item.name == "torque_limit" else "pwm_limit"]
    bench.lines.run_programs([restore_torque_limits(bench.plan, Findings())])
    assert bench.servo.registers[item.name] == full > 20


def test_a_torque_limit_that_another_program_lowered_is_restored_when_the_servo_returns():
    rig = start_rig(make_x((4, 5)))
    servo = rig.servo(5)
    servo.silence()
    rig.cycles(10)
    servo.poke("goal_pwm", 50)
    servo.silence(False)
    rig.cycles(80)
    assert rig.events.of(EventCode.SERVO_BACK)
    assert rig.registers("goal_pwm") == [885, 885]


@every_table
def test_a_speed_that_is_harmless_is_written_with_each_goal(table):
    layout = position_layout(table)
    for name in ("profile_velocity", "moving_speed"):
        item = table.items.get(name)
        if item is not None and item.deviation.judgement == "harmless":
            assert layout.address <= item.address < layout.address + layout.length, name


@pytest.mark.parametrize(
    ("name", "value", "sentence"),
    [
        (
            "secondary_shadow_id",
            2,
            "has Secondary (Shadow) ID (12) = 2, and this value makes it also execute what is",
        ),
        ("shutdown", 0, "has Shutdown (63) = 0, and this value leaves its torque on whatever the error"),
    ],
)
def test_a_refused_setting_comes_with_the_command_that_writes_it_on_a_real_port_alone(name, value, sentence):
    plan = make_x((4,))
    rig = make_rig(plan)
    rig.servo(4).poke(name, value)
    factory = plan_item(plan, name).initial
    for port, command in (
        ("sim", ""),
        ("/dev/ttyUSB0", f" (`dxlrun servo /dev/ttyUSB0 4 set {name} {factory}`)"),
    ):
        found, other = Findings(), replace(plan, port=port)
        lines = Lines([plan], rig.ports, rig.clock, rig.packets)
        lines.run_programs([inspect_servo(first_reach(other, other.servos[0]), found, take_over=False)])
        (problem,) = found.problems
        assert problem.startswith(f"arm_4_joint (ID 4 on bus arm) {sentence}")
        link = help_link("a-setting-of-another-program-is-refused")
        assert problem.endswith(f": write {factory}{command}; {link}")


def plan_item(plan: BusPlan, name: str) -> ControlItem:
    return first_reach(plan, plan.servos[0]).items[name]


def test_all_settings_of_a_servo_are_one_event():
    rig = make_rig(make_x((4, 5)))
    left = {
        "pwm_limit": 400,
        "current_limit": 300,
        "velocity_limit": 50,
        "position_p_gain": 50,
        "shutdown": 36,
    }
    for name, value in left.items():
        rig.servo(5).poke(name, value)
    rig.hardware.start()
    ((joint, text),) = rig.events.of(EventCode.REGISTER_DIFFERS)
    assert joint == "arm_5_joint"
    assert text.startswith(
        "ID 5 on bus arm differs from the factory settings: PWM Limit (36) = 400 instead of 885"
    )
    assert all(plan_item(rig.plans[0], name).title in text for name in left)


def test_what_the_robot_file_declares_is_no_event():
    plan = make_x((4,))
    item = plan_item(plan, "position_p_gain")
    register = RegisterValue(item.address, item.size, 50, item.name)
    rig = make_rig(replace(plan, servos=(replace(plan.servos[0], settings=(register,)),)))
    rig.servo(4).poke(item.name, 50)
    rig.hardware.start()
    assert rig.events.of(EventCode.REGISTER_DIFFERS) == []


def test_servos_with_the_settings_of_the_factory_start_without_a_new_event():
    for plan in (None, make_x((4, 5))):
        rig = start_rig(*([] if plan is None else [plan]))
        assert rig.events.of(EventCode.REGISTER_DIFFERS) == []


def test_a_servo_that_was_replaced_by_one_with_a_second_id_does_not_take_part_again():
    rig = start_rig(make_x((4, 5)))
    servo = rig.servo(5)
    servo.silence()
    rig.cycles(10)
    servo.poke("secondary_shadow_id", 4)
    servo.silence(False)
    rig.cycles(80)
    assert not rig.states.valid[1]
    assert any("Secondary (Shadow) ID (12) = 4" in text for text in rig.events.texts(EventCode.SERVO_LOST))


def test_a_servo_that_refuses_to_read_between_its_items_is_read_without_what_is_between():
    """Of tables of Protocol 2.0 it is not known which servos do [?]."""
    plan = make_x((4,))
    rig = make_rig(plan)
    rig.servo(4).poke("secondary_shadow_id", 2)
    table, memory = first_reach(plan, plan.servos[0]).table, rig.servo(4).registers
    read = memory.read_bytes
    memory.read_bytes = lambda start, size: read(start, size) if table.readable(start, start + size) else None
    found = Findings()
    lines = Lines([plan], rig.ports, rig.clock, rig.packets)
    lines.run_programs([inspect_servo(first_reach(plan, plan.servos[0]), found, take_over=False)])
    (problem,) = found.problems
    assert "Secondary (Shadow) ID (12) = 2" in problem


def test_inspection_reads_identity_and_each_area_once():
    for plan, reads in ((make_x((4,)), 3), (full_range(TABLES[0]), 2)):
        rig = make_rig(plan)
        lines = Lines([plan], rig.ports, rig.clock, rig.packets)
        lines.run_programs([inspect_servo(first_reach(plan, plan.servos[0]), Findings(), take_over=False)])
        assert len(rig.into_bus()) == reads


def test_goal_pwm_stays_within_a_pwm_limit_that_another_program_left():
    rig = make_rig(make_x((4,), continuous=True, start_mode=Mode.VELOCITY))
    rig.servo(4).poke("pwm_limit", 100)
    rig.hardware.start()
    assert rig.registers("goal_pwm") == [100]
    ((_, text),) = rig.events.of(EventCode.REGISTER_DIFFERS)
    assert "PWM Limit (36) = 100 instead of 885" in text


def test_a_locked_servo_that_has_to_change_its_mode_names_lock_and_the_remedy():
    rig = make_rig()
    for name, value in (("cw_angle_limit", 0), ("ccw_angle_limit", 0), ("lock", 1)):
        rig.servo(6).poke(name, value)
    with pytest.raises(StartUpError) as refusal:
        rig.hardware.start()
    (problem,) = refusal.value.sentences
    assert problem.startswith("main_6_joint (ID 6 on bus main) has Lock (47) = 1, so CCW Angle Limit (8) = 1")
    assert problem.endswith(" in its EEPROM was not written: switch its power off and on")


def test_a_goal_of_the_mode_in_which_a_servo_starts_is_no_setting():
    rig = make_rig(make_x((4,), start_mode=Mode.PWM))
    rig.servo(4).poke("goal_pwm", 5)
    rig.hardware.start()
    assert rig.events.of(EventCode.REGISTER_DIFFERS) == []
