"""Devices of a running robot for clients: their messages, and the older names of their commands."""

import json

import msgspec
import pytest

from dxlrun.cli.steering.joints import facts, source_facts
from dxlrun.messages.cdr import Codec
from dxlrun.messages.definition import MessageType
from dxlrun.remote.live.states import RobotStates, array


@pytest.fixture
def board(desk_of):
    desk = desk_of("devices.txt")
    desk.record.sources.values[0], desk.record.sources.valid[0] = 12.5, True
    desk.record.sources.age_ns[0] = 3_000_000
    desk.finish_cycle()
    return desk


def test_facts_distinguish_what_is_measured_and_commanded():
    answer = {"states": {}, "commands": {"lamp": 300.0}, "units": {}, "command_units": {}}
    assert source_facts(answer | {"valid": True, "age": None}) == [("lamp, commanded", "300")]
    names = "position velocity goal_position goal_velocity goal_pwm temperature voltage hardware_error age"
    state = dict.fromkeys(names.split()) | {"unit": "rad", "effort_unit": "A", "torque": "on"}
    found = facts(state | {"mode": "effort", "effort": 0.1, "goal_effort": 0.25})
    assert found[:2] == [("effort", "0.100 A"), ("goal effort", "0.250 A")]


def test_states_of_a_device_are_listened_to(board):
    opened, sample = board.frames(board.link.open_stream(["/foot"], newest=False))
    assert (opened.type, sample.number) == ("dxlrun_msgs/msg/SourceStates", 2)
    message = Codec(MessageType(opened.type, opened.definition)).unpack(sample.data)
    assert (message["valid"], message["age_ns"], message["name"]) == (True, 3_000_000, ["force.x"])
    assert message["value"].tolist() == [12.5]
    assert {"/foot", "/board"} <= {one["name"] for one in board.ask("GET", "/topics")[1]["topics"]}


def test_states_keep_their_older_names_of_commands(board):
    _, content = board.ask("GET", "/states")
    states = msgspec.json.decode(json.dumps(content), type=RobotStates, dec_hook=array)
    assert states.device_commands is states.source_commands
    assert states.device_command is states.source_command
