"""Joints by name: goals made of their commands, registers that limit them, and what servos answer.

Commands that need nothing else are in `requests/joints.txt`, whose robot is used here.
"""

import asyncio
import json

import msgspec
import numpy as np
import pytest
from msgspec.structs import replace
from tests.remote.conftest import plugins

from dxlrun.channels.answers import Acceptance, Code, Completion, Refusal
from dxlrun.channels.cycle import Torque
from dxlrun.channels.event_records import EventBody, EventCode, Severity
from dxlrun.plan.loop_plan import ServoLimit
from dxlrun.remote import link

CURRENT = ServoLimit("effort", 0.0538, "Current Limit (38) = 20, 0.0538 A")
PWM = ServoLimit("pwm", 0.2, "PWM Limit (36) = 177, 20 %")
STILL = ServoLimit("velocity", 0.0, "Velocity Limit (44) = 0, 0 rad/s")
GAIN = "/joints/pan/registers/position_p_gain"


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


def test_a_goal_has_the_time_in_which_its_joint_comes_to_its_speed(head):
    joints = head.gateway._preparation.joints
    joints["pan"] = replace(joints["pan"], acceleration=1.0)
    _, _, command = send(head, "posvel", "position", {"pan": "0.5 rad"}, "&goal=true")
    (part,) = json.loads(command.data.partition(b"\n")[0])["parts"]
    assert part["end_ns"] * 1e-9 == pytest.approx(
        0.5 + 0.5
    )  # 0.25 rad at 0.5 rad/s, to which it comes in 0.5 s


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


def test_a_servos_failure_is_the_answer(head):
    said = "pan (ID 1 on bus main) did not answer"
    refusal = Refusal(Code.REGISTER_NOT_WRITTEN, {"problem": said})
    status, content = head.ask("POST", GAIN, {"value": 1}, refusal=refusal)
    assert (status, content["refused"], content["code"]) == (409, said, "register_not_written")


def test_an_item_is_read_with_its_meaning(head):
    status, content = head.ask(
        "GET", "/joints/pan/registers/return_delay_time", refusal=Completion(7, value=250)
    )
    assert status == 200
    assert content == {
        "done": True,
        "cycle": 7,
        "joint": "pan",
        "item": "return_delay_time",
        "title": "Return Delay Time (9)",
        "area": "EEPROM",
        "value": 250,
        "is": "500 us",
    }
    (taken,) = head.taken
    assert (taken.kind, json.loads(taken.data)) == ("get", {"joint": "pan", "item": "return_delay_time"})


def test_the_old_value_is_answered(head):
    status, content = head.ask("POST", GAIN, {"value": 900}, refusal=Completion(7, value=800))
    assert (status, content) == (200, {"done": True, "cycle": 7, "old": 800, "value": 900})


def test_a_joints_state_is_answered(head):
    head.record.states.position[:] = 0.25
    head.record.states.torque[:] = Torque.RELEASED
    head.finish_cycle()
    status, content = head.ask("GET", "/joints/tilt")
    assert status == 200
    assert (content["joint"], content["position"], content["torque"]) == ("tilt", 0.25, "limp")
    assert (content["effort_unit"], content["velocity"]) == ("A", None)


def test_waiting_answers_keep_the_client_waiting(head, monkeypatch):
    """A joint after the other is done; the last answer counts."""
    answers = [Acceptance(()), Acceptance(()), Completion(9)]

    async def story():
        asked = asyncio.ensure_future(head.request("POST", "/torque", {"joints": ["all"], "on": False}))
        commands = []
        while not commands:
            commands = list(head.mailbox.drain_commands())
            await asyncio.sleep(0)
        for answer in answers:
            assert not asked.done()
            head.mailbox.answer_command(commands[0].number, answer)
            head.link.collect_messages()
            await asyncio.sleep(0.001)
        while head.record.cycle < 9:
            head.finish_cycle()
        for _ in range(20):
            await asyncio.sleep(0)
        assert not asked.done(), "its next states would be those before"
        head.finish_cycle()
        return await asked

    monkeypatch.setattr(link, "_LOOK_S", 0.0)
    assert asyncio.run(story()) == (200, {"done": True, "cycle": 9, "joints": ["pan", "tilt"]})
