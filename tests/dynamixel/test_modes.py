"""Modes on the wire: a model is brought into each mode that it has, follows its goals, and never jumps.

`cases/modes.txt` has what is written for a change, and what refuses one.
"""

import math

import numpy as np
import pytest
from msgspec.structs import replace
from tests.kit.line_faults import truncate_next, turn_by_hand
from tests.kit.rigs import every_servo, make_plan, make_rig, start_rig

from dxlrun.channels.event_records import EventCode
from dxlwire.bus_plan import RegisterValue
from dxlwire.control_table import find_table
from dxlwire.modes import Mode
from dxlwire.plan.mode_plan import mode_in
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


def make_pair(**change):
    """Return a plan of two XM430-W350."""
    x = {"model": "XM430-W350", "protocol": 2.0, "reference": np.pi, "return_delay_ns": 0}
    return make_plan((1, 2), **x | change)


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
    plan = make_pair()
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


def test_goals_keep_within_the_servos_own_limit_beyond_which_it_would_refuse_them():
    rig = make_rig(make_pair())
    rig.servo(1).poke("velocity_limit", 50)
    rig.servo(1).poke("current_limit", 100)
    rig.hardware.start()
    for mode, goal, item, held in ((V, -9.0, "goal_velocity", 50), (E, 3.0, "goal_current", -100)):
        change(rig, mode)
        command(rig, mode, goal)
        moved(rig, 2)
        assert rig.servo(1).registers.ticks(item) == held


def test_joint_of_a_second_bus_changes_its_own_mode():
    x = {"model": "XM430-W350", "protocol": 2.0, "reference": np.pi, "return_delay_ns": 0}
    rig = start_rig(make_plan((1,), **x), make_plan((2,), name="other", first_row=1, **x))
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


def make_wheel(model="XM430-W350", protocol=2.0, **more):
    """Two continuous joints that get torque again when they return, of which the first is tested."""
    plan = make_plan(
        (1, 2), model=model, protocol=protocol, reference=math.pi, return_delay_ns=0, **ENDLESS, **more
    )
    return start_rig(every_servo(plan, torque_on_return=True))


def test_a_joint_that_forgot_its_turns_over_a_reboot_does_not_wind_them_up_again():
    rig = make_wheel(start_mode=P)
    for _ in range(300):
        rig.goals.position[0] += 0.04
        rig.cycle()
    servo = rig.servo(1)
    servo.cut_power(rig.clock.now_ns() + 300_000_000)
    standing = servo.shaft_angle
    rig.cycles(150)
    assert rig.states.valid[0]
    assert servo.shaft_angle == pytest.approx(standing, abs=0.1)
    assert rig.torque() == [False, True]
    (text,) = rig.events.texts(EventCode.SERVO_LIMP)
    assert "lost its turn count" in text
    assert "switch its torque on with `dxlrun torque on main_1_joint`" in text
    assert rig.events.of(EventCode.IMPLAUSIBLE) == [], "its position is another one for a known reason"
    rig.hardware.switch_torque(0, True)
    rig.cycles(20)
    assert rig.torque() == [True, True]
    assert servo.shaft_angle == pytest.approx(standing, abs=0.1)


def test_a_wheel_that_made_more_turns_than_its_servo_counts_does_not_wind_them_back():
    rig = make_wheel("MX-28", 1.0)
    servo = rig.servo(1)
    turn_by_hand(servo, 7.8 * math.tau)
    standing = servo.shaft_angle
    rig.set_modes(P, 0)
    rig.cycles(60)
    assert servo.shaft_angle == pytest.approx(standing, abs=0.1)
    ((source, text),) = rig.events.of(EventCode.MODE)[-1:]
    assert (source, "outside its limits" in text) == ("main_1_joint", True)


def test_a_wheel_that_coasted_a_little_over_its_last_turn_is_led_back_and_keeps_its_torque():
    rig = make_wheel("MX-28", 1.0)
    plan = rig.plans[0].servos[0]
    upper = plan.mode_plan(P).upper_tick
    turn_by_hand(rig.servo(1), (upper + 100) * plan.rad_per_tick)
    change(rig, P)
    assert rig.torque() == [True, True]
    assert rig.servo(1).registers["goal_position"] == upper


@pytest.mark.parametrize("beyond", [100, 800])
def test_a_joint_that_coasted_over_its_limits_is_led_back_slowly_and_does_not_fall(beyond):
    arm = make_one("XM430-W350", 2.0, lower=-1.0, upper=1.0)
    servo, plan = arm.servo(1), arm.plans[0].servos[0]
    change(arm, E)
    turn_by_hand(servo, (plan.upper_tick + beyond) * plan.rad_per_tick)
    change(arm, P)
    assert arm.torque() == [True, True]
    assert servo.registers["goal_position"] == plan.upper_tick
    assert 0 < servo.registers["profile_velocity"] * plan.rad_s_per_tick <= 0.51


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
    rebooted = []
    for number in range(1, 60):
        rig = make_one(model, protocol)
        servo = rig.servo(1)
        rig.set_modes(V, 0)

        def reset(rig=rig, servo=servo, number=number):
            if rig.states.mode[0] == Mode.UNKNOWN:
                rebooted.append(number)
                servo.cut_power(rig.clock.now_ns() + 1)

        rig.buses[0].after(number, reset)
        rig.cycles(40)
        if number not in rebooted:
            break
        assert not servo.torque_on, number
    assert len(rebooted) > 10


# Limits of the torque


def limit_torque(rig, full, share):
    """Let a policy reduce the torque of all servos."""
    rig.hardware._full_torque = [[full, full]]
    rig.hardware.limit_torque(share)


def test_a_torque_limit_weakens_a_servo_that_follows_a_pwm_and_does_not_drive_it(arm):
    change(arm, W)
    command(arm, W, 0.0)
    moved(arm, 3)
    limit_torque(arm, 885, 0.1)
    assert abs(moved(arm)) < 0.001
    command(arm, W, 1.0)
    moved(arm, 2)
    assert abs(arm.servo(1).registers.ticks("goal_pwm")) == 88


def test_no_torque_limit_is_written_while_a_mode_changes(arm):
    arm.set_modes(W, 0)
    limit_torque(arm, 885, 0.5)
    arm.torque()
    assert arm.registers("goal_pwm") == [885, 442]


@pytest.fixture
def limited(ax):
    """AX-12A whose positions have a limit of the effort: Torque Limit (34)."""
    change(ax, C, rows=(0, 1))
    return ax


def test_a_servo_of_protocol_1_goes_to_a_position_with_no_more_torque_than_its_limit(limited):
    """Its shaft is blocked, so that what it exerts is what it may."""
    limited.servo(1).jam_shaft(True)
    command(limited, C, 0.5)
    for effort, ticks in ((0.2, 205), (0.5, 512), (0.1, 102)):
        limited.goals.effort[0] = effort
        moved(limited, 10)
        assert abs(limited.states.effort[0]) == pytest.approx(effort, abs=0.002)
        assert limited.registers("torque_limit") == [ticks, 1023]


def test_torque_limit_is_never_set_to_0_which_means_a_shutdown(limited):
    """A servo that shut itself down has 0 there, which the next start refuses."""
    limited.goals.effort[:] = 0.0
    for rig in (limited, make_one("AX-12A", 1.0)):
        limit_torque(rig, 1023, 0.0)
        moved(rig, 3)
        assert rig.registers("torque_limit") == [1, 1]


@pytest.mark.parametrize(("mode", "goal"), [(P, 30), (V, 32)])
def test_another_mode_gives_all_torque_back_once_the_goal_moves_nothing(limited, mode, goal):
    limited.servo(1).poke("max_torque", 800)
    limited.goals.effort[:] = 0.3
    moved(limited, 3)
    since = len(limited.into_bus())
    change(limited, mode)
    assert limited.registers("torque_limit") == [800, 307]
    written = [address for servo_id, address, _ in limited.writes(since) if servo_id == 1]
    assert written.index(goal) < written.index(34)
    assert limited.torque() == [True, True]


def test_a_policy_that_reduces_torque_is_not_undone_by_a_servo_that_returns(ax):
    limit_torque(ax, 1023, 0.5)
    with ax.away(1, 15):
        pass
    assert ax.events.of(EventCode.SERVO_BACK)
    assert ax.registers("torque_limit") == [512, 512]


def test_a_servo_that_returns_in_another_mode_has_all_its_torque(limited):
    limited.goals.effort[:] = 0.3
    moved(limited, 3)
    with limited.away(1, 15, 20):
        limited.set_modes(P, 0)
    assert limited.states.mode[0] == P
    assert limited.registers("torque_limit") == [1023, 307]


@pytest.mark.parametrize(
    "shut", [lambda servo: servo.trigger_overload(), lambda servo: servo.set_voltage(5.0)]
)
def test_a_servo_that_shut_itself_down_gets_no_torque_back_by_a_limit(limited, shut):
    """Torque Limit (34) becomes 0, Torque Enable (24) stays 1, and a write of the limit would revive it."""
    servo = limited.servo(1)
    servo.poke("shutdown", 0x25)
    for number in range(30):
        limited.goals.effort[:] = 0.3 + 0.01 * number
        if number == 10:
            shut(servo)
        limited.cycle()
        assert number < 10 or servo.registers["torque_limit"] == 0
    assert limited.events.of(EventCode.SERVO_LIMP)
    for mode in (P, C):
        limited.set_modes(mode, 0)
        limited.cycles(20)
        assert servo.registers["torque_limit"] == 0
