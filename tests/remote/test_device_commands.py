"""Devices of a running robot for clients: commands by name, their newest states, and what is refused."""

import json

import msgspec
import numpy as np
import pytest
from tests.remote.conftest import plugins

from dxlrun.cli.steering.joints import facts, source_facts
from dxlrun.messages.cdr import Codec
from dxlrun.messages.definition import MessageType
from dxlrun.remote.live.states import RobotStates, array


@pytest.fixture
def board(desk_of, plan_in):
    desk = desk_of(plan_in("devices.txt"), plugins())
    desk.record.sources.values[:] = 12.5, 1.0, np.nan
    desk.record.sources.age_ns[:] = 3_000_000, -1
    desk.record.sources.valid[:] = True, False
    desk.finish_cycle()
    return desk


def send(board, device, **values):
    return board.ask("POST", f"/controllers/{device}/commands/device_commands?units=true", values)


def test_a_command_that_no_controller_takes_names_the_type_that_would(board, monkeypatch):
    loaded = board.link.controllers
    monkeypatch.delitem(loaded, "away")
    assert (
        "NAME: {type: device_command_controller, commands: [board/register_8]}"
        in (send(board, "board", register_8=1)[1]["refused"])
    )


def test_what_is_commanded_of_a_device_is_asked_for_by_name(board):
    names = list(board.record.layout.source_commands)
    board.record.source_commands[:] = [
        {"board/led": 1.0, "board/register_7": 300.0}.get(one, np.nan) for one in names
    ]
    board.finish_cycle()
    answer = board.ask("GET", "/joints/board/led")[1]
    assert (answer["states"], answer["commands"]) == ({"led": 1.0}, {"led": 1.0})
    answer = board.ask("GET", "/joints/board/register_7")[1]  # which is read nowhere
    assert (answer["states"], answer["commands"]) == ({}, {"register_7": 300.0})
    assert source_facts(answer) == [("register_7, commanded", "300")]
    answer = board.ask("GET", "/joints/board")[1]
    assert answer["commands"] == {"led": 1.0, "register_7": 300.0, "register_8": None}
    assert ("led, commanded", "1") in source_facts(answer)
    hint = board.ask("GET", "/joints/board/register_9")[1]["refused"]
    assert "board/register_7" in hint


def test_effort_and_its_goal_are_two_facts():
    names = "position velocity goal_position goal_velocity goal_pwm temperature voltage hardware_error age"
    state = dict.fromkeys(names.split()) | {
        "unit": "rad",
        "effort_unit": "A",
        "torque": "on",
        "mode": "effort",
    }
    found = facts(state | {"effort": 0.1, "goal_effort": 0.25})
    assert found[:2] == [("effort", "0.100 A"), ("goal effort", "0.250 A")]


def test_states_of_a_device_are_asked_for_by_name_and_listened_to(board):
    shown = {"valid": True, "age": 0.003, "states": {"force.x": 12.5}, "commands": {}}
    shown |= {"units": {}, "command_units": {}}
    status, content = board.ask("GET", "/joints/foot/force.x")
    assert (status, content) == (200, {"source": "foot/force.x", "cycle": 1, **shown})
    assert board.ask("GET", "/joints/board")[1] == {
        "source": "board",
        "cycle": 1,
        "valid": False,
        "age": None,
        "states": {"led": 1.0, "register_2": None},
        "commands": {"led": None, "register_7": None, "register_8": None},
        "units": {},
        "command_units": {},
    }
    assert board.ask("GET", "/joints/neck")[1]["joint"] == "neck"
    opened, sample = board.frames(board.link.open_stream(["/foot"], newest=False))
    assert (opened.type, sample.number) == ("dxlrun_msgs/msg/SourceStates", 2)
    message = Codec(MessageType(opened.type, opened.definition)).unpack(sample.data)
    assert (message["valid"], message["age_ns"], message["name"]) == (True, 3_000_000, ["force.x"])
    assert message["value"].tolist() == [12.5]
    assert {"/foot", "/board"} <= {one["name"] for one in board.ask("GET", "/topics")[1]["topics"]}


def test_states_keep_their_older_names_of_commands(board):
    board.record.source_commands[:] = 1.0, np.nan, 300.0
    board.finish_cycle()
    _, content = board.ask("GET", "/states")
    assert content["device_commands"] == ["board/led", "board/register_7", "board/register_8"]
    assert content["device_command"] == [1.0, None, 300.0]
    states = msgspec.json.decode(json.dumps(content), type=RobotStates, dec_hook=array)
    assert states.device_commands is states.source_commands
    assert states.device_command is states.source_command
    np.testing.assert_array_equal(states.source_command, [1.0, np.nan, 300.0])
