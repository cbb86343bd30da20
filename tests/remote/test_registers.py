# ruff: noqa: E501 (a request and its answer are read best side by side)

"""What a client may change in a servo's memory, by ASGI: what reaches the loop, and what is refused before."""

import json
from dataclasses import replace

import pytest

from dxlrun.dynamixel.control_table import control_table
from dxlrun.dynamixel.plan.planning import Wiring, bus_plan
from dxlrun.run.channels.answers import Code, Refusal

GAIN = "/joints/pan/registers/position_p_gain"


@pytest.fixture
def arm(desk):
    """Return the desk of a robot with two XM430."""
    table = control_table("XM430-W350", 2.0)
    wirings = [
        Wiring(name, row, 11 + row, table, 3.14, 1, -1.0, 1.0) for row, name in enumerate(("pan", "tilt"))
    ]
    bus = bus_plan(
        name="main",
        port="sim",
        baud_rate=1_000_000,
        latency_ns=0,
        return_delay_ns=0,
        joints=wirings,
        protocol=2.0,
    )
    desk.link.plan = replace(desk.link.plan, buses=(bus,))
    return desk


@pytest.mark.parametrize(
    ("item", "given", "raw"),
    [("position_p_gain", 900, 900), ("profile_acceleration", "10 rad/s^2", 27), ("led", 1, 1)],
)
def test_the_loop_gets_the_integer_of_the_wire(arm, item, given, raw):
    assert arm.ask("POST", f"/joints/pan/registers/{item}", {"value": given}) == (
        200,
        {"done": True, "cycle": 0},
    )
    (taken,) = arm.taken
    assert (taken.controller, taken.kind) == ("", "register")
    assert json.loads(taken.data) == {"joint": "pan", "item": item, "value": raw}


def test_a_servos_failure_is_the_answer(arm):
    said = "pan (ID 11 on bus main) did not answer"
    refusal = Refusal(Code.REGISTER_NOT_WRITTEN, {"problem": said})
    status, content = arm.ask("POST", GAIN, {"value": 1}, refusal=refusal)
    assert (status, content["refused"], content["code"]) == (409, said, "register_not_written")


@pytest.mark.parametrize(
    ("path", "body", "status", "said"),
    [
        ("/joints/pen/registers/led", {"value": 1}, 404, "there is no joint pen; did you mean pan?"),
        ("/joints/pan/registers/lad", {"value": 1}, 404, "pan: an XM430-W350 has no register lad; did you mean led?"),
        (GAIN, {"value": 20_000}, 422, "pan: Position P Gain (84) of an XM430-W350 is 0..16383, not 20000"),
        (GAIN, {"value": "5 V"}, 422, "pan: Position P Gain (84) has no unit, but is '5 V'"),
        ("/joints/pan/registers/profile_acceleration", {"value": "5 V"}, 422, "profile_acceleration of pan: '5 V' has the unit V"),
        ("/joints/pan/registers/goal_position", {"value": 1}, 422, "is not to be changed: controllers command it; write another item"),
        ("/joints/pan/registers/present_position", {"value": 1}, 422, "can only be read; write another item"),
        ("/joints/pan/registers/torque_enable", {"value": 0}, 422, "dxlrun switches the torque"),
        ("/joints/pan/registers/bus_watchdog", {"value": 0}, 422, "dxlrun arms it"),
        ("/joints/pan/registers/return_delay_time", {"value": 0}, 422, "is in the EEPROM"),
        (GAIN, {"value": True}, 422, "Expected `int | str`, got `bool`"),
        (GAIN, {"value": 1.0}, 422, "Expected `int | str`, got `float`"),
        (GAIN, {"gain": 1}, 422, 'write for example {"value": 800}'),
    ],
)  # fmt: skip
def test_what_cannot_be_written_does_not_reach_the_loop(arm, path, body, status, said):
    found, content = arm.ask("POST", path, body)
    assert (found, said in content["refused"]) == (status, True), content
    assert arm.taken == []
