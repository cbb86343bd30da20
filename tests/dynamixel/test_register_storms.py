"""Registers while line and servos fail: each request is answered once, and a confirmed value is there.

A storm is 8 s of a robot at 50 Hz; CI runs three of each protocol, `pytest --campaign=release FILE` 600.
"""

import math

import pytest
from msgspec.structs import replace
from tests.kit.campaigns import campaign
from tests.kit.rigs import make_plan, random_fault, start_rig

from dxlwire.bus_plan import RegisterValue

GAINS = {
    2.0: {"position_p_gain": (84, 2), "position_d_gain": (80, 2), "led": (65, 1)},
    1.0: {"p_gain": (28, 1), "d_gain": (26, 1), "led": (25, 1)},
}
RAM = {2.0: 64, 1.0: 24}
"""First address (e-Manual XM430-W350, MX-64)."""


class Wishes:
    """What was asked of each servo's registers, and what came of it."""

    def __init__(self, rig, declared):
        self.rig = rig
        self.answers = []
        self.possible = {(row, name): {value} for row in range(3) for name, value in declared.items()}
        """What each register may hold: what was answered well last, and what was tried since without."""

    def ask(self, row, name, value):
        number = len(self.answers)
        self.answers.append([])
        self.possible.setdefault((row, name), {0}).add(value)

        def done(problem, _found):
            self.answers[number].append(problem)
            if not problem:
                self.possible[row, name] = {value}

        self.rig.hardware.write_register(row, name, value, done)


def storm(protocol, chance):
    """Let clients change registers in a storm; return the robot at rest again, and the wishes."""
    places = GAINS[protocol]
    declared = dict.fromkeys(tuple(places)[:2], 20)
    registers = tuple(RegisterValue(*places[name], value, name) for name, value in declared.items())
    change = {"model": "XM430-W350", "reference": math.pi} if protocol == 2.0 else {"model": "MX-64"}
    plan = make_plan((1, 2, 3), protocol=protocol, return_delay_ns=0, **change)
    plan = replace(plan, servos=tuple(replace(one, settings=registers) for one in plan.servos))
    rig = start_rig(plan)
    started, wishes = len(rig.into_bus()), Wishes(rig, declared)
    for cycle in range(400):
        if cycle < 250 and chance.random() < 0.15:
            name = chance.choice(tuple(places))
            most = 2 if name == "led" else 250
            wishes.ask(chance.randrange(3), name, chance.randrange(most))
        if cycle < 250 and chance.random() < 0.05:
            random_fault(rig, chance)
        rig.cycle()
    return rig, wishes, started


@campaign(ci=3, night=100, release=600)
@pytest.mark.parametrize("protocol", [1.0, 2.0])
def test_each_request_in_a_storm_is_answered_once_and_registers_have_its_value(protocol, number, chance):
    rig, wishes, started = storm(protocol, chance)
    assert all(len(answers) == 1 for answers in wishes.answers)
    assert [one for one in rig.writes(started) if one[1] < RAM[protocol]] == []  # of the EEPROM
    assert rig.states.valid.all()
    for row, servo in enumerate(rig.buses[0].servos):
        for (owner, name), possible in wishes.possible.items():
            if owner == row:
                assert servo.registers[name] in possible, (row, name)
