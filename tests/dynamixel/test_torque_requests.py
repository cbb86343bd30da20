"""Torque that clients request, judged by the simulated bus; `cases/torque.txt` has most of it."""

import pytest
from tests.kit.line_faults import turn_by_hand
from tests.kit.rigs import every_servo, make_plan, make_x, start_rig

from dxlrun.channels.cycle import Torque
from dxlwire.modes import Mode
from dxlwire.wire import protocol2

IDS = (11, 12, 13)


def answer_of(rig, on):
    """Switch the torque of the second servo; run cycles until there is an answer, and return it."""
    answers = []
    rig.hardware.switch_torque(1, on, answers.append)
    while not answers:
        rig.cycle()
    return answers[0]


@pytest.mark.parametrize(
    "plan",
    [make_plan(IDS, name="arm", return_delay_ns=0, lower=-2.5, upper=2.5), make_x(IDS)],
    ids=["1.0", "2.0"],
)
def test_torque_on_holds_a_joint_where_a_person_has_put_it(plan):
    rig = start_rig(plan)
    assert answer_of(rig, on=False) == ""
    turn_by_hand(rig.servo(12), 2.4)
    rig.cycles(5)
    begun = len(rig.into_bus())
    assert answer_of(rig, on=True) == ""
    rig.cycles(3)
    place = rig.states.position[1]
    rig.cycles(40)
    assert abs(rig.states.position[1] - place) < 0.02
    assert rig.torque() == [True] * 3
    assert rig.states.torque.tolist() == [Torque.ON] * 3
    written = [(address, data) for servo, address, data in rig.writes(begun) if servo == 12]
    torque = (plan.servos[1].torque_address, b"\1")
    assert written[-1] == torque, "its goal came behind its torque"
    assert written.count(torque) == 1


def test_a_servo_that_reboots_while_it_is_checked_gets_no_torque():
    """At any packet from the first reading of its clock, before the check, to the second, before torque."""

    def let_go():
        rig = start_rig(every_servo(make_x(IDS), torque_on_return=True))
        assert answer_of(rig, on=False) == ""
        return rig, len(rig.into_bus())

    rig, begun = let_go()
    assert answer_of(rig, on=True) == ""
    tick = protocol2.read_range(12, 120, 2)
    first, last = (number for number, packet in enumerate(rig.into_bus()[begun:]) if packet == tick)
    assert last - first > 5
    for packets in range(first + 1, last + 1):
        rig, begun = let_go()
        given = rig.torque_given(12)
        rig.buses[0].after(packets, rig.servo(12).power_cycle)
        assert "rebooted during the check" in answer_of(rig, on=True), packets
        rig.cycles(100)
        assert not any(given)


@pytest.mark.parametrize("returning", [False, True])
@pytest.mark.parametrize("after", range(1, 14))
def test_a_servo_that_reboots_while_its_mode_changes_gets_torque_by_the_policy_alone(returning, after):
    rig = start_rig(every_servo(make_x(IDS), torque_on_return=returning))
    rig.set_modes(0, Mode.VELOCITY, 0)
    rig.buses[0].after(after + 2, rig.servo(12).power_cycle)
    rig.cycles(150)
    assert rig.torque() == [True, returning, True]
    assert rig.states.mode[1] == Mode.VELOCITY
