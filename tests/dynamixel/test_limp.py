import subprocess
import sys

import pytest
from tests.kit.line_faults import delay_next, truncate_next
from tests.kit.rigs import make_plan, make_rig, start_rig

from dxlrun.dynamixel.servo.torque_off import LATE_NS, LONGER_NS, limp


def lose_readbacks(rig):
    """Let a servo acknowledge every write and answer no read."""
    rig.when(lambda data: (data[2], data[4]) == (6, 2), lambda: truncate_next(rig.buses[0], 6, 0))


@pytest.mark.parametrize(
    ("trick", "detail"),
    [
        # as when another program writes it again
        (
            lambda rig: rig.stick(6, "torque_enable", 1),
            "torque enable reads 1 after torque off was written",
        ),
        (lose_readbacks, "torque off was acknowledged, but the read-back got no answer"),
    ],
)
def test_torque_off_counts_only_when_it_was_read_back(trick, detail):
    rig = start_rig()
    trick(rig)
    outcomes = limp(rig.lines)
    assert [one.servo_id for one in outcomes if not one.confirmed] == [6]
    assert detail in str(next(one for one in outcomes if not one.confirmed))
    off = [packet for packet in rig.into_bus() if packet[2] == 6 and packet[4:7] == b"\x03\x18\x00"]
    assert len(off) == len(LONGER_NS), "torque off is tried again after the other servos"


def test_what_answers_late_is_heard_before_the_ports_are_closed():
    rig = start_rig(make_plan((1,)))
    asked = []

    def late():
        if not asked:  # the first read-back: given up before its answer comes
            asked.append(rig.clock.now_ns())
            delay_next(rig.buses[0], 1, LATE_NS)

    rig.when(lambda data: data[4] == 2, late)
    (outcome,) = limp(rig.lines)
    assert outcome.confirmed
    assert rig.packets.received() == rig.out_of_bus()
    assert rig.clock.now_ns() - asked[0] > LATE_NS


def test_it_works_after_a_half_sent_instruction_and_a_half_read_reply():
    rig = start_rig()
    port = rig.ports.ports[0]
    port.write_packet(rig.plans[0].reads[0].packet)
    rig.clock.wait_until(rig.clock.now_ns() + 650_000)
    port.write_packet(b"\xff\xff\xfe\x2c\x83\x1e\x04\x01")
    off_ns = []
    for servo in rig.buses[0].servos:
        servo.registers.watch_items(("torque_enable",), lambda: off_ns.append(rig.buses[0].now_ns))
    outcomes = limp(rig.lines)
    assert all(one.confirmed for one in outcomes)
    assert rig.torque() == [False] * 8
    assert len(set(off_ns[:8])) == 1, "the broadcast collided with the end of the reply"


def test_a_silent_servo_is_named_and_time_is_bounded():
    rig = start_rig()
    for servo_id in (1, 3, 5, 6):
        rig.servo(servo_id).silence()
    start = rig.clock.now_ns()
    outcomes = limp(rig.lines, rig.clock.now_ns() + 50_000_000)
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


def test_a_babbling_line_does_not_hold_it_up():
    rig = start_rig()
    start = rig.clock.now_ns()
    for step in range(400):
        rig.buses[0].inject_noise(b"\xff\xff\x01", start + step * 100_000)
    outcomes = limp(rig.lines)
    first = next(e.t_ns for e in rig.ledger.entries if e.t_ns >= start and e.direction == "in")
    assert first - start < 1_000_000
    assert all(one.confirmed for one in outcomes)


def test_the_guardians_path_imports_no_numpy():
    code = "import sys, dxlrun.run.guardian; print('numpy' in sys.modules)"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "False"


def test_no_servo_to_limp():
    rig = make_rig(make_plan(()))
    assert limp(rig.lines) == ()
