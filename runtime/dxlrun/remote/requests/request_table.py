"""Requests: table of all requests of clients to a running robot, with path, body and reply.

The gateway's routes, the client's methods and the OpenAPI description (`network/openapi.py`) follow from this
table.
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
"""Rate limits of a client, 1/s: for commands, set-points and queries; a tenth of them may be made at once."""
_NAME = re.compile(r"\{\w+(?::path)?\}")

Body = TypeVar("Body")
Answer = TypeVar("Answer")


@unique
class Role(IntEnum):
    """Permission of a client; each role includes the lower ones."""

    OBSERVE = 1
    COMMAND = 2
    ADMIN = 3
    """May change registers, the loop's rate and its controllers; role of clients on the robot's own computer.
    """


class Request(msgspec.Struct, Generic[Body, Answer], frozen=True):
    """A row of the table: method, path, body, reply, rate limit and role of one kind of request."""

    method: str
    path: str
    """Path with parameters in braces; `:path` marks parameters that may contain slashes."""
    body: type[Body]
    """Type of the JSON body; NoneType: no body; bytes: the gateway's handler decodes the content."""
    answer: type[Answer]
    """Type of the JSON reply; bytes: any content."""
    rate: float = MOST_OPERATIONS
    """Rate limit of a client, 1/s, counted over all requests with the same number; 0: no limit."""
    query: tuple[str, ...] = ()
    """Names of the parameters that the query may have."""
    role: Role = Role.COMMAND
    """Lowest role that may make the request; only the commander may make one that is not a GET."""

    def target(self, *names: object) -> str:
        """Return the path with its parameters replaced by `names`, quoted so that a slash does not split the
        path.
        """
        path = self.path
        for name in names:
            path = _NAME.sub(quote(str(name), safe=""), path, count=1)
        return path


class Value(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Body of a request to write a register: an integer on the wire, or a quantity with its unit."""

    value: int | str


class NewValues(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Body of a change of live parameters: dotted name -> value as in the robot file."""

    values: dict[str, Written]


class NewMotion(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Body of a request to play a motion file."""

    text: str
    """Content of the motion file."""
    file: str = "motion"
    """Name of the motion file, for messages and the log."""
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
# Paths, because servos that share joints have names such as hip/1.
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
"""All requests, in the order of the table. `halt` and `stop` have no rate limit."""

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
"""Type of a body -> example, for refusals."""
