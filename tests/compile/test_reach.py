"""Range of joints from the range of their servos, for every model."""

import pytest
from tests.kit.robots import compile_text

from dxlwire.control_table import all_tables

SPAN = """\
name: span
buses: {{main: {{port: sim, protocol: {protocol}, baud_rate: 1_000_000, adapter: {{latency: 0 ms}}}}}}
loop: {{rate: 50}}
joints:
  left_arm_joint: {{bus: main, id: 1, model: "{model}", reference: {left:.12f} rad, direction: 1}}
  right_arm_joint: {{bus: main, id: 2, model: "{model}", reference: {right:.12f} rad, direction: -1}}
"""


@pytest.mark.parametrize(
    "table", [table for table in all_tables() if not table.firmware], ids=lambda table: table.model
)
def test_a_joint_reaches_every_goal_position_of_its_model(table):
    low, high = table.min_tick * table.rad_per_tick, table.max_tick * table.rad_per_tick
    left = low + 0.25 * (high - low)
    text = SPAN.format(protocol=table.protocol, model=table.model, left=left, right=low + high - left)
    compiled = compile_text(text)
    ticks = [(servo.lower_tick, servo.upper_tick) for servo in compiled.plan.buses[0].servos]
    assert ticks == [(table.min_tick, table.max_tick)] * 2
    reached = [value for joint in compiled.plan.loop.joints for value in (joint.lower, joint.upper)]
    assert reached == pytest.approx([low - left, high - left] * 2)
    assert compiled.warnings == (), "the reference is in the travel, and the twins are mirror images"


@pytest.mark.parametrize(("left", "count"), [(-3.1, 0), (-3.2, 2)])
def test_a_reference_outside_of_a_travel_to_both_sides_of_0_is_a_warning(left: float, count: int):
    text = SPAN.format(protocol=2.0, model="PH54-200-S500", left=left, right=-left)
    found = [one.what.partition("S500 ")[2] for one in compile_text(text).warnings]
    assert found == ["(-180..180 deg), so the joint cannot reach 0"] * count
