"""Changes of modes and registers while the line and the servos fail.

No servo ever gets a goal that another mode would follow, each request for a register is answered once, and a
confirmed value is there. A storm is 8 s of a robot at 50 Hz; CI runs two of each robot,
`pytest --campaign=release FILE` 300.
"""

import numpy as np
import pytest
from tests.kit.campaigns import campaign
from tests.kit.rigs import every_servo, make_plan, random_fault, start_rig

from dxlrun.channels.event_records import EventCode
from dxlwire.bus_plan import RegisterValue
from dxlwire.control_table import find_table
from dxlwire.modes import Mode
from dxlwire.plan.mode_plan import in_mode

FOLLOWED = {
    2.0: {100: {16}, 102: {0, 5}, 104: {1}, 112: {3, 4, 5}},
    1.0: {30: {"joint"}, 32: {"wheel"}, 71: {"torque"}},
}
"""First address of a block of goals -> the modes that follow it (e-Manual XM430-W350, MX-64)."""
ROBOTS = {
    "x": (
        "XM430-W350",
        2.0,
        (Mode.POSITION, Mode.VELOCITY, Mode.EFFORT, Mode.PWM, Mode.EFFORT_POSITION),
        ("position_p_gain", "position_d_gain"),
    ),
    "mx": ("MX-64", 1.0, (Mode.POSITION, Mode.VELOCITY, Mode.EFFORT), ("p_gain", "d_gain")),
    "ax": ("AX-12A", 1.0, (Mode.POSITION, Mode.VELOCITY, Mode.PWM), ("cw_compliance_slope",)),
}
"""Model, protocol, modes, and the registers that the robot file declares."""
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
        answers = []
        self.answers.append(answers)
        self.possible.setdefault((row, name), {0}).add(value)

        def done(problem, _found):
            answers.append(problem)
            if not problem:
                self.possible[row, name] = {value}

        self.rig.hardware.write_register(row, name, value, done)


def selected(servo, protocol):
    """Return what a simulated servo's registers select."""
    registers = servo.registers
    if protocol == 2.0:
        return registers["operating_mode"]
    if registers.get("torque_ctrl_mode_enable"):
        return "torque"
    return "wheel" if registers["cw_angle_limit"] == registers["ccw_angle_limit"] == 0 else "joint"


def wishes(rig, chance, modes):
    wanted = np.zeros(3, dtype=np.uint8)
    wanted[chance.randrange(3)] = chance.choice(modes)
    rig.hardware.set_modes(wanted)


def follow(rig, goal):
    """Give each joint a goal of the mode that it is in; while that changes the old one stays."""
    for row, mode in enumerate(rig.states.mode):
        if mode != Mode.UNKNOWN:
            for array in (rig.goals.velocity, rig.goals.effort, rig.goals.pwm, rig.goals.position):
                array[row] = np.nan
            leading = {
                Mode.VELOCITY: rig.goals.velocity,
                Mode.EFFORT: rig.goals.effort,
                Mode.PWM: rig.goals.pwm,
            }
            leading.get(Mode(mode), rig.goals.position)[row] = goal


def judge(rig, sent):
    """Every servo that a sync write of goals names is in a mode that follows them."""
    protocol = rig.plans[0].protocol
    for address, named in sent:
        for servo_id in named if address in FOLLOWED[protocol] else ():
            mode = selected(rig.servo(servo_id), protocol)
            assert mode in FOLLOWED[protocol][address], (address, servo_id, mode)


def storm(name, chance):
    """Let a robot change modes and registers in a storm, and judge each cycle.

    Return the robot at rest again, and the wishes.
    """
    model, protocol, modes, names = ROBOTS[name]
    items = find_table(model, protocol).items
    declared = dict.fromkeys(names, 20)
    settings = tuple(
        RegisterValue(items[one].address, items[one].size, value, one) for one, value in declared.items()
    )
    change = {"reference": np.pi} if protocol == 2.0 else {}
    plan = make_plan((1, 2, 3), model=model, protocol=protocol, return_delay_ns=0, **change)
    rig = start_rig(every_servo(plan, settings=settings))
    begun, registers = len(rig.into_bus()), Wishes(rig, declared)
    for cycle in range(400):
        if cycle < 250 and chance.random() < 0.08:
            wishes(rig, chance, modes)
        if cycle < 250 and chance.random() < 0.08:
            one = chance.choice((*names, "led"))
            registers.ask(chance.randrange(3), one, chance.randrange(2 if one == "led" else 250))
        if cycle < 250 and chance.random() < 0.05:
            random_fault(rig, chance)
        follow(rig, -0.02 if cycle % 2 else 0.02)  # one that stays is not sent
        seen = len(rig.into_bus())
        rig.hardware.read_states()
        rig.hardware.write_goals()
        judge(rig, rig.goals_sent(seen))
        rig.hardware.idle(rig.clock.now_ns() + chance.choice((2_000_000, 12_000_000)))
        rig.clock.wait_until(2_000_000_000 + cycle * rig.period_ns)
    selecting = {value.address for mode in plan.servos[0].modes for value in mode.operating}
    eeprom = {address for _, address, _ in rig.writes(begun) if address < RAM[protocol]}
    assert eeprom <= selecting
    return rig, registers


@campaign(ci=2, night=50, release=300)
@pytest.mark.parametrize("name", ROBOTS)
def test_servo_gets_only_goals_of_its_mode_and_has_its_registers_after_the_storm(name, number, chance):
    rig, wanted = storm(name, chance)
    out = (EventCode.SERVO_LIMP, EventCode.SERVO_LOST, EventCode.SERVO_REBOOTED)
    excused = {source for code in out for source, _ in rig.events.of(code)}
    assert rig.plans[0].servos
    for servo in rig.plans[0].servos:
        registers = rig.servo(servo.servo_id).registers
        found = {value.name: registers[value.name] for mode in servo.modes for value in mode.operating}
        known = Mode(int(rig.states.mode[servo.row]))
        if known is not Mode.UNKNOWN:
            assert in_mode(servo.mode_plan(known), found), (known, found)
        if servo.joint not in excused:
            assert known is not Mode.UNKNOWN, f"it is not known in which mode {servo.joint} is"
            assert rig.torque()[servo.row], f"{servo.joint} lost its torque over a change"
    assert all(len(answers) == 1 for answers in wanted.answers)
    for (row, item), possible in wanted.possible.items():
        assert rig.buses[0].servos[row].registers[item] in possible, (row, item)
