"""Requests for joints of several servos: each becomes one for every servo, and is answered once by all."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from tests.kit.rigs import Events

from dxlrun.channels.cycle import Commands, States, Torque
from dxlrun.channels.events import EventCode
from dxlrun.description.modes import Mode
from dxlrun.dynamixel.mechanics.joint_arrays import JointArrays
from dxlrun.dynamixel.mechanics.joint_hardware import JointHardware, ServosTogether
from dxlrun.plan.robot_plan import Plan

HIP, PITCH = 1, 3
HIP_SERVOS = [1, 2]


class Servos:
    """Keeps what is requested of servos; a test answers."""

    def __init__(self) -> None:
        self.switched: list[tuple[int, bool]] = []
        self.done: list[Callable[..., None]] = []

    def read(self) -> None:
        pass

    def switch_torque(self, row: int, on: bool, done: Callable[[str], None]) -> None:
        self.switched.append((row, on))
        self.done.append(done)

    def set_register(self, row: int, item: str, value: int, done: Callable[[str, int | None], None]) -> None:
        self.done.append(done)


class Joints:
    """The joints of the robot in front of them, with torque, and what was answered and reported."""

    def __init__(self, plan: Plan) -> None:
        self.arrays = arrays = JointArrays(plan.mechanics, States.empty(5), Commands.empty(5))
        self.torque = arrays.servo_states.torque
        arrays.servo_states.motion[:], arrays.servo_states.valid[:] = 0.0, True
        self.torque[:], arrays.servo_states.mode[:] = Torque.ON, Mode.POSITION
        self.servos, self.events = Servos(), Events()
        together = ServosTogether(plan.mechanics, plan.loop, plan.buses, arrays, self.events)
        self.hardware = JointHardware(self.servos, plan.mechanics, arrays, together, 20_000_000)
        self.answers: list[str] = []


@pytest.fixture
def joints(plan: Callable[..., Plan]) -> Joints:
    return Joints(plan())


@pytest.mark.parametrize("partner", [Torque.ON, Torque.DOUBT])
def test_a_servo_without_torque_takes_it_from_its_partner_once(joints: Joints, partner: Torque) -> None:
    joints.torque[HIP_SERVOS] = Torque.OFF, partner
    joints.hardware.read()
    joints.hardware.read()
    assert joints.servos.switched == [(2, False)]
    ((name, text),) = joints.events.of(EventCode.TORQUE_OFF)
    assert name == "hip"
    assert "ID 2 on bus main has no torque, so ID 3 on bus main loses its own" in text


def test_it_does_so_while_another_mechanism_is_switched(joints: Joints) -> None:
    joints.hardware.switch_torque(PITCH, False, joints.answers.append)
    joints.torque[HIP_SERVOS] = Torque.OFF, Torque.ON
    joints.hardware.read()
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
    joints.hardware.set_register(HIP, "led", 1, lambda problem, value: found.append((problem, value)))
    for done, problem, value in zip(joints.servos.done, problems, (7, 8), strict=True):
        done(problem, value)
    assert found == [("".join(problems), 7)]


@pytest.mark.parametrize("position", [2.0, -2.0])
@pytest.mark.parametrize("second", [Torque.ON, Torque.RELEASED])
def test_no_joint_with_a_limp_servo_gets_torque_outside_its_limits(
    joints: Joints, position: float, second: Torque
) -> None:
    joints.torque[HIP_SERVOS] = Torque.RELEASED, second
    joints.arrays.servo_states.position[HIP_SERVOS] = position
    joints.arrays.read()
    joints.hardware.switch_torque(HIP, True, joints.answers.append)
    assert joints.servos.switched == []
    (answer,) = joints.answers
    assert "outside its limits -60.0 deg..60.0 deg" in answer
