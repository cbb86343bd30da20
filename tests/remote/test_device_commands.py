"""Devices of a running robot for clients: commands by name, their newest states, and what is refused."""

import json

import msgspec
import numpy as np
import pytest

from dxlrun.cli.steering.joints import source_facts
from dxlrun.control.controllers.plugin_loading import load_plugins
from dxlrun.messages.cdr import Codec
from dxlrun.messages.definition import MessageType
from dxlrun.remote.live.states import RobotStates, array
from dxlrun.testing import plan_of

ROBOT = """\
name: with_board
loop: {rate: 50}
buses: {main: {port: sim, protocol: 2.0, baud_rate: 1_000_000}}
joints: {neck: {bus: main, id: 1, model: XL430-W250, reference: 180 deg, direction: 1}}
devices:
  foot: {bus: main, id: 101, model: generic, states: {force.x: register_1}}
  board:
    {bus: main, id: 102, model: generic, states: [led, register_2], commands: [led, register_7, register_8]}
controllers:
  neck: {type: joint_group_position_controller, joints: [neck]}
  lamps: {type: device_command_controller, commands: [board/register_7, board/led]}
  away: {type: device_command_controller, commands: [board/register_8], active: false}
"""


@pytest.fixture(scope="module")
def plan(tmp_path_factory):
    file = tmp_path_factory.mktemp("robot") / "robot.yaml"
    file.write_text(ROBOT)
    return plan_of(file)


@pytest.fixture
def board(desk_of, plan):
    desk = desk_of(plan, load_plugins())
    desk.record.sources.values[:] = 12.5, 1.0, np.nan
    desk.record.sources.age_ns[:] = 3_000_000, -1
    desk.record.sources.valid[:] = True, False
    desk.finish_cycle()
    return desk


def send(board, device, **values):
    return board.ask("POST", f"/controllers/{device}/commands/device_commands?units=true", values)


def test_a_devices_commands_go_to_the_controller_that_has_them(board):
    status, content = send(board, "board", led=1)
    assert (status, content["done"]) == (200, True)
    (taken,) = board.taken
    assert (taken.controller, taken.kind) == ("lamps", "device_commands")
    np.testing.assert_array_equal(np.frombuffer(taken.data), [np.nan, 1.0])
    assert json.loads(taken.request) == {"values": {"board/led": 1}}


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
    status, content = board.ask("GET", "/joints/foot/force.y")
    assert (status, content["refused"]) == (404, "there is no joint foot/force.y; did you mean foot/force.x?")
    _, content = board.ask("GET", "/joints/board/registers/led")
    assert (
        content["refused"]
        == "there is no joint board; board is not a servo; print its states by `dxlrun get board`"
    )
    opened, sample = board.frames(board.link.open_stream(["/foot"], newest=False))
    assert (opened.type, sample.number) == ("dxlrun_msgs/msg/SourceStates", 2)
    message = Codec(MessageType(opened.type, opened.definition)).unpack(sample.data)
    assert (message["valid"], message["age_ns"], message["name"]) == (True, 3_000_000, ["force.x"])
    assert message["value"].tolist() == [12.5]
    assert board.ask("GET", "/stream?topic=/foot/nothing")[0] == 404
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
