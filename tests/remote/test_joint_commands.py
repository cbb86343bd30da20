"""Joints by name: what is made of them and of the newest goals, for each kind of controller."""

import json
from typing import ClassVar

import numpy as np
import pytest

import dxlrun
from dxlrun.control.controllers.plugin_loading import Offer, PlugIns
from dxlrun.plan.loop_plan import ControllerPlan, JointPlan, ServoLimit
from dxlrun.remote.preparation import Preparation
from dxlrun_controllers import group
from dxlrun_controllers.motions.joint_trajectory_controller import JointTrajectoryController

JOINTS = (
    JointPlan("pan", -1.0, 1.0, 2.0, effort=0.5),
    JointPlan("tilt", -1.0, 1.0, 0.25, effort=0.5),
)


class Points(dxlrun.CommandModel):
    points: list[dict[str, float | list[float]]]
    start_in: float


class Whole(dxlrun.Controller[dxlrun.ParametersModel]):
    """Takes trajectories of all its joints."""

    Commands: ClassVar = {"trajectory": Points}

    @classmethod
    def interfaces(cls, parameters, joints):
        return dxlrun.Interfaces(joints, ("position",))

    @classmethod
    def prepare(cls, kind, command, parameters):
        (point,) = command.points
        return np.array([command.start_in, point["time"], *point["positions"]])

    def update(self, time_ns, period_ns):
        pass


TYPES = {
    "positions": group.JointGroupPositionController,
    "posvel": group.JointGroupPosVelController,
    "poseffort": group.JointGroupPosEffortController,
    "velocities": group.JointGroupVelocityController,
    "efforts": group.JointGroupEffortController,
    "pwm": group.JointGroupPwmController,
    "trajectory": JointTrajectoryController,
    "whole": Whole,
}


def plan_of(kind):
    parameters = {} if kind == "whole" else {"joints": ["pan", "tilt"]}
    names = ("pan", "tilt")
    return ControllerPlan(kind, kind, "tests 1", json.dumps(parameters), names, (), (), True, 1)


@pytest.fixture
def head(desk):
    """The desk with one controller of each type, of both joints; pan is sent to 0.25 rad, tilt to -0.5."""
    plugins = PlugIns({kind: Offer(kind, cls, "tests 1") for kind, cls in TYPES.items()}, {})
    desk.gateway._preparation = Preparation({joint.name: joint for joint in JOINTS}, plugins)
    desk.app = desk.gateway.app()
    loaded = type(next(iter(desk.link.controllers.values())))
    desk.link.controllers = {kind: loaded(plan_of(kind), 0) for kind in TYPES}
    for array in (*desk.record.goals.values, desk.record.states.position):
        array.fill(np.nan)
    desk.record.goals.position[:] = [0.25, -0.5]
    desk.finish_cycle()
    return desk


def send(head, controller, interface, values, query="?units=true"):
    status, answer = head.ask("POST", f"/controllers/{controller}/commands/{interface}{query}", values)
    return status, answer, head.taken[-1] if head.taken else None


@pytest.mark.parametrize(
    ("controller", "interface", "values", "data"),
    [
        ("positions", "position", {"pan": "0.5rad"}, [0.5, -0.5]),
        ("positions", "position", {"both": "0.5 rad", "tilt": "0 rad"}, [0.5, 0.0]),
        ("positions", "positions", {"tilt": "0 deg", "pan": "0 deg"}, [0.0, 0.0]),
        ("posvel", "position", {"pan": "0.5 rad"}, [0.5, -0.5, 0.5, 0.25]),
        ("posvel", "velocity", {"pan": "1 rad/s"}, [0.25, -0.5, 1.0, 0.25]),
        ("poseffort", "position", {"pan": "0.5 rad"}, [0.5, -0.5, 0.5, 0.5]),
        ("velocities", "velocity", {"pan": "1 rad/s"}, [1.0, 0.0]),
        ("efforts", "effort", {"tilt": 0.25}, [0.0, 0.25]),
        ("pwm", "pwm", {"tilt": 0.25}, [0.0, 0.25]),
        ("whole", "position", {"pan": "0.5 rad"}, [0.0, 0.5, 0.5, -0.5]),
        ("whole", "position", {"tilt": "0 rad"}, [0.0, 2.0, 0.25, 0.0]),
    ],
)
def test_joints_that_are_not_named_keep_their_goals(head, controller, interface, values, data):
    status, answer, taken = send(head, controller, interface, values)
    assert status == 200, answer
    assert taken.controller == controller
    np.testing.assert_allclose(np.frombuffer(taken.data), data)


def test_a_goal_that_is_not_known_is_the_position_that_was_read(head):
    head.record.goals.position[1] = np.nan
    head.record.states.position[1] = 0.125
    head.finish_cycle()
    assert np.frombuffer(send(head, "positions", "position", {"pan": "0 deg"})[2].data).tolist() == [0, 0.125]
    head.record.states.position[1] = np.nan
    head.finish_cycle()
    status, answer, _ = send(head, "positions", "position", {"pan": "0 deg"})
    assert (status, "the positions of tilt are not known yet" in answer["refused"]) == (422, True)


def test_a_trajectory_gets_there_in_its_time(head):
    _, _, taken = send(head, "whole", "position", {"pan": 0.5}, "?in=3")
    np.testing.assert_allclose(np.frombuffer(taken.data), [0.0, 3.0, 0.5, -0.5])
    status, answer, taken = send(head, "trajectory", "position", {"pan": "0.5 rad"}, "?units=true&in=3")
    assert (status, taken.kind) == (200, "trajectory"), answer


# Goals


def played_part(head):
    data, _, numbers = head.taken[-1].data.partition(b"\n")
    (part,) = json.loads(data)["parts"]
    return part, np.frombuffer(numbers, "<f8").tolist()


@pytest.mark.parametrize(
    ("controller", "values", "seconds"),
    [
        ("positions", {"tilt": "0 rad"}, 2.0),  # 0.5 rad at 0.25 rad/s
        ("posvel", {"pan": "0.5 rad"}, 0.5),  # at 0.5 rad/s
        ("poseffort", {"pan": "0.5 rad"}, 0.125),
    ],
)
def test_positions_of_a_group_controller_become_a_goal_when_they_are_waited_for(
    head, controller, values, seconds
):
    head.record.states.position[:] = [0.25, -0.5]
    head.finish_cycle()
    _, answer, command = send(head, controller, "position", values, "?units=true&goal=true")
    assert command.controller == ""
    assert command.kind == "play", answer
    part, numbers = played_part(head)
    asked = [0.5, -0.5] if "pan" in values else [0.25, 0.0]
    assert (part["controller"], part["positions"], numbers[:2]) == (controller, asked, asked)
    assert part["end_ns"] * 1e-9 == pytest.approx(seconds)


@pytest.mark.parametrize(("controller", "goal"), [("positions", "&goal=true"), ("whole", "")])
def test_joint_that_a_register_holds_still_is_refused(head, controller, goal):
    head.record.states.position[:] = [0.25, -0.5]
    head.finish_cycle()
    limit = ServoLimit("velocity", 0.0, "Velocity Limit (44) = 0, 0 rad/s")
    head.gateway._preparation.take_servo_limits("tilt", (limit,))
    status, answer, taken = send(head, controller, "position", {"tilt": "0 rad"}, f"?units=true{goal}")
    assert (status, answer["code"], taken) == (422, "invalid", None)
    assert "tilt cannot move, as its servo has Velocity Limit (44) = 0" in answer["refused"]
    status, answer, _ = send(head, controller, "position", {"pan": "0.5 rad"}, f"?units=true{goal}")
    assert status == 200, answer


@pytest.mark.parametrize(("controller", "interface"), [("efforts", "effort"), ("trajectory", "position")])
def test_other_commands_are_what_they_are_when_they_are_waited_for(head, controller, interface):
    head.record.states.position[:] = [0.25, -0.5]
    head.finish_cycle()
    value = 0.2 if interface == "effort" else "0.5 rad"
    _, _, command = send(head, controller, interface, {"pan": value}, "?units=true&goal=true")
    assert command.controller == controller
