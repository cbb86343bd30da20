"""Modes on the wire: each model that has a mode is brought into it, follows its goals there, and never jumps."""

import math

import numpy as np
import pytest

from dxlrun.control_table import all_tables, control_table
from dxlrun.events import EventCode
from dxlrun.mode import Mode

P, V, E, W, C = Mode.POSITION, Mode.VELOCITY, Mode.EFFORT, Mode.PWM, Mode.EFFORT_POSITION
FAMILIES = {
    ("AX-12A", 1.0): {P, V, W},
    ("RX-64", 1.0): {P, V, W},
    ("EX-106+", 1.0): {P, V, W},
    ("MX-28", 1.0): {P, V},
    ("MX-12W", 1.0): {P, V},
    ("MX-64", 1.0): {P, V, E},
    ("MX-106", 1.0): {P, V, E},
    ("MX-28", 2.0): {P, V, W},
    ("MX-64", 2.0): {P, V, E, W, C},
    ("XL-320", 2.0): {P, V, W},
    ("XL330-M288", 2.0): {P, V, E, W, C},
    ("XL430-W250", 2.0): {P, V, W},
    ("XM430-W350", 2.0): {P, V, E, W, C},
    ("XH540-W270", 2.0): {P, V, E, W, C},
    ("PH54-200-S500", 2.0): {P, V, E, W},
    ("RH-P12-RN(A)", 2.0): {P, E, C},
}
"""What the e-Manual's pages of the models say."""


@pytest.fixture
def make_one(make_rig, make_plan):
    """One servo of a model, in the middle of its travel, started."""

    def make(model, protocol, **change):
        table = control_table(model, protocol)
        middle = (table.min_tick + table.max_tick) / 2 * table.rad_per_tick
        reach = 0.45 * (table.max_tick - table.min_tick) * table.rad_per_tick
        given = {"reference": middle, "lower": -reach, "upper": reach, "return_delay_ns": 0} | change
        plan = make_plan((1, 2), model=model, protocol=protocol, **given)
        rig = make_rig(plan, position=middle or 0.001)
        rig.hardware.start()
        return rig

    return make


def change(rig, mode, rows=(0,), cycles=60):
    """Ask for a mode; return after how many cycles it was there."""
    wanted = np.zeros(len(rig.states.mode), dtype=np.uint8)
    wanted[list(rows)] = mode
    rig.hardware.set_modes(wanted)
    for count in range(1, cycles):
        rig.cycle()
        if all(rig.states.mode[row] == mode for row in rows):
            return count
    raise AssertionError([text for _, text in rig.events.of(EventCode.MODE)])


def command(rig, mode, value, row=0):
    """Give one joint a goal of a mode, and no other."""
    for array in (rig.goals.position, rig.goals.velocity, rig.goals.effort, rig.goals.pwm):
        array[row] = np.nan
    {
        Mode.POSITION: rig.goals.position,
        Mode.VELOCITY: rig.goals.velocity,
        Mode.EFFORT: rig.goals.effort,
        Mode.PWM: rig.goals.pwm,
        Mode.EFFORT_POSITION: rig.goals.position,
    }[mode][row] = value


def moved(rig, cycles=15):
    """Return how far the first joint's servo turns in some cycles, rad of the joint."""
    servo, plan = rig.buses[0].servo(1), rig.plans[0].servos[0]
    before = servo.position
    for _ in range(cycles):
        rig.cycle()
    return plan.direction * (servo.position - before)


CASES = [
    pytest.param(model, protocol, mode, id=f"{model}-{protocol:g}-{mode.name.lower()}")
    for (model, protocol), modes in FAMILIES.items()
    for mode in sorted(modes - {P})
]


@pytest.mark.parametrize(("model", "protocol"), FAMILIES)
def test_a_model_has_the_modes_of_its_manual(make_plan, model, protocol):
    plan = make_plan((1,), model=model, protocol=protocol, reference=1.0, lower=-0.5, upper=0.5)
    assert {mode.mode for mode in plan.servos[0].modes} == FAMILIES[model, protocol]


@pytest.mark.parametrize(("model", "protocol", "mode"), CASES)
def test_a_model_goes_into_a_mode_follows_its_goals_there_and_comes_back(make_one, model, protocol, mode):
    rig = make_one(model, protocol)
    standing = rig.buses[0].servo(1).position
    change(rig, mode)
    assert rig.buses[0].servo(1).position == pytest.approx(standing, abs=0.02), "it jumped"
    scale = {Mode.VELOCITY: 0.4, Mode.PWM: 0.2, Mode.EFFORT_POSITION: 0.1}.get(mode, 0.0)
    plan = rig.plans[0].servos[0].mode_plan(mode)
    if mode is Mode.EFFORT:
        scale = plan.effort.per_tick * plan.effort.most * 0.15
    command(rig, mode, scale)
    assert moved(rig) > 0.0005
    command(rig, mode, -scale)
    moved(rig, 10)
    assert moved(rig) < -0.0005
    change(rig, Mode.POSITION)
    assert rig.torque() == [True, True]
    assert rig.events.of(EventCode.SERVO_LIMP) == []
