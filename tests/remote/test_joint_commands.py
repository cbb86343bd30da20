"""Joints by name: goals that are made of their commands, and registers of servos that limit them.

Commands that need nothing else are in `requests/joints.txt`, whose robot is used here.
"""

import json

import msgspec
import numpy as np
import pytest
from tests.remote.conftest import plugins

from dxlrun.channels.event_records import EventBody, EventCode, Severity
from dxlrun.plan.loop_plan import ServoLimit

CURRENT = ServoLimit("effort", 0.0538, "Current Limit (38) = 20, 0.0538 A")
PWM = ServoLimit("pwm", 0.2, "PWM Limit (36) = 177, 20 %")
STILL = ServoLimit("velocity", 0.0, "Velocity Limit (44) = 0, 0 rad/s")


@pytest.fixture
def head(desk_of, plan_in):
    """The desk of the robot; pan is at 0.25 rad, tilt at -0.5."""
    desk = desk_of(plan_in("joints.txt"), plugins())
    for array in desk.record.goals.values:
        array.fill(np.nan)
    desk.record.goals.position[:] = desk.record.states.position[:] = [0.25, -0.5]
    desk.finish_cycle()
    return desk


def send(head, controller, interface, values, query=""):
    path = f"/controllers/{controller}/commands/{interface}?units=true{query}"
    status, answer = head.ask("POST", path, values)
    return status, answer, head.taken[-1] if head.taken else None


def report(head, joint, *limits):
    event = EventBody(EventCode.SERVO_LIMITS, Severity.INFO, "")
    head.events.emit_event(joint, event, msgspec.json.encode(limits))
    head.link.collect_messages()


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
    _, answer, command = send(head, controller, "position", values, "&goal=true")
    assert (command.controller, command.kind) == ("", "play"), answer
    data, _, numbers = command.data.partition(b"\n")
    (part,) = json.loads(data)["parts"]
    asked = [0.5, -0.5] if "pan" in values else [0.25, 0.0]
    assert (part["controller"], part["positions"]) == (controller, asked)
    assert np.frombuffer(numbers, "<f8").tolist()[:2] == asked
    assert part["end_ns"] * 1e-9 == pytest.approx(seconds)


def test_a_trajectory_is_what_it_is_when_it_is_waited_for(head):
    for query in ("&goal=true", "&in=3"):
        _, answer, command = send(head, "trajectory", "position", {"pan": "0.5 rad"}, query)
        assert (command.controller, command.kind) == ("trajectory", "trajectory"), answer


@pytest.mark.parametrize(("controller", "goal"), [("positions", "&goal=true"), ("whole", "")])
def test_joint_that_a_register_holds_still_is_refused(head, controller, goal):
    report(head, "tilt", STILL)
    status, answer, taken = send(head, controller, "position", {"tilt": "0 rad"}, goal)
    assert (status, answer["code"], taken) == (422, "invalid", None)
    assert "servo has Velocity Limit (44) = 0" in answer["refused"]
    status, answer, _ = send(head, controller, "position", {"pan": "0.5 rad"}, goal)
    assert status == 200, answer


@pytest.mark.parametrize(
    ("controller", "interface", "within", "said"),
    [
        (
            "efforts",
            "effort",
            -0.05,
            f"pan is commanded to 0.3, more than 0.0538, servo register {CURRENT.text}",
        ),
        ("pwm", "pwm", 0.2, PWM.text),
    ],
)
def test_a_command_beyond_a_register_is_refused_once_the_loop_has_reported_it(
    head, controller, interface, within, said
):
    assert send(head, controller, interface, {"pan": 0.3})[0] == 200
    report(head, "pan", CURRENT, PWM)
    status, answer, _ = send(head, controller, interface, {"pan": 0.3})
    assert (status, answer["code"], said in answer["refused"]) == (422, "beyond_limits", True), answer
    assert send(head, controller, interface, {"pan": within})[0] == 200
