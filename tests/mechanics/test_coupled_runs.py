"""Robots with coupled joints on the simulated bus; its ledger says what each servo was sent."""

import math
from functools import partial

import pytest
from msgspec.structs import replace
from tests.kit.line_faults import turn_by_hand
from tests.kit.rigs import Events
from tests.kit.sampled_run import SampledRun
from tests.kit.stories import send
from tests.kit.wire import all_writes

from dxlrun.channels.answers import Refusal
from dxlrun.channels.commands import CommandMessage
from dxlrun.channels.cycle import Commands, States
from dxlrun.channels.event_records import EventCode, Severity
from dxlrun.compile.simulation import simulation_of
from dxlrun.errors import StartUpError
from dxlrun.features.mechanics.joint_arrays import CoupledJointArrays
from dxlrun.features.mechanics.joint_hardware import CouplingCheck
from dxlrun.log.log_reader import read_log
from dxlrun.run import virtual_run
from dxlrun.run.virtual_run import VirtualRobot
from dxlrun_controllers.group import JointGroupPositionController

pytestmark = pytest.mark.long

TURN = 4096
CROSSING = """\
name: neck
buses: {main: {port: sim, protocol: 2.0, baud_rate: 1_000_000, return_delay_time: 0 us}}
loop: {rate: 50}
joints:
  pitch: {limits: {position: [-40 deg, 40 deg], velocity: 2 rad/s}}
  roll: {limits: {position: [-60 deg, 60 deg], velocity: 2 rad/s}}
transmissions:
  neck_gear:
    type: differential
    joints: [pitch, roll]
    servos:
      left: {bus: main, id: 1, model: XM430-W350, reference: 10 deg, direction: 1}
      right: {bus: main, id: 2, model: XM430-W350, reference: 350 deg, direction: -1}
controllers: {neck: {type: joint_group_position_controller, joints: [pitch, roll]}}
policies: {on_returned_servo: hold}
"""


@pytest.fixture
def sways(monkeypatch):
    """All joints sway within their limits."""

    def update(controller, time_ns, period_ns):
        wave = math.sin(2 * time_ns * 1e-9)
        controller.context.commands.position[:] = [0.3 * wave, 0.5 * wave, 0.01, 0.4 * wave, -0.2 * wave]

    monkeypatch.setattr(JointGroupPositionController, "update", update)


def written(robot, servo, *addresses):
    """Return when a servo was told to write which bytes to an address."""
    entries, (bus,) = robot.ledger.entries, robot.plan.buses
    return [(t, data) for t, one, at, data in all_writes(entries, bus) if one == servo and at in addresses]


def goals(robot, servo, after_ns=0):
    """Return the goal positions that a servo was sent: time and ticks; they stand last in their block."""
    found = written(robot, servo, 112, 116)
    return [(t, int.from_bytes(data[-4:], "little", signed=True)) for t, data in found if t > after_ns]


def torque(robot, servo, after_ns=0, before_ns=1 << 62):
    """Return what was written to torque enable (64) of a servo in a time."""
    return [data[0] for t, data in written(robot, servo, 64) if after_ns < t < before_ns]


def test_servos_of_one_joint_get_equal_goals_and_no_goal_leaves_the_limits(plan, sways):
    robot = VirtualRobot(plan(duration_s=1.5))
    robot.run()
    first, second = dict(goals(robot, 2)), dict(goals(robot, 3))
    assert len(first) > 40
    for t in first.keys() & second.keys():
        assert first[t] - TURN // 2 == -(second[t] - TURN // 2)
    ranges = {s.servo_id: (s.lower_tick, s.upper_tick) for bus in robot.plan.buses for s in bus.servos}
    for servo, (lower, upper) in ranges.items():
        ticks = [tick for _, tick in goals(robot, servo)]
        assert lower <= min(ticks) <= max(ticks) <= upper
    # head turns by 0.3 rad, its servo by twice that; the gripper's 10 mm are 10 / 94.2 of a turn
    head = [tick for _, tick in goals(robot, 1)]
    assert max(head) == TURN // 2 + round(0.6 / math.tau * TURN)
    assert goals(robot, 7)[-1][1] == TURN // 2 + round(10 / 94.2 * TURN)
    assert robot.result is not None
    assert robot.result.invalid == (0,) * 5


def test_states_in_the_log_are_those_of_joints_and_no_servo_moves_at_the_start(plan, tmp_path):
    robot = VirtualRobot(plan(), log=tmp_path / "run.mcap")
    (bus,) = robot.buses
    turn_by_hand(bus.servo(5), math.radians(200))
    turn_by_hand(bus.servo(1), math.radians(200))
    turn_by_hand(bus.servo(7), math.radians(270))
    present = {servo.servo_id: round(servo.shaft_angle / math.tau * TURN) for servo in bus.servos}
    robot.run()
    for servo, tick in present.items():
        assert {sent for _, sent in goals(robot, servo)} == {tick}
    head, hip, gripper, *wrist = read_log(tmp_path / "run.mcap").cycles["position"][0]
    assert (math.degrees(head), math.degrees(hip)) == (pytest.approx(10, abs=0.1), 0.0)
    assert gripper == pytest.approx(0.0942 / 4, abs=1e-4)
    left, right = ((present[servo] - TURN // 2) / TURN * math.tau for servo in (5, 6))
    assert wrist == pytest.approx(
        [(left - right) / 2, (left + right) / 2], abs=0.002
    )  # right counts backwards


def test_servos_that_disagree_are_refused_before_any_gets_torque(plan, monkeypatch):
    right = plan()
    (bus,) = right.buses
    servos = tuple(
        replace(servo, reference=servo.reference + math.radians(8)) if servo.servo_id == 3 else servo
        for servo in bus.servos
    )
    wrong = replace(right, buses=(replace(bus, servos=servos),))
    monkeypatch.setattr(virtual_run, "simulation_of", lambda _: simulation_of(right))
    robot = VirtualRobot(wrong)
    with pytest.raises(StartUpError) as caught:
        robot.run()
    assert "the servos of hip disagree by 8.0 deg, more than its tolerance of 3.0 deg" in str(caught.value)
    assert "ID 3 on bus main reports 8.0 deg, ID 2 on bus main reports 0.0 deg" in str(caught.value)
    assert not any(any(torque(robot, servo)) for servo in range(1, 8))
    couplings = tuple(replace(one, tolerance=math.radians(9)) for one in wrong.mechanics.couplings)
    tolerant = replace(wrong, mechanics=replace(wrong.mechanics, couplings=couplings))
    assert VirtualRobot(tolerant).run().reason == "ended"


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


def test_a_controller_for_one_joint_of_a_wrist_is_not_loaded_in_another_mode(plan):
    robot = VirtualRobot(plan())
    known = robot.plan.loop.controllers[1]
    part = replace(known, name="part", joints=("pitch",), command=("velocity",))
    refusal = robot.robot.manager.load_controller(part)
    assert isinstance(refusal, Refusal)
    assert "the mode of pitch, but not of roll" in str(refusal.fields["problem"])
    assert robot.robot.manager.load_controller(replace(part, command=("position",))) == 2


def test_a_wrist_outside_its_limits_is_refused_though_each_servo_is_within_its_range(plan):
    robot = VirtualRobot(plan())
    for servo, angle in ((5, 80), (6, -80)):  # pitch at 80 deg, roll at 0
        turn_by_hand(robot.buses[0].servo(servo), math.radians(180 + angle))
    with pytest.raises(StartUpError, match=r"pitch \(ID 5 and 6 on bus main\) is at 80.0 deg, outside"):
        robot.run()


GONE_NS, BACK_NS = 500_000_000, 1_500_000_000


def lose(robot, servo):
    lost = robot.buses[0].servo(servo)
    robot.buses[0].at(GONE_NS, lost.silence)
    robot.buses[0].at(BACK_NS, lambda: lost.silence(False))


def test_a_lost_servo_holds_its_partner_where_it_is(plan, sways):
    robot = VirtualRobot(plan(duration_s=1.4))
    lose(robot, 3)
    result = robot.run()
    held = [tick for t, tick in goals(robot, 2) if GONE_NS + 150_000_000 < t < BACK_NS - 100_000_000]
    others = [tick for _, tick in goals(robot, 1, GONE_NS + 150_000_000)]
    assert len(set(held)) <= 1
    assert len(set(others)) <= 1  # all are of one controller, which waits
    assert result.invalid[1] > 20
    assert result.invalid[0] == 0


def ask_torque(robot, joint, *wanted):
    """Let a client ask for the torque of a joint, each at its time, ms."""
    for number, (ms, on) in enumerate(wanted, 1):
        data = f'{{"joints": ["{joint}"], "on": {on}, "release": true}}'.encode()
        command = CommandMessage(number, "", "torque", data, "anna")
        robot.buses[0].at(ms * 1_000_000, partial(robot.inbox.waiting.append, command))


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
    robot = VirtualRobot(plan(duration_s=1.4))
    (bus,) = robot.buses
    ask_torque(robot, joint, (300, "false"), (1000, "true"))
    for servo, angle in moved.items():
        bus.at(600_000_000, partial(turn_by_hand, bus.servo(servo), math.radians(angle)))
    robot.run()
    answer = robot.inbox.answers[2]
    assert isinstance(answer, Refusal)
    assert answer.text.count(problem) == 1
    for servo in moved:
        assert 1 not in torque(robot, servo, 200_000_000)


@pytest.mark.parametrize(("pitch", "roll"), [(0, 0), (38, -57), (-38, 58), (30, 50)])
def test_servos_of_a_transmission_may_cross_raw_0(tmp_path, pitch, roll):
    run = SampledRun(tmp_path, CROSSING, 4.0)
    left, right = (run.bus.servo(number) for number in (1, 2))

    def angles(pitch, roll):
        return 10 + (pitch + roll), 350 - (pitch - roll)

    def off(pitch, roll):
        pairs = zip((left, right), angles(pitch, roll), strict=True)
        return max(
            abs(math.remainder(math.degrees(servo.shaft_angle) - angle, 360)) for servo, angle in pairs
        )

    for servo, angle in zip((left, right), angles(pitch, roll), strict=True):
        turn_by_hand(servo, math.radians(angle))
        servo.power_cycle()  # it forgets its turn
    found = []
    run.at(480, lambda: found.append(off(pitch, roll)))
    run.ask(500, send("neck", "positions", 0.3, -0.7))
    run.fault("brownout servo=1 at=2s for=200ms")
    run.at(3900, lambda: found.append(off(math.degrees(0.3), math.degrees(-0.7))))
    log = run.run()
    assert max(found) < 1.5
    assert found[0] < 0.1
    assert log.cycles["position"][5] == pytest.approx([math.radians(pitch), math.radians(roll)], abs=0.002)
    assert log.cycles["position"][-1] == pytest.approx([0.3, -0.7], abs=0.02)
