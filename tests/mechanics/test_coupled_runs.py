"""Servos of coupled joints that disagree or are outside limits; runs: coupled.txt, crossing.txt in robots."""

import math
from functools import partial

import pytest
from msgspec.structs import replace
from tests.kit.kept_events import Events
from tests.kit.line_faults import turn_by_hand
from tests.kit.virtual_run import VirtualRun, torque

from dxlrun.channels.answers import Refusal
from dxlrun.channels.cycle import Commands, States
from dxlrun.channels.event_records import EventCode, Severity
from dxlrun.compile.simulation import simulation_of
from dxlrun.errors import StartUpError
from dxlrun.features.mechanics.joint_arrays import CoupledJointArrays
from dxlrun.features.mechanics.joint_hardware import CouplingCheck
from dxlrun.run import virtual_run

pytestmark = pytest.mark.long


def test_servos_that_disagree_are_refused_before_any_gets_torque(plan, monkeypatch):
    right = plan()
    (bus,) = right.buses
    servos = tuple(
        replace(servo, reference=servo.reference + math.radians(8)) if servo.servo_id == 3 else servo
        for servo in bus.servos
    )
    wrong = replace(right, buses=(replace(bus, servos=servos),))
    monkeypatch.setattr(virtual_run, "simulation_of", lambda _: simulation_of(right))
    robot = VirtualRun(wrong)
    with pytest.raises(StartUpError) as caught:
        robot.run()
    assert "the servos of hip disagree by 8.0 deg, more than its tolerance of 3.0 deg" in str(caught.value)
    assert "ID 3 on bus main reports 8.0 deg, ID 2 on bus main reports 0.0 deg" in str(caught.value)
    assert not any(on for servo in range(1, 8) for _, on in robot.sent(servo, "torque_enable"))
    couplings = tuple(replace(one, tolerance=math.radians(9)) for one in wrong.mechanics.couplings)
    tolerant = replace(wrong, mechanics=replace(wrong.mechanics, couplings=couplings))
    assert VirtualRun(tolerant).run().reason == "ended"


def test_servos_that_begin_to_disagree_in_the_run_are_one_event_until_they_agree(plan):
    robot, events = plan(), Events()
    arrays = CoupledJointArrays(robot.mechanics, States.empty(5), Commands.empty(5))
    together = CouplingCheck(robot.mechanics, robot.loop, robot.buses, arrays, events)
    arrays.servo_states.position[:], arrays.servo_states.valid[:] = 0.0, True
    for degrees in (0, 2.9, 3.2, 5, 2.9, 3.5, 2.2, 1, 2.9, 4):
        arrays.servo_states.position[2] = math.radians(degrees)
        arrays.fill_joint_states()
        together.report_disagreement()
    assert [(code, severity, source) for code, severity, source, _ in events.list] == [
        (EventCode.SERVOS_DISAGREE, Severity.WARNING, "hip"),  # at 3.2 deg
        (EventCode.SERVOS_DISAGREE, Severity.INFO, "hip"),  # below 2.1, at 1 deg
        (EventCode.SERVOS_DISAGREE, Severity.WARNING, "hip"),
    ]
    assert "ID 3 on bus main reports 3.2 deg, ID 2 on bus main reports 0.0 deg" in events.list[0][3]
    arrays.servo_states.valid[1] = False  # where one stands is not known
    arrays.servo_states.position[2] = 0.0
    arrays.fill_joint_states()
    together.report_disagreement()
    assert len(events.list) == 3


def test_a_wrist_outside_its_limits_is_refused_though_each_servo_is_within_its_range(plan):
    robot = VirtualRun(plan())
    for servo, angle in ((5, 80), (6, -80)):  # pitch at 80 deg, roll at 0
        turn_by_hand(robot.buses[0].servo(servo), math.radians(180 + angle))
    with pytest.raises(StartUpError, match=r"pitch \(ID 5 and 6 on bus main\) is at 80.0 deg, outside"):
        robot.run()


@pytest.mark.parametrize(
    ("moved", "joint", "problem"),
    [
        ({5: 260, 6: 100}, "roll", "pitch (ID 5 and 6 on bus main) is at 80.0 deg, outside its limits"),
        ({3: 170}, "hip", "the servos of hip disagree by 10.0 deg, more than its tolerance of 3.0 deg"),
    ],
)
def test_torque_comes_back_within_limits_only_and_if_servos_agree(plan, monkeypatch, moved, joint, problem):
    right = plan()
    # without what couples them, as where a horn has slipped
    monkeypatch.setattr(virtual_run, "simulation_of", lambda _: replace(simulation_of(right), mechanisms=()))
    robot = VirtualRun(plan(duration_s=1.4))
    for ms, on in ((300, False), (1000, True)):
        robot.post_at(ms, torque([joint], on=on, release=True))
    for servo, angle in moved.items():
        robot.at(600, partial(turn_by_hand, robot.buses[0].servo(servo), math.radians(angle)))
    robot.run()
    answer = robot.answer(2)
    assert isinstance(answer, Refusal)
    assert answer.text.count(problem) == 1
    for servo in moved:
        assert not any(on for ms, on in robot.sent(servo, "torque_enable") if ms > 200)
