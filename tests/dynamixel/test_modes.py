"""Modes on the wire, and changes of them while the line fails: no servo follows a goal of another mode."""

import math

import numpy as np
import pytest
from msgspec.structs import replace
from tests.kit.campaigns import campaign
from tests.kit.line_faults import truncate_next
from tests.kit.rigs import every_servo, make_plan, make_rig, make_x, random_fault, start_rig

from dxlrun.channels.event_records import EventCode
from dxlwire.bus_plan import RegisterValue
from dxlwire.control_table import find_table
from dxlwire.modes import Mode
from dxlwire.plan.mode_plan import in_mode, mode_in
from dxlwire.wire import protocol2

P, V, E, W, C = Mode.POSITION, Mode.VELOCITY, Mode.EFFORT, Mode.PWM, Mode.EFFORT_POSITION
FAMILIES = {
    ("AX-12A", 1.0): {P, V, W, C},
    ("RX-10", 1.0): {P, V, W, C},
    ("RX-64", 1.0): {P, V, W, C},
    ("EX-106+", 1.0): {P, V, W, C},
    ("MX-28", 1.0): {P, V, C},
    ("MX-12W", 1.0): {P, V, C},
    ("MX-64", 1.0): {P, V, E, C},
    ("MX-106", 1.0): {P, V, E, C},
    ("MX-28", 2.0): {P, V, W},
    ("MX-64", 2.0): {P, V, E, W, C},
    ("XL-320", 2.0): {P, V, W},
    ("XL330-M288", 2.0): {P, V, E, W, C},
    ("XL430-W250", 2.0): {P, V, W},
    ("XM430-W350", 2.0): {P, V, E, W, C},
    ("XH540-W270", 2.0): {P, V, E, W, C},
    ("PH54-200-S500", 2.0): {P, V, E, W},
    ("RH-P12-RN(A)", 2.0): {P, E, C},
    ("XM335-T323", 2.0): {P, V, E, W, C},
    ("XC335-T332", 2.0): {P, V, E, W, C},
    ("H54-200-S500-R", 2.0): {P, V, E},
    ("M42-10-S260-R", 2.0): {P, V, E},
    ("L54-50-S290-R", 2.0): {P, V, E},
    ("L42-10-S300-R", 2.0): {P, V},
    ("RH-P12-RN", 2.0): {P, E, C},
}
"""What the e-Manual's pages of the models say."""
ENDLESS = {"continuous": True, "lower": -math.inf, "upper": math.inf}


def make_one(model, protocol, **change):
    """Two servos of a model, in the middle of their travel, started."""
    table = find_table(model, protocol)
    limits = [table.items.get(f"{end}_position_limit") for end in ("min", "max")]
    low, high = (
        given if item is None else item.initial
        for given, item in zip((table.min_tick, table.max_tick), limits, strict=True)
    )
    middle = (low + high) / 2 * table.rad_per_tick
    reach = 0.45 * (high - low) * table.rad_per_tick
    given = {"reference": middle, "lower": -reach, "upper": reach, "return_delay_ns": 0} | change
    return start_rig(make_plan((1, 2), model=model, protocol=protocol, **given), position=middle or 0.001)


def change(rig, mode, rows=(0,), cycles=60):
    """Ask for a mode, and wait until the servos are in it; goals are where the joint is then."""
    rig.set_modes(*(mode if row in rows else 0 for row in range(len(rig.states.mode))))
    for _ in range(1, cycles):
        rig.cycle()
        if all(rig.states.mode[row] == mode for row in rows):
            rig.cycle()
            return
    raise AssertionError(rig.events.texts(EventCode.MODE))


def command(rig, mode, value):
    """Give the first joint a goal of a mode, and no other."""
    rig.goals.values[:, 0] = np.nan
    led = {V: rig.goals.velocity, E: rig.goals.effort, W: rig.goals.pwm}
    led.get(mode, rig.goals.position)[0] = value


def moved(rig, cycles=15):
    """Return how far the first joint's servo turns in some cycles, rad of the joint."""
    servo, plan = rig.servo(1), rig.plans[0].servos[0]
    before = servo.shaft_angle
    rig.cycles(cycles)
    return plan.direction * (servo.shaft_angle - before)


@pytest.mark.parametrize(("model", "protocol"), FAMILIES)
def test_a_model_has_the_modes_of_its_manual(model, protocol):
    plan = make_plan((1,), model=model, protocol=protocol, reference=1.0, lower=-0.5, upper=0.5)
    assert {mode.mode for mode in plan.servos[0].modes} == FAMILIES[model, protocol]


@pytest.mark.parametrize(
    ("model", "protocol", "mode"),
    [
        pytest.param(model, protocol, mode, id=f"{model}-{protocol:g}-{mode.name.lower()}")
        for (model, protocol), modes in FAMILIES.items()
        for mode in sorted(modes - {P})
    ],
)
def test_a_model_goes_into_a_mode_follows_its_goals_there_and_comes_back(model, protocol, mode):
    rig = make_one(model, protocol)
    standing = rig.servo(1).shaft_angle
    change(rig, mode)
    assert rig.servo(1).shaft_angle == pytest.approx(standing, abs=0.02), "it jumped"
    # of the output of an XL-320, which is no controlled speed, friction takes 9 %
    goal = {V: 3.0 if model == "XL-320" else 0.4, W: 0.2, C: 0.1}.get(mode, 0.0)
    if mode is E:
        effort = rig.plans[0].servos[0].mode_plan(mode).effort
        goal = effort.per_tick * effort.most * 0.15
    command(rig, mode, goal)
    assert moved(rig) > 0.0005
    command(rig, mode, -goal)
    moved(rig, 10 if mode is E else 3)
    assert moved(rig) < -0.0005
    change(rig, P)
    assert rig.torque() == [True, True]
    assert rig.events.of(EventCode.SERVO_LIMP) == []


@pytest.fixture
def arm():
    return make_one("XM430-W350", 2.0)


@pytest.fixture
def ax():
    return make_one("AX-12A", 1.0)


def test_what_the_file_declares_holds_in_another_mode_whose_own_values_differ():
    """A change resets gains "properly to the selected Operating Mode" (e-Manual, X series, Operating Mode
    (11)), which does not say to what: here to 400, and more than the manual names."""
    items = find_table("XM430-W350", 2.0).items
    plan = make_x((1, 2))
    declared = tuple(
        RegisterValue(items[name].address, items[name].size, value, name)
        for name, value in (("position_p_gain", items["position_p_gain"].initial), ("led", 1))
    )
    rig = make_rig(replace(plan, servos=(replace(plan.servos[0], settings=declared), plan.servos[1])))
    for servo in rig.buses[0].servos:

        def reset(servo=servo, before=servo._change_mode):
            before()
            servo.poke("position_p_gain", 400)
            servo.poke("led", 0)

        servo._change_mode = reset
    rig.hardware.start()
    rig.servo(2).poke("led", 1)
    change(rig, C, rows=(0, 1))
    assert (rig.registers("position_p_gain"), rig.registers("led")) == ([800, 400], [1, 0])


def test_joint_of_a_second_bus_changes_its_own_mode():
    rig = start_rig(make_x((1,)), make_x((2,), name="other", first_row=1))
    for row in (0, 1):
        change(rig, V, rows=(row,))
    assert rig.servo(2, bus=1).registers["operating_mode"] == 1


def test_of_two_modes_that_are_selected_alike_the_one_of_the_start_counts():
    """An AX in wheel mode follows a velocity or a PWM by the same register."""
    wheel = {"cw_angle_limit": 0, "ccw_angle_limit": 0}
    for mode in (V, W):
        plan = make_plan((1,), start_mode=mode, **ENDLESS)
        assert mode_in(plan.servos[0], wheel) is mode


@pytest.mark.parametrize(("model", "protocol"), [("XM430-W350", 2.0), ("MX-28", 1.0), ("PH54-200-S500", 2.0)])
def test_a_continuous_joint_turns_as_a_wheel_and_goes_to_positions_over_turns(model, protocol):
    plan = make_plan((1, 2), model=model, protocol=protocol, reference=0.0, return_delay_ns=0, **ENDLESS)
    rig = start_rig(plan, position=0.5)
    assert rig.states.mode.tolist() == [V, V]
    command(rig, V, 2.0)
    assert moved(rig, 60) > 2.0 * 60 * 0.02 * 0.8
    assert rig.states.velocity[0] == pytest.approx(2.0, rel=0.05)
    change(rig, P)
    began = rig.states.position[0]
    command(rig, P, began - 7.0)
    moved(rig, 300)
    assert rig.states.position[0] == pytest.approx(began - 7.0, abs=0.02)


def test_a_wheel_of_a_model_that_controls_no_speed_reports_its_speed_in_the_same_unit():
    rig = start_rig(make_plan((1, 2), return_delay_ns=0, **ENDLESS))
    command(rig, V, 3.0)
    assert moved(rig, 50) / (50 * 0.02) == pytest.approx(3.0, rel=0.1)
    assert rig.states.velocity[0] == pytest.approx(3.0, rel=0.05)


def test_a_servo_that_lost_its_torque_over_a_change_gets_no_goal_which_would_switch_it_on(ax):
    ax.servo(1).poke("lock", 1)
    since = len(ax.into_bus())
    ax.set_modes(V, 0)
    for _ in range(2):
        ax.hardware.read_states()
        ax.hardware.write_goals()
        ax.hardware.idle(ax.clock.now_ns() + 15_000_000)
    assert ax.states.mode[0] == P
    assert [1 in named for _, named in ax.goals_sent(since)] == [False, False], (
        "torque enable was not read yet"
    )


def test_a_servo_whose_torque_could_not_be_read_after_a_change_gets_no_goal_until_it_was(arm):
    ask, asked, goals = protocol2.read_range(1, 64, 1), [], []

    def lose():
        asked.append(arm.clock.now_ns())
        if 3 <= len(asked) <= 5:  # the first one is before the change, the second one reads torque on back
            truncate_next(arm.buses[0], 1, 0)

    arm.when(lambda data: data == ask, lose)
    arm.when(lambda data: data[7] == 0x83 and 1 in data[12:-2:5], lambda: goals.append(len(asked)))
    change(arm, V)
    for turn in range(10):
        arm.goals.velocity[0] = 0.01 * turn
        arm.cycle()
    assert goals
    assert goals[0] == 6


@pytest.mark.parametrize(("model", "protocol"), [("XM430-W350", 2.0), ("AX-12A", 1.0)])
def test_a_servo_that_reboots_in_its_own_mode_change_gets_no_torque_by_that(model, protocol):
    """Before each packet of the change; the policy for returned servos is limp."""
    rebooted, given = [], []
    for number in range(1, 60):
        rig = make_one(model, protocol)
        servo = rig.servo(1)
        rig.set_modes(V, 0)

        def reset(rig=rig, servo=servo, number=number):
            if rig.states.mode[0] == Mode.UNKNOWN:
                rebooted.append(number)
                servo.cut_power(rig.clock.now_ns() + 1)
                given.append(rig.torque_given(1))

        rig.buses[0].after(number, reset)
        rig.cycles(40)
        if number not in rebooted:
            break
        assert not servo.torque_on, number
    assert len(rebooted) > 10
    assert sum(map(any, given)) <= 2, "it gets torque only where it reboots after the last check before that"


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
