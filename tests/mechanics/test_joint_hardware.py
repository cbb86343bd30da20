"""Requests for joints of several servos: each becomes one for every servo, and is answered once by all."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import pytest
from msgspec.structs import replace
from tests.kit.rigs import Events

from dxlrun.channels.cycle import Commands, States, Torque
from dxlrun.channels.event_records import EventCode
from dxlrun.features.mechanics.joint_arrays import CoupledJointArrays
from dxlrun.features.mechanics.joint_hardware import CouplingCheck, JointHardware
from dxlrun.plan.robot_plan import Plan
from dxlwire.modes import Mode

HIP, PITCH = 1, 3
HIP_SERVOS = [1, 2]


class Servos:
    """Keeps what is requested of servos; a test answers."""

    def __init__(self) -> None:
        self.switched: list[tuple[int, bool]] = []
        self.done: list[Callable[..., None]] = []
        self.rows: list[int] = []  # servos whose registers were requested
        self.followed: list[int] = []  # servos that are to get goals

    def read_states(self) -> None:
        pass

    def switch_torque(self, row: int, on: bool, done: Callable[[str], None]) -> None:
        self.switched.append((row, on))
        self.done.append(done)

    def write_register(
        self, row: int, item: str, value: int, done: Callable[[str, int | None], None]
    ) -> None:
        self.rows.append(row)
        self.done.append(done)

    def read_register(self, row: int, item: str, done: Callable[[str, int | None], None]) -> None:
        self.rows.append(row)
        self.done.append(done)

    def write_goals(self) -> None:
        pass

    def follow_goals(self, rows: Sequence[int]) -> None:
        self.followed += rows


class Joints:
    """The joints of the robot in front of them, with torque, and what was answered and reported."""

    def __init__(self, plan: Plan) -> None:
        self.arrays = arrays = CoupledJointArrays(plan.mechanics, States.empty(5), Commands.empty(5))
        self.torque = arrays.servo_states.torque
        arrays.servo_states.motion[:], arrays.servo_states.valid[:] = 0.0, True
        self.torque[:], arrays.servo_states.mode[:] = Torque.ON, Mode.POSITION
        self.servos, self.events = Servos(), Events()
        self.together = CouplingCheck(plan.mechanics, plan.loop, plan.buses, arrays, self.events)
        self.hardware = JointHardware(self.servos, plan.mechanics, arrays, self.together, 20_000_000)
        self.answers: list[str] = []


@pytest.fixture
def joints(plan: Callable[..., Plan]) -> Joints:
    return Joints(plan())


@pytest.mark.parametrize("partner", [Torque.ON, Torque.DOUBT])
def test_a_servo_without_torque_takes_it_from_its_partner_once(joints: Joints, partner: Torque) -> None:
    joints.torque[HIP_SERVOS] = Torque.OFF, partner
    joints.hardware.read_states()
    joints.hardware.read_states()
    assert joints.servos.switched == [(2, False)]
    ((name, text),) = joints.events.of(EventCode.TORQUE_OFF)
    assert name == "hip"
    assert "torque is switched off on ID 3 on bus main, as ID 2 on bus main of" in text


@pytest.mark.parametrize("partner", [Torque.LOST, Torque.REBOOTING, Torque.UNKNOWN])
def test_partner_without_certain_torque_is_not_switched_off(joints: Joints, partner: Torque) -> None:
    joints.torque[HIP_SERVOS] = Torque.OFF, partner
    joints.hardware.read_states()
    assert joints.servos.switched == []
    assert not joints.events.of(EventCode.TORQUE_OFF)


def test_it_does_so_while_another_mechanism_is_switched(joints: Joints) -> None:
    joints.hardware.switch_torque(PITCH, False, joints.answers.append)
    joints.torque[HIP_SERVOS] = Torque.OFF, Torque.ON
    joints.hardware.read_states()
    assert joints.servos.switched == [(4, False), (5, False), (2, False)]


@pytest.mark.parametrize("problems", [("", ""), ("refuses", ""), ("", "refuses")])
def test_torque_is_answered_when_all_servos_have_answered(joints: Joints, problems: tuple[str, str]) -> None:
    joints.hardware.switch_torque(HIP, False, joints.answers.append)
    for done, problem in zip(joints.servos.done, problems, strict=True):
        assert joints.answers == []
        done(problem)
    assert joints.answers == ["".join(problems)]


@pytest.mark.parametrize("problems", [("", ""), ("refuses", ""), ("", "refuses")])
def test_a_register_is_answered_with_what_any_servo_refused(
    joints: Joints, problems: tuple[str, str]
) -> None:
    found: list[tuple[str, int | None]] = []
    joints.hardware.write_register(HIP, "led", 1, lambda problem, value: found.append((problem, value)))
    for done, problem, value in zip(joints.servos.done, problems, (7, 8), strict=True):
        done(problem, value)
    assert found == [("".join(problems), 7)]


@pytest.mark.parametrize("first", [7, 8])
def test_servos_of_a_joint_that_differ_in_a_register_are_named_with_their_values(
    joints: Joints, first: int
) -> None:
    found: list[tuple[str, int | None]] = []
    joints.hardware.read_register(HIP, "led", lambda *answer: found.append(answer))
    assert joints.servos.rows == HIP_SERVOS
    for done, value in zip(joints.servos.done, (first, 8), strict=True):
        done("", value)
    differ = f"its servos have different values: ID 2 on bus main has {first}, ID 3 on bus main has 8"
    assert found == [(differ if first != 8 else "", first)]


@pytest.mark.parametrize("servo", range(6))
def test_row_after_the_joints_is_the_register_of_a_single_servo(joints: Joints, servo: int) -> None:
    found: list[tuple[str, int | None]] = []
    joints.hardware.read_register(5 + servo, "led", lambda *answer: found.append(answer))
    joints.hardware.write_register(5 + servo, "led", 1, lambda *answer: found.append(answer))
    assert joints.servos.rows == [servo, servo]
    for done in joints.servos.done:
        done("", 3)
    assert found == [("", 3), ("", 3)]


def test_start_offset_of_two_servos_is_gone_after_one_second_of_writes(joints: Joints) -> None:
    goals = joints.arrays.servo_goals.position
    goals[:] = 0.0
    goals[HIP_SERVOS] = 0.20, 0.24
    joints.arrays.fill_joint_goals()
    joints.arrays.servo_states.mode[:] = Mode.POSITION
    spread = []
    for _ in range(50):  # 20 ms each
        joints.hardware.write_goals()
        spread.append(goals[2] - goals[1])
    assert spread[24] == pytest.approx(0.02)
    assert spread[49] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("limp", [(1,), (2,), (1, 2)])
def test_joint_gets_no_torque_at_the_start_outside_its_limits_unless_all_its_servos_are_to_be_limp(
    plan: Callable[..., Plan], limp: tuple[int, ...]
) -> None:
    made = plan()
    (bus,) = made.buses
    servos = tuple(replace(one, torque_at_start=one.row not in limp) for one in bus.servos)
    joints = Joints(replace(made, buses=(replace(bus, servos=servos),)))
    joints.arrays.servo_states.position[HIP_SERVOS] = 2.0
    found = [text.split(":")[0] for text in joints.together.at_start()]
    outside = "hip (ID 2 and 3 on bus main) is at 114.6 deg, outside its limits -60.0 deg..60.0 deg"
    assert found == [outside] * (len(limp) == 1)


@pytest.mark.parametrize(("ticks", "fits"), [(0.9, True), (1.1, False)])
def test_joint_of_unlike_servos_may_stand_a_tick_of_the_coarser_one_beyond_its_limits(
    plan: Callable[..., Plan], ticks: float, fits: bool
) -> None:
    first = ("XM430-W350, reference: 180 deg, direction: 1,", "XL430-W250, reference: 180 deg, direction: 1,")
    second = ("{id: 3, direction: -1}", "{id: 3, model: XL-320, reference: 150 deg}")
    joints = Joints(plan(first, second))
    joints.arrays.servo_states.position[HIP_SERVOS] = math.radians(60 + ticks * 300 / 1023)
    assert (joints.together.at_start() == []) is fits


@pytest.mark.parametrize("position", [2.0, -2.0])
@pytest.mark.parametrize("second", [Torque.ON, Torque.RELEASED])
def test_no_joint_with_a_limp_servo_gets_torque_outside_its_limits(
    joints: Joints, position: float, second: Torque
) -> None:
    joints.torque[HIP_SERVOS] = Torque.RELEASED, second
    joints.arrays.servo_states.position[HIP_SERVOS] = position
    joints.arrays.fill_joint_states()
    joints.hardware.switch_torque(HIP, True, joints.answers.append)
    assert joints.servos.switched == []
    (answer,) = joints.answers
    assert "outside its limits -60.0 deg..60.0 deg" in answer


@pytest.mark.parametrize(
    ("pitch", "roll", "outside"),
    [(0.0, 1.2, "roll"), (0.0, -1.2, "roll"), (0.9, 0.0, "pitch"), (0.7, 0.7, "")],
)
def test_no_joint_of_a_limp_wrist_may_be_outside_its_limits(
    joints: Joints, pitch: float, roll: float, outside: str
) -> None:
    wrist = [4, 5]
    joints.torque[wrist] = Torque.RELEASED
    joints.arrays.servo_states.position[wrist] = pitch + roll, pitch - roll
    joints.arrays.fill_joint_states()
    joints.hardware.switch_torque(PITCH, True, joints.answers.append)
    assert bool(joints.servos.switched) == (not outside)
    assert [answer.split(" (")[0] for answer in joints.answers] == [outside] * bool(outside)


def test_servos_that_are_given_torque_apart_keep_their_places_and_then_agree(joints: Joints) -> None:
    arrays = joints.arrays
    arrays.servo_states.position[HIP_SERVOS] = 0.20, 0.24
    joints.hardware.read_states()
    arrays.goals.position[:] = arrays.states.position
    joints.hardware.follow_goals([HIP])
    assert joints.servos.followed == HIP_SERVOS
    goals = arrays.servo_goals.position
    joints.hardware.write_goals()
    assert goals[HIP_SERVOS] == pytest.approx([0.20, 0.24], abs=0.001)
    for _ in range(50):  # 20 ms each
        joints.hardware.write_goals()
    assert goals[HIP_SERVOS] == pytest.approx([0.22, 0.22])
