# ruff: noqa: E501 (a request and its answer are read best side by side)

"""What a client may change in a servo's memory, by ASGI: what reaches the loop, and what is refused before."""

import asyncio
import json

import pytest
from tests.remote.conftest import plugins

from dxlrun.channels.answers import Acceptance, Code, Completion, Refusal
from dxlrun.channels.cycle import Torque

GAIN = "/joints/pan/registers/position_p_gain"


@pytest.fixture
def arm(desk_of, plan_in):
    """Return the desk of a robot with two XM430."""
    return desk_of(plan_in("joints.txt"), plugins())


def test_a_servos_failure_is_the_answer(arm):
    said = "pan (ID 1 on bus main) did not answer"
    refusal = Refusal(Code.REGISTER_NOT_WRITTEN, {"problem": said})
    status, content = arm.ask("POST", GAIN, {"value": 1}, refusal=refusal)
    assert (status, content["refused"], content["code"]) == (409, said, "register_not_written")


def test_an_item_is_read_with_its_meaning(arm):
    status, content = arm.ask(
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
    (taken,) = arm.taken
    assert (taken.kind, json.loads(taken.data)) == ("get", {"joint": "pan", "item": "return_delay_time"})


def test_the_old_value_is_answered(arm):
    status, content = arm.ask("POST", GAIN, {"value": 900}, refusal=Completion(7, value=800))
    assert (status, content) == (200, {"done": True, "cycle": 7, "old": 800, "value": 900})


def test_a_joints_state_is_answered(arm):
    arm.record.states.position[:] = 0.25
    arm.record.states.torque[:] = Torque.RELEASED
    arm.finish_cycle()
    status, content = arm.ask("GET", "/joints/tilt")
    assert status == 200
    assert (content["joint"], content["position"], content["torque"]) == ("tilt", 0.25, "limp")
    assert (content["effort_unit"], content["velocity"]) == ("A", None)


def test_waiting_answers_keep_the_client_waiting(arm):
    """A joint after the other is done; the last answer counts."""
    answers = [Acceptance(()), Acceptance(()), Completion(9)]

    async def story():
        asked = asyncio.ensure_future(arm.request("POST", "/torque", {"joints": ["all"], "on": False}))
        commands = []
        while not commands:
            commands = list(arm.mailbox.drain_commands())
            await asyncio.sleep(0)
        for answer in answers:
            assert not asked.done()
            arm.mailbox.answer_command(commands[0].number, answer)
            arm.link.collect_messages()
            await asyncio.sleep(0.001)
        for _ in range(12):
            arm.finish_cycle()
        return await asked

    assert asyncio.run(story()) == (200, {"done": True, "cycle": 9, "joints": ["pan", "tilt"]})
