"""What the guardian does when the loop died: servos become limp, or wheels stand."""

import math
import subprocess
import sys
from functools import partial

import pytest
from tests.kit.line_faults import delay_next, truncate_next
from tests.kit.rigs import every_servo, make_plan, start_rig

from dxlrun.dynamixel.servo.torque_off import LATE_NS, LONGER_NS, limp, stand


@pytest.fixture
def rig():
    return start_rig()


def lose_readbacks(rig):
    """Let a servo acknowledge every write and answer no read."""
    rig.when(lambda data: (data[2], data[4]) == (6, 2), lambda: truncate_next(rig.buses[0], 6, 0))


@pytest.mark.parametrize(
    ("trick", "detail"),
    [
        # as when another program writes it again
        (lambda rig: rig.stick(6, "torque_enable", 1), "torque enable reads 1 after torque off was written"),
        (lose_readbacks, "torque off was acknowledged, but the read-back got no answer"),
    ],
)
def test_torque_off_counts_only_when_it_was_read_back(rig, trick, detail):
    trick(rig)
    (failed,) = [one for one in limp(rig.lines) if not one.confirmed]
    assert failed.servo_id == 6
    assert detail in str(failed)
    off = [packet for packet in rig.into_bus() if packet[2] == 6 and packet[4:7] == b"\x03\x18\x00"]
    assert len(off) == len(LONGER_NS), "torque off is tried again after the other servos"


def test_what_answers_late_is_heard_before_the_ports_are_closed():
    rig, asked = start_rig(make_plan((1,))), []

    def late():
        if not asked:  # the first read-back: given up before its answer comes
            asked.append(rig.clock.now_ns())
            delay_next(rig.buses[0], 1, LATE_NS)

    rig.when(lambda data: data[4] == 2, late)
    (outcome,) = limp(rig.lines)
    assert outcome.confirmed
    assert rig.packets.received() == rig.out_of_bus()
    assert rig.clock.now_ns() - asked[0] > LATE_NS


def test_it_works_after_a_half_sent_instruction_and_a_half_read_reply(rig):
    port = rig.ports.ports[0]
    port.write_packet(rig.plans[0].reads[0].packet)
    rig.clock.wait_until(rig.clock.now_ns() + 650_000)
    port.write_packet(b"\xff\xff\xfe\x2c\x83\x1e\x04\x01")
    off_ns = []
    for servo in rig.buses[0].servos:
        servo.registers.watch_items(("torque_enable",), lambda: off_ns.append(rig.buses[0].now_ns))
    assert all(one.confirmed for one in limp(rig.lines))
    assert rig.torque() == [False] * 8
    assert len(set(off_ns[:8])) == 1, "the broadcast collided with the end of the reply"


def test_silent_servos_are_named_and_time_is_bounded(rig):
    for servo_id in (1, 3, 5, 6):
        rig.servo(servo_id).silence()
    start = rig.clock.now_ns()
    outcomes = limp(rig.lines, start + 50_000_000)
    assert rig.clock.now_ns() - start < 200_000_000
    assert [one.servo_id for one in outcomes if not one.confirmed] == [1, 3, 5, 6]
    assert "does not answer" in str(outcomes[0])
    assert rig.torque()[4:] == [False] * 4


def test_a_line_that_is_gone_does_not_keep_the_other_one():
    rig = start_rig(make_plan((1, 2), name="left"), make_plan((1, 7), name="right", first_row=2))
    rig.ports.ports[0].unplug()
    outcomes = limp(rig.lines)
    assert [one.confirmed for one in outcomes] == [False, False, True, True]
    assert "could not be sent" in outcomes[0].detail
    assert rig.torque(1) == [False, False]


def test_a_babbling_line_does_not_hold_it_up(rig):
    start = rig.clock.now_ns()
    for step in range(400):
        rig.buses[0].inject_noise(b"\xff\xff\x01", start + step * 100_000)
    assert all(one.confirmed for one in limp(rig.lines))
    first = next(e.t_ns for e in rig.ledger.entries if e.t_ns >= start and e.direction == "in")
    assert first - start < 1_000_000


def test_the_guardians_path_imports_no_numpy():
    code = "import sys, dxlrun.run.guardian; print('numpy' in sys.modules)"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "False"


def wheels(model="XM430-W350", protocol=2.0, *, ids=(1, 2), velocity=1.0):
    """Return wheels of which the first one turns."""
    ends = {"lower": -math.inf, "upper": math.inf, "reference": math.pi, "return_delay_ns": 0}
    plan = make_plan(ids, model=model, protocol=protocol, continuous=True, **ends)
    rig = start_rig(every_servo(plan, torque_on_return=True))
    rig.goals.velocity[:] = 0.0
    rig.goals.velocity[0] = velocity
    rig.cycles(20)
    return rig


@pytest.mark.parametrize(("model", "protocol"), [("MX-28", 1.0), ("AX-12A", 1.0), ("XL430-W250", 2.0)])
def test_wheels_of_a_robot_that_is_left_with_torque_by_a_loop_that_died_stand(model, protocol):
    rig = wheels(model, protocol)
    rig.servo(2).poke("torque_enable", 0)
    rig.hardware.read_states()  # and the loop dies
    assert stand(rig.lines) == ("main_1_joint (ID 1 on bus main) was stopped: its goal is 0",)
    rig.wait(500_000_000)
    assert rig.torque() == [True, False], "a servo without torque was given some"
    standing = rig.servo(1).shaft_angle
    rig.wait(500_000_000)
    assert rig.servo(1).shaft_angle == pytest.approx(standing, abs=0.05)


@pytest.mark.parametrize("lost", [False, True])
def test_a_wheel_that_takes_no_goal_any_more_loses_its_torque(lost):
    """Torque off is tried again where its instruction is lost."""
    rig, left = wheels(), [lost]
    rig.servo(1).poke("bus_watchdog", -1)
    rig.when(
        lambda data: data[4] == 1 and data[7:11] == b"\x03\x40\x00\x00" and left.pop() if left else False,
        partial(rig.buses[0].alter_next_instruction, "lost", lambda _: b""),
    )
    said = [text for text in stand(rig.lines) if text.startswith("main_1_joint (ID 1 on bus main) could not")]
    assert "be stopped and is limp: " in said[-1]
    assert lost or "did not acknowledge its goal" in said[0]
    assert not left
    assert rig.torque() == [False, True]


def test_a_wheel_that_keeps_its_torque_whatever_is_written_is_named():
    rig = wheels()
    rig.servo(1).poke("bus_watchdog", -1)
    rig.stick(1, "torque_enable", 1)
    (said, _) = stand(rig.lines)[::-1]
    assert said.startswith("main_1_joint (ID 1 on bus main) may keep moving: ")
    assert said.endswith("torque off was not confirmed")


def test_joints_that_hold_a_position_are_left_alone(rig):
    rig.cycle()
    assert stand(rig.lines) == ()
    assert rig.torque() == [True] * 8


def test_a_wheel_stands_before_silent_ones_are_awaited_for_long():
    rig = wheels("AX-12A", 1.0, ids=(1, 2, 3, 4))
    rig.goals.velocity[:] = 1.0
    rig.cycles(20)
    for servo_id in (1, 2, 3):
        rig.servo(servo_id).silence()
    begin_ns, stood_ns = rig.clock.now_ns(), []
    moving = rig.servo(4).registers
    moving.watch_items(("moving_speed",), lambda: stood_ns.append(rig.clock.now_ns()))
    said = stand(rig.lines)
    assert stood_ns[-1] - begin_ns < 500_000_000
    assert [text.split()[0] for text in said] == [f"main_{one}_joint" for one in (4, 1, 2, 3)]
    assert [" may keep moving: " in text for text in said] == [False, True, True, True]


@pytest.mark.parametrize("last_hand", [limp, stand])
def test_the_last_hand_waits_for_the_end_of_a_reply_that_is_on_its_way(rig, last_hand):
    rig.clock.wait_until(rig.clock.now_ns() + 5_000_000)
    begun_ns = rig.clock.now_ns()
    rig.ports.ports[0].write_packet(rig.plans[0].reads[0].packet)
    rig.clock.wait_until(begun_ns + 640_000)  # 80 us of instruction, 500 us of delay
    last_hand(rig.lines)
    notes = [entry.note for entry in rig.ledger.entries if entry.t_ns > begun_ns]
    assert [note for note in notes if note.startswith("collision")] == []
