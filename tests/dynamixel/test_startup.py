import itertools
from functools import partial

import pytest
from msgspec.structs import replace
from tests.kit.line_faults import corrupt_next, delay_next, disturb_replies, truncate_next, turn_by_hand
from tests.kit.rigs import make_plan, make_rig, make_x, start_rig

from dxlrun.channels.event_records import EventCode, Severity
from dxlrun.dynamixel.remedies import INJECTED
from dxlrun.dynamixel.servo.checks import _silence
from dxlrun.errors import PortError, StartUpError, help_link
from dxlsim.bus.simulated_bus import PacketFault
from dxlsim.bus.simulated_line import flipped
from dxlsim.simulation_plan import ServoConfig
from dxlwire.wire import protocol1


def refusal(rig):
    """Return what start says when it refuses; no servo may have torque then, and no register was written."""
    with pytest.raises(StartUpError) as caught:
        rig.hardware.start()
    at = 4 if rig.plans[0].protocol == 1.0 else 7
    assert {packet[at] for packet in rig.into_bus()} <= {1, 2}
    return str(caught.value).splitlines()


def test_a_servo_that_is_not_there_is_named_with_all_the_others():
    rig = make_rig()
    rig.servo(3).silence()
    rig.servo(20).silence()
    rig.servo(6).poke("model_number", 29)
    silent, other = refusal(rig)
    assert "ID 6 on bus main" in other
    assert silent == (
        "2 servos on bus main do not answer: main_3_joint (ID 3), main_20_joint (ID 20); "
        f"check the IDs and baud rate (1000000 bit/s); {help_link('one-servo-does-not-answer')}"
    )
    rig = make_rig()
    rig.servo(3).silence()
    (problem,) = refusal(rig)
    assert problem.startswith("main_3_joint (ID 3 on bus main) does not answer: check its ID and baud")


@pytest.mark.parametrize(
    ("lacks", "for_replies"),
    [(lambda servo: servo.silence(), True), (lambda servo: servo.poke("model_number", 29), False)],
)
def test_refusal_is_for_replies_only_when_one_is_missing(lacks, for_replies):
    rig = make_rig()
    lacks(rig.servo(6))
    with pytest.raises(StartUpError) as caught:
        rig.hardware.start()
    assert caught.value.for_replies is for_replies


def test_the_end_of_the_set_up_without_torque_is_reported_before_the_first_torque():
    rig, seen = make_rig(), []
    rig.hardware.start(lambda: seen.append((rig.torque(), len(rig.into_bus()))))
    ((torque, packets),) = seen
    assert torque == [False] * 8
    assert packets > 8  # all were inspected
    assert rig.torque() == [True] * 8


@pytest.mark.parametrize("number", range(6))
def test_noise_in_one_reply_of_the_start_refuses_no_servo(number):
    rig = make_rig(make_plan((1,)))
    disturb_replies(rig.buses[0], 1, {number: PacketFault("noise", lambda reply: flipped(reply, -1, 1))})
    rig.hardware.start()
    assert rig.torque() == [True]


def test_servos_that_are_all_silent_are_one_sentence_within_two_seconds():
    rig = make_rig()
    for servo in rig.buses[0].servos:
        servo.silence()
    before = rig.clock.now_ns()
    (problem,) = refusal(rig)
    assert rig.clock.now_ns() - before < 2_000_000_000
    assert problem.startswith("none of the 8 servos on bus main answers: main_1_joint (ID 1), main_3")
    plan = replace(rig.plans[0], port="/dev/ttyUSB0")
    real = _silence(plan, plan.servos)
    assert "check its power, cable, port and baud" in real
    assert "list the servos with `dxlrun scan /dev/ttyUSB0`" in real
    assert "main_1_joint (ID 1)" in problem
    assert " and IDs " in problem


@pytest.mark.parametrize(
    ("plan", "register", "value", "said"),
    [
        (make_plan(), "model_number", 29, "is model number 29, not a AX-12A"),
        (
            make_plan(),
            "status_return_level",
            0,
            f"did not answer 3 reads of Model Number (0): {INJECTED}",
        ),
        (make_plan((1, 6), model="MX-106"), "drive_mode", 1, "this value turns it the other way round"),
        (make_plan((1, 6), model="EX-106+"), "drive_mode", 1, "this value turns it the other way round"),
        (
            make_x((1, 6)),
            "status_return_level",
            0,
            f"did not answer 3 reads of Model Number (0): {INJECTED}",
        ),
        (make_x((1, 6)), "max_position_limit", 2100, "has position limits 0..2100, narrower than the"),
    ],
    ids=lambda one: one if isinstance(one, str | int) else "",
)
def test_a_register_that_does_not_fit_is_refused_and_nothing_is_written(plan, register, value, said):
    """test_checks.py has the others."""
    rig = make_rig(plan)
    rig.servo(6).poke(register, value)
    problem, *_ = refusal(rig)
    assert "_6_joint (ID 6 on bus " in problem
    assert said in problem


def test_a_servo_in_wheel_mode_is_brought_back_to_joint_mode_before_it_gets_torque():
    rig = make_rig()
    for limit in ("cw_angle_limit", "ccw_angle_limit"):
        rig.servo(6).poke(limit, 0)
    rig.hardware.start()
    servo, plan = rig.servo(6), rig.plans[0].servos[3]
    found = (servo.registers["cw_angle_limit"], servo.registers["ccw_angle_limit"])
    assert found == (plan.lower_tick, plan.upper_tick)
    ((source, text),) = rig.events.of(EventCode.MODE)
    assert (source, "CW Angle Limit (6) was 0" in text) == ("main_6_joint", True)
    writes = [packet for packet in rig.into_bus() if packet[2] == 6 and packet[4] == 3]
    assert [packet[5] for packet in writes] == [8, 30, 24]  # the lower limit is 0 already


def test_one_servo_may_have_several_problems():
    rig = make_rig()
    rig.servo(6).poke("model_number", 29)
    rig.servo(6).poke("torque_enable", 1)
    rig.servo(2).poke("ccw_angle_limit", 3)
    assert len(refusal(rig)) == 3


@pytest.mark.parametrize("delay_ns", [500_000, 440_000, 200_000])
def test_two_servos_of_one_id_are_named(delay_ns):
    rig = make_rig(extra=(ServoConfig(5, "AX-12A", 0.7, delay_ns),))
    problems = refusal(rig)
    assert all("ID 5" in problem for problem in problems)
    assert "do two servos have its ID?" in problems[0] or "two servos with one ID" in problems[0]


@pytest.mark.parametrize(
    ("spoil", "times", "said"),
    [
        ("twice", 1, ""),
        ("twice", 2, "answers 2 of 3 pings garbled or twice"),
        ("lost", 1, ""),
        ("lost", 2, "answers only 1 of 3 pings"),
    ],
)
def test_one_of_three_pings_may_be_spoilt_and_no_more(spoil, times, said):
    rig = make_rig()
    for _ in range(times):
        if spoil == "twice":
            rig.buses[0].alter_next(6, "twice", bytes, copies=2)
        else:
            truncate_next(rig.buses[0], 6, 0)
    if not said:
        rig.hardware.start()
        assert rig.torque() == [True] * 8
        return
    (problem,) = refusal(rig)
    assert f"ID 6 on bus main) {said}" in problem


def test_an_adapter_that_echoes_is_named():
    rig = make_rig()
    rig.buses[0].echo = True
    (problem,) = refusal(rig)
    assert "echoes" in problem


def test_a_return_delay_beside_the_plan_is_reported_with_its_consequence():
    rig = make_rig()
    rig.servo(1).poke("return_delay_time", 0)
    rig.hardware.start()
    ((joint, text),) = rig.events.of(EventCode.REGISTER_DIFFERS)
    assert joint == "main_1_joint"
    assert "Return Delay Time (5) is 0" in text
    assert "takes 2.1 ms instead of 6.1 ms" in text


def test_a_joint_outside_its_limits_is_not_moved():
    rig = make_rig(make_plan((1, 2), lower=-1.0, upper=1.0), position=4.5)
    problems = refusal(rig)
    assert len(problems) == 2
    assert "move the joint inside by hand" in problems[0]


@pytest.mark.parametrize("end", ["lower_tick", "upper_tick"])
@pytest.mark.parametrize(("beyond", "starts"), [(1, True), (2, False)])
def test_a_joint_may_stand_one_tick_outside_its_limits_and_no_more(end, beyond, starts):
    """The reading of a potentiometer at the limit alternates between two ticks."""
    plan = make_plan((1, 2), lower=-1.0, upper=1.0)
    rig = make_rig(plan)
    servo = plan.servos[0]
    out = beyond if end == "upper_tick" else -beyond
    turn_by_hand(rig.servo(1), (getattr(servo, end) + out) * servo.rad_per_tick)
    if not starts:
        (problem,) = refusal(rig)
        assert "main_1_joint (ID 1 on bus main) is at" in problem
        assert "outside its limits -57.0..57.0 deg" in problem
        return
    rig.hardware.start()
    assert rig.torque() == [True, True]
    assert rig.servo(1).registers["goal_position"] == getattr(servo, end)


def after_first_state(rig, servo_id, act):
    """Do something once a servo has answered the first reading of its state, before the second one."""
    seen = []

    def read():
        seen.append(servo_id)
        if len(seen) == 2:
            act()

    # present position of an AX-12
    rig.when(lambda data: (data[2], data[4], data[5]) == (servo_id, 2, 36), read)


@pytest.mark.parametrize(("jump", "starts"), [(0.05, True), (-0.05, True), (0.8, False), (-0.8, False)])
def test_a_servo_that_jumps_between_two_readings_of_its_state_gets_no_torque(jump, starts):
    """Between them pass 5.7 ms for eight servos: at 11.9 rad/s that is 0.07 rad."""
    rig = make_rig()
    servo = rig.servo(6)
    after_first_state(rig, 6, lambda: turn_by_hand(servo, servo.shaft_angle + jump))
    if starts:
        rig.hardware.start()
        assert rig.torque() == [True] * 8
        return
    (problem,) = refusal(rig)
    assert "ID 6 on bus main) jumped by 4" in problem
    assert "deg between two readings" in problem


def test_a_servo_that_is_moved_out_of_its_limits_before_its_torque_is_not_held_there():
    plan = make_plan((1, 2), lower=-1.0, upper=1.0)
    rig = make_rig(plan)
    outside = (plan.servos[1].upper_tick + 30) * plan.servos[1].rad_per_tick
    gets_torque = b"\x01\x04\x03\x18\x01"  # the first one
    rig.when(lambda data: data[2:7] == gets_torque, lambda: turn_by_hand(rig.servo(2), outside))
    with pytest.raises(StartUpError, match=r"ID 2 on bus main.* is at 65.8 deg, outside its") as caught:
        rig.hardware.start()
    assert not caught.value.for_replies
    assert [packet for packet in rig.into_bus() if packet[2:5] == b"\x02\x07\x03"] == []
    assert rig.torque() == [False, False]


def test_a_servo_in_another_mode_is_looked_at_again_before_it_gets_torque():
    """Its position in PWM mode counts otherwise, so only the look after the change of mode can judge it."""
    plan = make_plan((1, 2), model="XM430-W350", protocol=2.0, reference=3.14, lower=-1.0, upper=1.0)
    rig = make_rig(plan, position=3.1)
    rig.servo(1).poke("operating_mode", 16)
    turn_by_hand(rig.servo(1), (plan.servos[0].upper_tick + 30) * plan.servos[0].rad_per_tick)
    with pytest.raises(StartUpError, match=r"ID 1 on bus main.* is at .* deg, outside its limits"):
        rig.hardware.start()
    assert rig.torque() == [False, False]


@pytest.mark.parametrize(
    ("hurt", "said"),
    [
        (lambda servo: servo.set_temperature(90.0), "overheating"),
        (lambda servo: servo.set_voltage(5.0), "voltage"),
        (lambda servo: servo.trigger_overload(), "overload"),
    ],
)
def test_a_servo_that_reports_an_error_gets_no_torque(hurt, said):
    rig = make_rig()
    hurt(rig.servo(6))
    (problem, *_) = refusal(rig)
    assert "ID 6 on bus main) reports an error: " in problem
    assert said in problem


@pytest.mark.parametrize("plan", [make_plan((1, 6)), make_x((1, 6))], ids=["AX", "X"])
def test_take_over_accepts_torque(plan):
    rig = make_rig(plan, take_over=True)
    rig.servo(6).poke("torque_enable", 1)
    rig.hardware.start()
    assert rig.torque() == [True, True]


def test_a_start_that_fails_half_way_takes_the_torque_back():
    rig = make_rig()
    seen = []

    def cut():
        if not seen and sum(rig.torque()) >= 4:
            seen.append(rig.torque())
            rig.servo(21).silence()

    for step in range(4000):
        rig.buses[0].at(rig.clock.now_ns() + step * 100_000, cut)
    with pytest.raises(StartUpError, match=r"ID 21"):
        rig.hardware.start()
    assert seen != []
    assert rig.torque() == [False] * 8


def test_one_lost_packet_does_not_stop_the_start():
    rig = make_rig()
    for servo in rig.plans[0].servos:
        corrupt_next(rig.buses[0], servo.servo_id)
    rig.hardware.start()
    assert rig.torque() == [True] * 8
    assert rig.packets.received() == rig.out_of_bus()


def test_answers_that_come_late_are_those_to_what_was_asked():
    """A host or an adapter that stands still for 200 ms: given up, they would answer what is asked next."""
    rig = make_rig()
    for servo in rig.plans[0].servos:
        for late_ns in (0, 0, 0, 200_000_000, 30_000_000, 0, 100_000_000):
            delay_next(rig.buses[0], servo.servo_id, late_ns)
    rig.hardware.start()
    assert rig.torque() == [True] * 8
    assert [code for code, severity, *_ in rig.events.list if severity >= Severity.WARNING] == []
    asked = [packet for packet in rig.into_bus() if packet[2] == 6]
    assert asked.count(protocol1.ping(6)) == 3  # no servo was asked twice


def test_first_states_that_a_standing_host_did_not_hear_are_read_again(monkeypatch):
    rig = make_rig()
    read, reads = rig.hardware.read_states, []

    def late():
        """Let no servo hear anything for 70 ms when the first states are read."""
        if not reads:
            for servo in rig.buses[0].servos:
                servo.silence()
                rig.buses[0].at(rig.clock.now_ns() + 70_000_000, partial(servo.silence, False))
        reads.append(rig.clock.now_ns())
        read()

    monkeypatch.setattr(type(rig.hardware), "read_states", lambda _: late())
    rig.hardware.start()
    assert rig.torque() == [True] * 8
    assert len(reads) > 1
    assert rig.states.valid.all()


def test_no_port_no_start():
    rig = make_rig()
    rig.ports.ports[0].unplug()
    with pytest.raises(PortError, match="bus main on sim"):
        rig.hardware.start()


def test_torque_comes_in_groups():
    rig = start_rig()
    times = [e.t_ns for e in rig.ledger.entries if e.direction == "in" and e.data[4:7] == b"\x03\x18\x01"]
    assert len(times) == 8
    pauses = [b - a > 20_000_000 for a, b in itertools.pairwise(times)]
    assert pauses == [False, False, True, False, False, True, False]


def test_goal_comes_before_torque_and_is_where_the_servo_stands():
    rig = start_rig()
    writes = [packet for packet in rig.into_bus() if packet[4] == 3]
    for goal, torque in zip(writes[::2], writes[1::2], strict=True):
        assert goal[2] == torque[2]
        assert goal[5] == 30
        assert torque[5:7] == b"\x18\x01"


@pytest.mark.parametrize(
    ("trick", "said"),
    [
        (lambda rig: rig.stick(5, "goal_position", 3), "has goal 3 and torque enable 1"),
        (lambda rig: rig.stick(5, "torque_enable", 0), "and torque enable 0"),
        (
            lambda rig: rig.when(lambda data: data == protocol1.read_range(5, 24, 8), rig.servo(5).silence),
            "did not answer when its torque was read back",
        ),
    ],
)
def test_a_goal_and_torque_count_only_when_they_were_read_back(trick, said):
    rig = make_rig()
    trick(rig)
    with pytest.raises(StartUpError) as caught:
        rig.hardware.start()
    assert "main_5_joint (ID 5 on bus main) " in caught.value.sentences[0]
    assert said in caught.value.sentences[0]
    given = [packet[2] for packet in rig.into_bus() if packet[4:7] == b"\x03\x18\x01"]
    assert given == [1, 3, 5], "the servos behind it got torque"


def test_a_servo_that_is_silent_when_all_have_torque_ends_the_start():
    rig = make_rig()
    rig.when(lambda data: data == protocol1.read_range(5, 24, 1), rig.servo(5).silence)
    with pytest.raises(StartUpError, match=r"ID 5 on bus main\) did not answer after torque was switched on"):
        rig.hardware.start()


def test_a_servo_whose_state_cannot_be_read_once_it_has_torque_ends_the_start():
    """It may answer all other questions: goals without states would be blind."""
    rig = make_rig()
    write, plan = rig.ports.ports[0].write_packet, rig.plans[0].servos[2]
    block = protocol1.read_range(plan.servo_id, plan.state.address, plan.state.length)[:6]

    def through(data):
        if bytes(data[:6]) == block and rig.torque()[7]:
            truncate_next(rig.buses[0], plan.servo_id, 0)
        write(data)

    rig.ports.ports[0].write_packet = through
    with pytest.raises(
        StartUpError, match=r"ID 5 on bus main\) did not answer after torque was switched on: "
    ):
        rig.hardware.start()
    assert rig.torque() == [False] * 8
