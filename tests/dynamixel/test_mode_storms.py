"""Mode changes while the line and the servos fail: no servo ever gets a goal that another mode would follow.

A storm is 8 s of a robot at 50 Hz; CI runs two of each robot, `pytest --campaign=release FILE` 300.
"""

import numpy as np
import pytest
from tests.kit.campaigns import campaign
from tests.kit.rigs import make_plan, random_fault, start_rig

from dxlrun.channels.event_records import EventCode
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
    ),
    "mx": ("MX-64", 1.0, (Mode.POSITION, Mode.VELOCITY, Mode.EFFORT)),
    "ax": ("AX-12A", 1.0, (Mode.POSITION, Mode.VELOCITY, Mode.PWM)),
}


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
    """Let a robot change modes in a storm, and judge each cycle; return the robot at rest again."""
    model, protocol, modes = ROBOTS[name]
    change = {"reference": np.pi} if protocol == 2.0 else {}
    rig = start_rig(make_plan((1, 2, 3), model=model, protocol=protocol, return_delay_ns=0, **change))
    for cycle in range(400):
        if cycle < 250 and chance.random() < 0.08:
            wishes(rig, chance, modes)
        if cycle < 250 and chance.random() < 0.05:
            random_fault(rig, chance)
        follow(rig, -0.02 if cycle % 2 else 0.02)  # one that stays is not sent
        seen = len(rig.into_bus())
        rig.hardware.read_states()
        rig.hardware.write_goals()
        judge(rig, rig.goals_sent(seen))
        rig.hardware.idle(rig.clock.now_ns() + chance.choice((2_000_000, 12_000_000)))
        rig.clock.wait_until(2_000_000_000 + cycle * rig.period_ns)
    return rig


@campaign(ci=2, night=50, release=300)
@pytest.mark.parametrize("name", ROBOTS)
def test_servo_gets_only_goals_of_its_mode_which_is_known_after_the_storm(name, number, chance):
    rig = storm(name, chance)
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
