"""Requests for joints of several servos, of which a test answers."""

import math

import pytest
from msgspec.structs import replace
from tests.kit.kept_events import Events

from dxlrun.channels.cycle import Commands, States, Torque
from dxlrun.channels.event_records import EventCode
from dxlrun.features.mechanics.joint_arrays import CoupledJointArrays
from dxlrun.features.mechanics.joint_hardware import CouplingCheck, JointHardware
from dxlwire.modes import Mode

HIP, PITCH = 1, 3
HIP_SERVOS, WRIST_SERVOS = [1, 2], [4, 5]


class Servos:
    """Keeps what is requested of servos; a test answers."""

    def __init__(self):
        self.switched, self.done = [], []
        self.rows = []  # servos whose registers were requested
        self.followed = []  # servos that are to get goals

    def read_states(self):
        pass

    write_goals = read_states

    def switch_torque(self, row, on, done):
        self.switched.append((row, on))
        self.done.append(done)

    def read_register(self, row, *request):
        self.rows.append(row)
        self.done.append(request[-1])

    write_register = read_register

    def follow_goals(self, rows):
        self.followed += rows


class Joints:
    """The joints of the robot in front of them, with torque, and what was answered and reported."""

    def __init__(self, plan):
        self.arrays = arrays = CoupledJointArrays(plan.mechanics, States.empty(5), Commands.empty(5))
        self.torque, self.position = arrays.servo_states.torque, arrays.servo_states.position
        arrays.servo_states.motion[:], arrays.servo_states.valid[:] = 0.0, True
        self.torque[:], arrays.servo_states.mode[:] = Torque.ON, Mode.POSITION
        self.servos, self.events, self.answers = Servos(), Events(), []
        self.together = CouplingCheck(plan.mechanics, plan.loop, plan.buses, arrays, self.events)
        self.hardware = JointHardware(self.servos, plan.mechanics, arrays, self.together, 20_000_000)

    def switch_torque_on(self, joint):
        """Ask for the torque of a joint; return what was answered at once."""
        self.arrays.fill_joint_states()
        self.hardware.switch_torque(joint, True, self.answers.append)
        assert bool(self.servos.switched) == (not self.answers)
        return "".join(self.answers)


@pytest.fixture
def joints(plan):
    return Joints(plan())


@pytest.mark.parametrize(
    ("partner", "switched"),
    [
        *((torque, [(2, False)]) for torque in (Torque.ON, Torque.DOUBT)),
        *((torque, []) for torque in (Torque.LOST, Torque.REBOOTING, Torque.UNKNOWN)),
    ],
)
def test_a_servo_without_torque_takes_it_once_from_a_partner_that_may_have_some(joints, partner, switched):
    joints.torque[HIP_SERVOS] = Torque.OFF, partner
    joints.hardware.read_states()
    joints.hardware.read_states()
    assert joints.servos.switched == switched
    told = joints.events.of(EventCode.TORQUE_OFF)
    assert [name for name, _ in told] == ["hip"] * len(switched)
    for _, text in told:
        assert "torque is switched off on ID 3 on bus main, as ID 2 on bus main of" in text


def test_it_does_so_while_another_mechanism_is_switched(joints):
    joints.hardware.switch_torque(PITCH, False, joints.answers.append)
    joints.torque[HIP_SERVOS] = Torque.OFF, Torque.ON
    joints.hardware.read_states()
    assert joints.servos.switched == [(4, False), (5, False), (2, False)]


@pytest.mark.parametrize("problems", [("", ""), ("refuses", ""), ("", "refuses")])
def test_a_request_is_answered_when_all_servos_have_answered(joints, problems):
    joints.hardware.switch_torque(HIP, False, joints.answers.append)
    joints.hardware.write_register(HIP, "led", 1, lambda *answer: joints.answers.append(answer))
    first, second = problems
    torque, register = joints.servos.done[:2], joints.servos.done[2:]
    torque[0](first)
    register[0](first, 7)
    assert joints.answers == []
    torque[1](second)
    register[1](second, 8)
    assert joints.answers == [first or second, (first or second, 7)]


@pytest.mark.parametrize("first", [7, 8])
def test_servos_of_a_joint_that_differ_in_a_register_are_named_with_their_values(joints, first):
    joints.hardware.read_register(HIP, "led", lambda *answer: joints.answers.append(answer))
    assert joints.servos.rows == HIP_SERVOS
    for done, value in zip(joints.servos.done, (first, 8), strict=True):
        done("", value)
    differ = f"its servos have different values: ID 2 on bus main has {first}, ID 3 on bus main has 8"
    assert joints.answers == [(differ if first != 8 else "", first)]


def test_a_register_that_a_servo_does_not_report_differs_from_no_other(joints):
    joints.hardware.read_register(HIP, "led", lambda *answer: joints.answers.append(answer))
    for done, answer in zip(joints.servos.done, (("no reply", 0), ("", 8)), strict=True):
        done(*answer)
    ((problem, _),) = joints.answers
    assert problem == "no reply"


@pytest.mark.parametrize("servo", range(6))
def test_row_after_the_joints_is_the_register_of_a_single_servo(joints, servo):
    joints.hardware.read_register(5 + servo, "led", lambda *answer: joints.answers.append(answer))
    joints.hardware.write_register(5 + servo, "led", 1, lambda *answer: joints.answers.append(answer))
    assert joints.servos.rows == [servo, servo]
    for done in joints.servos.done:
        done("", 3)
    assert joints.answers == [("", 3), ("", 3)]


@pytest.mark.parametrize("limp", [(1,), (2,), (1, 2)])
def test_joint_gets_no_torque_at_the_start_outside_its_limits_unless_all_its_servos_are_to_be_limp(
    plan, limp
):
    made = plan()
    (bus,) = made.buses
    servos = tuple(replace(one, torque_at_start=one.row not in limp) for one in bus.servos)
    joints = Joints(replace(made, buses=(replace(bus, servos=servos),)))
    joints.position[HIP_SERVOS] = 2.0
    found = [text.split(":")[0] for text in joints.together.at_start()]
    outside = "hip (ID 2 and 3 on bus main) is at 114.6 deg, outside its limits -60.0 deg..60.0 deg"
    assert found == [outside] * (len(limp) == 1)


@pytest.mark.parametrize(("ticks", "fits"), [(0.9, True), (1.1, False)])
def test_joint_of_unlike_servos_may_stand_a_tick_of_the_coarser_one_beyond_its_limits(plan, ticks, fits):
    first = ("XM430-W350, reference: 180 deg, direction: 1,", "XL430-W250, reference: 180 deg, direction: 1,")
    second = ("{id: 3, direction: -1}", "{id: 3, model: XL-320, reference: 150 deg}")
    joints = Joints(plan(first, second))
    joints.position[HIP_SERVOS] = math.radians(60 + ticks * 300 / 1023)
    assert (joints.together.at_start() == []) is fits


@pytest.mark.parametrize("position", [2.0, -2.0])
@pytest.mark.parametrize("second", [Torque.ON, Torque.RELEASED])
def test_no_joint_with_a_limp_servo_gets_torque_outside_its_limits(joints, position, second):
    joints.torque[HIP_SERVOS] = Torque.RELEASED, second
    joints.position[HIP_SERVOS] = position
    assert "outside its limits -60.0 deg..60.0 deg" in joints.switch_torque_on(HIP)


@pytest.mark.parametrize(
    ("pitch", "roll", "outside"),
    [(0.0, 1.2, "roll"), (0.0, -1.2, "roll"), (0.9, 0.0, "pitch"), (0.7, 0.7, "")],
)
def test_no_joint_of_a_limp_wrist_may_be_outside_its_limits(joints, pitch, roll, outside):
    joints.torque[WRIST_SERVOS] = Torque.RELEASED
    joints.position[WRIST_SERVOS] = pitch + roll, pitch - roll
    assert joints.switch_torque_on(PITCH).split(" (")[0] == outside


def test_servos_that_are_given_torque_apart_keep_their_places_and_then_agree(joints):
    joints.position[HIP_SERVOS] = 0.20, 0.24
    joints.hardware.read_states()
    joints.arrays.goals.position[:] = joints.arrays.states.position
    joints.hardware.follow_goals([HIP])
    assert joints.servos.followed == HIP_SERVOS
    goals = joints.arrays.servo_goals.position
    joints.hardware.write_goals()
    assert goals[HIP_SERVOS] == pytest.approx([0.20, 0.24], abs=0.001)
    for _ in range(50):  # 20 ms each
        joints.hardware.write_goals()
    assert goals[HIP_SERVOS] == pytest.approx([0.22, 0.22])
