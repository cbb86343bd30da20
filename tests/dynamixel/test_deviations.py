"""Settings that another program left: every item that can be written has a judgement, which inspection obeys.

Generated from all control tables; the servo is a simulated one, and the inspection that of a start.
"""

import re
from pathlib import Path

import pytest
from msgspec.structs import replace
from tests.kit.rigs import make_plan, make_rig

from dxlrun.channels.event_records import EventCode
from dxlrun.dynamixel.findings import Findings
from dxlrun.dynamixel.servo.checks import inspect_servo
from dxlrun.dynamixel.servo.item_access import first_reach
from dxlrun.dynamixel.servo.torque_limits import restore_torque_limits
from dxlrun.features.registers.settings import register_value
from dxlwire.bus_plan import BusPlan
from dxlwire.control_table import (
    ControlItem,
    ControlTable,
    all_tables,
    find_deviations,
    find_table,
    read_control_table,
)
from dxlwire.control_table.deviation import UNDESCRIBED, Deviation, deviation_of, deviations_by_name
from dxlwire.plan.planning import position_layout

pytestmark = pytest.mark.long

TABLES = all_tables()
ADDRESSES = {"id", "baud_rate", "baud_rate_bus", "protocol_type"}
"""With another value of these a servo does not answer at its place at all."""
every_table = pytest.mark.parametrize("table", TABLES, ids=lambda table: f"{table.model} {table.protocol}")
LIMITS = {"cw_angle_limit": 1, "min_position_limit": 1, "ccw_angle_limit": -1, "max_position_limit": -1}
"""Which way a position limit becomes narrower."""
REFUSALS = {"torque_enable": "holds torque already"}
"""Sentences that name no item."""
AX = Path("runtime/dxlwire/control_table/tables/protocol1/AX-12A.toml").read_text()


def full_range(table: ControlTable) -> BusPlan:
    """Return the plan of one joint that moves nearly as far as the factory's limits of its servo let it.

    Two ticks are left for a Homing Offset.
    """
    ends = [table.min_tick, table.max_tick]
    for name, end in (("min_position_limit", 0), ("max_position_limit", 1)):
        if name in table.items:
            initial = table.items[name].initial or 0
            ends[end] = initial if end else max(ends[end], initial)
    lower, upper = ((end + left) * table.rad_per_tick for end, left in zip(ends, (2, -2), strict=True))
    joint = {"joints": ["joint"], "reference": 0.0, "direction": 1, "lower": lower, "upper": upper}
    return make_plan((1,), protocol=table.protocol, model=table.model, **joint)


class Bench:
    """One simulated servo that is inspected again and again."""

    def __init__(self, table: ControlTable) -> None:
        self.plan = full_range(table)
        self.rig = make_rig(self.plan)
        self.servo = self.rig.servo(1)
        self.one = first_reach(self.plan, self.plan.servos[0])

    def inspect(self, **left: int) -> tuple[list[str], list[str]]:
        """Inspect the servo with other values in its items, and give them back what they had.

        Return what refuses a start, and what would become events, besides the line that the servo is there.
        """
        before = {name: self.servo.registers[name] for name in left}
        for name, value in left.items():
            self.servo.poke(name, value)
        found = Findings()
        self.rig.lines.run_programs([inspect_servo(self.one, found, take_over=False)])
        for name, value in before.items():
            self.servo.poke(name, value)
        said = [*found.texts(EventCode.REGISTER_DIFFERS), *found.describe_deviations()]
        return found.problems, [text for _, text in said]


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
    assert table.items
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


def test_all_x_servos_but_the_xl_320_have_a_startup_configuration():
    x = {table.model for table in TABLES if table.protocol == 2.0 and re.match(r"2?X", table.model)}
    having = {table.model for table in TABLES if "startup_configuration" in table.items}
    assert x - having == {"XL-320"}


def test_an_item_of_a_plugin_without_a_judgement_is_reported():
    items = read_control_table(AX.replace("\npunch = ", "\nshove = ")).items
    (found,) = find_deviations(items.values(), {"shove": 33})
    assert (found.item.name, found.judgement, found.factory) == ("shove", "report", 32)
    assert find_deviations(items.values(), {"shove": 32}) == ()


@pytest.mark.parametrize(("value", "factory"), [(799, 800), (800, None), (1023, None), (0, 800)])
def test_an_item_without_an_initial_value_begins_with_that_of_the_item_that_bounds_it(value, factory):
    """A value beyond that of the other item is no deviation: the other one may have been lowered later."""
    rule = 'deviation = {judgement = "report", limited_by = "max_torque", effect = "makes it weak"}'
    items = read_control_table(AX.replace("torque_limit = {", f"torque_limit = {{{rule}, ")).items
    found = find_deviations([items["torque_limit"]], {"torque_limit": value, "max_torque": 800})
    assert [one.factory for one in found] == ([] if factory is None else [factory])


@every_table
def test_a_setting_of_another_program_is_refused_reported_or_silent_as_its_table_says(table):
    """One that is reported is silent once the robot file declares it."""
    bench = Bench(table)
    assert bench.inspect() == ([], []), "a servo with the factory's settings"
    judged, plain, remedy = 0, bench.one, Deviation("report", "").remedy
    for item in table.items.values():
        if item.access == "R" or item.name in ADDRESSES or item.name.endswith(tuple("23456789")):
            continue
        if item.name == "multi_turn_offset":
            continue  # it counts only where the joint is continuous; `cases/checks.txt` has both
        rule, start = item.deviation, bench.servo.registers.ticks(item.name)
        values = {another_value(item, start): rule.judgement} | dict.fromkeys(rule.refused, "refuse")
        for value, judgement in values.items():
            if value == start or (item.initial is None and not rule.limited_by):
                continue
            problems, said = bench.inspect(**{item.name: value})
            judged += 1
            if judgement == "refuse":
                named = "limits " if item.name in LIMITS else REFUSALS.get(item.name, item.title)
                (problem,) = problems
                assert named in problem, (item.name, value)
                assert problem.startswith("joint (ID 1 on bus main) ")
                assert not said, (item.name, value)
                continue
            assert (problems, len(said)) == ([], judgement == "report"), (item.name, value)
            assert all(item.title in text for text in said), (item.name, value)
            if said and item.access == "RW" and not rule.planned and rule.remedy == remedy:
                settings = (register_value(table, item.name, value),)
                bench.one = first_reach(bench.plan, replace(bench.plan.servos[0], settings=settings))
                assert bench.inspect(**{item.name: value}) == ([], []), f"{item.name} is declared"
                bench.one = plain
        for value in rule.equivalent:
            if item.minimum <= value <= item.maximum:
                assert bench.inspect(**{item.name: value}) == ([], []), (item.name, value)
    assert judged > 10


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
    bench.rig.lines.run_programs([restore_torque_limits(bench.plan, Findings())])
    assert bench.servo.registers[item.name] == full > 20


@every_table
def test_a_speed_that_is_harmless_is_written_with_each_goal(table):
    layout = position_layout(table)
    for name in ("profile_velocity", "moving_speed"):
        item = table.items.get(name)
        if item is not None and item.deviation.judgement == "harmless":
            assert layout.address <= item.address < layout.address + layout.length, name


@pytest.mark.parametrize(("model", "protocol", "reads"), [("XM430-W350", 2.0, 3), ("AX-12A", 1.0, 2)])
def test_inspection_reads_identity_and_each_area_once(model, protocol, reads):
    bench = Bench(find_table(model, protocol))
    bench.inspect()
    assert len(bench.rig.into_bus()) == reads
