"""Requests: all that clients may ask of a running robot, each with its path, its body and its answer.

The gateway's routes, the client's methods and the description for other programs (`network/openapi.py`)
follow from this table.
"""

from __future__ import annotations

import re
from enum import IntEnum, unique
from types import NoneType
from typing import Generic, TypeAlias, TypeVar
from urllib.parse import quote

import msgspec

from dxlrun.channels.loop_requests import Rate, RebootRequest, Switch, TorqueRequest
from dxlrun.remote.requests.replies import (
    Changed,
    Clamped,
    Events,
    Executed,
    Frames,
    Goals,
    GoalState,
    Parameters,
    RobotInfo,
    Topics,
    Written,
)

MOST_OPERATIONS = 200.0
MOST_SET_POINTS = 4000.0
MOST_LOOKS = 2000.0
"""A second, of one process; a short burst may be as many at once as come in a tenth of it."""
_NAME = re.compile(r"\{\w+(?::path)?\}")

Body = TypeVar("Body")
Answer = TypeVar("Answer")


@unique
class Role(IntEnum):
    """What a client may request; each role may do what those before it may."""

    OBSERVE = 1
    COMMAND = 2
    ADMIN = 3
    """Change registers, the loop's rate and its controllers; a client on the robot's own computer has it."""


class Request(msgspec.Struct, Generic[Body, Answer], frozen=True):
    """A request that clients may make."""

    method: str
    path: str
    """Words in braces are names, with `:path` those that may have slashes."""
    body: type[Body]
    """JSON of this; None: there is none; bytes: the gateway checks what it may be."""
    answer: type[Answer]
    """JSON of this; bytes: anything else."""
    rate: float = MOST_OPERATIONS
    """How many a second of one process, together with all others of this number; 0: it is always taken."""
    query: tuple[str, ...] = ()
    """What may follow behind a question mark."""
    role: Role = Role.COMMAND
    """The least that a client needs; `network/commander.py` has what else."""

    def target(self, *names: object) -> str:
        """Return the path with these names, which cannot leave their places."""
        path = self.path
        for name in names:
            path = _NAME.sub(quote(str(name), safe=""), path, count=1)
        return path


class Value(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Body of a register's request: the integer on the wire, or a quantity with its unit."""

    value: int | str


class NewValues(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Body of a change of live parameters: values as in the robot file, by dotted name."""

    values: dict[str, Written]


class NewMotion(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Body of a motion that is to be played."""

    text: str
    """Of the motion file."""
    file: str = "motion"
    """Its name, for the places of mistakes and the log."""
    speed: float = 1.0


Row: TypeAlias = dict[str, object]
Done: TypeAlias = Executed[int]

ROBOT = Request("GET", "/robot", NoneType, RobotInfo, MOST_LOOKS, role=Role.OBSERVE)
STATES = Request("GET", "/states", NoneType, bytes, MOST_LOOKS, role=Role.OBSERVE)
FRAMES = Request("GET", "/frames", NoneType, Frames, MOST_LOOKS, role=Role.OBSERVE)
LOG_HEADER = Request("GET", "/log-header", NoneType, bytes, MOST_LOOKS, role=Role.OBSERVE)
EVENTS = Request("GET", "/events", NoneType, Events, MOST_LOOKS, ("after",), role=Role.OBSERVE)
TOPICS = Request("GET", "/topics", NoneType, Topics, MOST_LOOKS, role=Role.OBSERVE)
STREAM = Request(
    "GET", "/stream", NoneType, bytes, MOST_LOOKS, ("topic", "newest", "rate", "once"), role=Role.OBSERVE
)
GOALS = Request("GET", "/goals", NoneType, Goals, MOST_LOOKS, role=Role.OBSERVE)
GOAL = Request("GET", "/goals/{number}", NoneType, GoalState, MOST_LOOKS, ("wait",), role=Role.OBSERVE)
CANCEL = Request("POST", "/goals/{number}/cancel", NoneType, Done)
CANCEL_OF = Request("POST", "/controllers/{name}/cancel", NoneType, Done)
PARAMETERS = Request("GET", "/controllers/{name}/parameters", NoneType, Parameters, role=Role.OBSERVE)
CHANGE = Request("POST", "/controllers/{name}/parameters", NewValues, Changed)
COMMAND = Request("POST", "/controllers/{name}/commands/{kind}", bytes, Done, query=("units", "in", "goal"))
SET_POINT = Request(
    "POST", "/controllers/{name}/set-points/{kind}", bytes, Clamped, MOST_SET_POINTS, ("lease",)
)
LOAD = Request("POST", "/controllers", Row, Done, role=Role.ADMIN)
UNLOAD = Request("DELETE", "/controllers/{name}", NoneType, Done, role=Role.ADMIN)
PLAY = Request("POST", "/play", NewMotion, Done)
SWITCH = Request("POST", "/switch", Switch, Done)
# paths, since servos that share joints have names such as hip/1
REGISTER = Request("POST", "/joints/{name:path}/registers/{item}", Value, Done, role=Role.ADMIN)
READ_REGISTER = Request("GET", "/joints/{name:path}/registers/{item}", NoneType, Row)
JOINT = Request("GET", "/joints/{name:path}", NoneType, Row, MOST_LOOKS, role=Role.OBSERVE)
TORQUE = Request("POST", "/torque", TorqueRequest, Done)
REBOOT = Request("POST", "/reboot", RebootRequest, Done)
RATE = Request("POST", "/rate", Rate, Done, role=Role.ADMIN)
HALT = Request("POST", "/halt", NoneType, Done, 0)
PAUSE = Request("POST", "/pause", NoneType, Done)
RESUME = Request("POST", "/resume", NoneType, Done)
STOP = Request("POST", "/stop", NoneType, Done, 0)
TAKE_OVER = Request("POST", "/take-over", NoneType, Done)
DESCRIPTION = Request("GET", "/openapi.json", NoneType, Row, MOST_LOOKS, role=Role.OBSERVE)

REQUESTS = tuple(one for one in tuple(globals().values()) if isinstance(one, Request))
"""All of them, in this order. Halt and stop are always taken, as far as there is room."""

EXAMPLES = {
    NewValues: '{"values": {"speed": "20 deg/s"}}',
    Row: '{"name": "arm", "type": "..."}',
    NewMotion: '{"text": "name: wave ...", "speed": 0.5}',
    Switch: '{"activate": ["head"], "deactivate": []}',
    Value: '{"value": 800}',
    TorqueRequest: '{"joints": ["elbow"], "on": false}',
    RebootRequest: '{"joints": ["elbow"]}',
    Rate: '{"rate": 100}',
}
"""Of each body, for what is refused."""
