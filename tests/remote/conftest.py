"""A gateway without processes: its link lies on real rings, the test is the loop at their other end."""

import asyncio
import json
import signal
import socket
import time
from contextlib import suppress
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Annotated, ClassVar

import msgspec
import numpy as np
import pytest
from pydantic import Field, model_validator
from tests.kit.cases import read_head

import dxlrun
from dxlrun.channels import heartbeat, mailbox, ring
from dxlrun.channels.answers import Completion
from dxlrun.channels.cycle import CycleRecord
from dxlrun.channels.event_records import LONGEST_EVENT, EventRing
from dxlrun.channels.heartbeat import Heartbeat, Phase
from dxlrun.channels.mailbox import Mailbox
from dxlrun.channels.topic_messages import LONGEST_RECORD, MessageRing
from dxlrun.compile import robot_compiler
from dxlrun.control.controllers.plugin_loading import Offer, PlugIns, load_plugins
from dxlrun.remote.gateway import GatewayApp
from dxlrun.remote.job import Descriptors
from dxlrun.remote.link import Link
from dxlrun.remote.preparation import Preparation
from dxlrun.remote.requests.replies import FRAME_LENGTH, Frame
from dxlrun.remote.requests.request_table import Role
from dxlrun.remote.server import serve_gateway
from dxlrun.testing import plan_of

PERIOD_NS = 20_000_000
TEXTS = Path(__file__).with_name("requests")
"""Robot files with requests; see `test_requests.py`."""


class Go(dxlrun.CommandModel):
    positions: list[float]


class Grip(dxlrun.CommandModel):
    """How firmly."""

    positions: list[float]
    force: str


class Number(dxlrun.CommandModel):
    """How many."""

    count: int


class ArmParameters(dxlrun.ParametersModel):
    joints: list[str]


class Arm(dxlrun.Controller[ArmParameters]):
    Parameters = ArmParameters
    Commands: ClassVar = {
        "go": Go,
        "positions": Go,
        "grip": Grip,
        "many": Number,
        "break": Number,
        "leave": Number,
        "brood": Number,
    }

    @classmethod
    def interfaces(cls, parameters, joints):
        return dxlrun.Interfaces(joints=tuple(parameters.joints), command=("position",))

    @classmethod
    def prepare(cls, kind, command, parameters):
        if kind == "many":
            return np.zeros(command.count)
        if kind == "break":
            raise KeyError("a mistake of its author")
        if kind == "leave":
            raise SystemExit(3)
        # not the limit of the test, or none
        assert kind != "brood" or 0 < signal.getitimer(signal.ITIMER_REAL)[0] <= 0.05
        while kind == "brood":
            with suppress(Exception):
                time.sleep(0.001)
        if len(command.positions) != len(parameters.joints):
            raise ValueError(f"{len(parameters.joints)} positions,\nplease")
        return np.array(command.positions)

    def update(self, time_ns, period_ns):
        pass


class Gains(dxlrun.ParametersModel):
    p: Annotated[float, Field(ge=0, le=10, description="u/e"), dxlrun.LIVE] = 1.0
    joint: Annotated[dict[str, float], dxlrun.LIVE] = Field({"pan": 0.5})
    d: float = 0.0


class GoalParameters(dxlrun.ParametersModel):
    joints: tuple[str, ...]
    speed: Annotated[dxlrun.AngularVelocity, dxlrun.LIVE] = 1.0
    careful: Annotated[bool, dxlrun.LIVE] = False
    steps: Annotated[int, dxlrun.LIVE] = 3
    gains: Gains = Gains()

    @model_validator(mode="after")
    def _together(self):
        if self.careful and self.speed > 2:
            raise ValueError("a careful arm has a speed of at most 2 rad/s")
        return self


class GoalArm(dxlrun.Controller[GoalParameters]):
    """Takes goals, and has live parameters."""

    Parameters = GoalParameters
    Commands: ClassVar = {"go": Go, "nudge": Go}
    Goals: ClassVar = frozenset({"go"})

    @classmethod
    def interfaces(cls, parameters, joints):
        return dxlrun.Interfaces(joints=parameters.joints, command=("position",))

    @classmethod
    def prepare(cls, kind, command, parameters):
        return np.array([parameters.speed, *command.positions])

    def on_goal(self, goal, data, time_ns):
        pass

    def update(self, time_ns, period_ns):
        pass


class Points(dxlrun.CommandModel):
    points: list[dict[str, float | list[float]]]
    start_in: float


class Wait(dxlrun.CommandModel):
    seconds: float
    pose: str | None = None


class Whole(dxlrun.Controller[dxlrun.ParametersModel]):
    """Takes trajectories of all joints."""

    Commands: ClassVar = {"trajectory": Points, "wait": Wait}

    @classmethod
    def interfaces(cls, parameters, joints):
        return dxlrun.Interfaces(joints, ("position",))

    @classmethod
    def prepare(cls, kind, command, parameters):
        if kind == "wait":
            return np.array([command.seconds])
        (point,) = command.points
        return np.array([command.start_in, point["time"], *point["positions"]])

    def update(self, time_ns, period_ns):
        pass


@cache
def plugins():
    types = {"arm": Arm, "goal_arm": GoalArm, "whole": Whole}
    own = {name: Offer(name, cls, "tests 1") for name, cls in types.items()}
    return PlugIns({**load_plugins().controllers, **own}, {}, drivers=load_plugins().drivers)


@cache
def plan_in(name="controllers.txt"):
    """Return the plan of a text's robot, compiled once."""
    with TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        patch.setattr(robot_compiler, "load_plugins", lambda **_: plugins())
        file = Path(folder) / "robot.yaml"
        file.write_text(read_head(TEXTS / name))
        return plan_of(file)


class Desk:
    """The loop's end of a link, and a client's end of the gateway; the loop does nothing by itself."""

    def __init__(self, text="controllers.txt", offered=None):
        plan = plan_in(text)
        memory = Descriptors(
            heartbeat=heartbeat.create(),
            cycles=ring.create("cycles", 8192, 1000),
            events=ring.create("events", 1 << 20, LONGEST_EVENT),
            guardian=ring.create("guardian", 1 << 16, LONGEST_EVENT),
            mailbox=mailbox.create(8),
            answers=ring.create("answers", mailbox.ANSWERS_CAPACITY, mailbox.LONGEST_ANSWER),
            messages=ring.create("messages", 1 << 20, LONGEST_RECORD),
        )
        self.heartbeat = Heartbeat(memory.heartbeat)
        self.heartbeat.enter_phase(Phase.RUNNING)
        self.mailbox = Mailbox(memory.mailbox, ring.RingWriter(memory.answers))
        self.record = CycleRecord(plan.loop.layout)
        self.record.active = 0b011
        self.cycles = ring.RingWriter(memory.cycles)
        self.clock = SimpleNamespace(now_ns=lambda: 7_000_000_000)
        self.events = EventRing(ring.RingWriter(memory.events), self.clock)
        self.guardian_events = EventRing(ring.RingWriter(memory.guardian), self.clock)
        self.message_ring = ring.RingWriter(memory.messages)
        self.messages = MessageRing(self.message_ring)
        self.link = Link(plan, memory)
        self.gateway = GatewayApp(
            self.link,
            Preparation(
                {joint.name: joint for joint in plan.loop.joints},
                offered or plugins(),
                groups=plan.groups,
                omitted=plan.omitted,
            ),
            "/logs/pair.mcap",
            now=lambda: self.now,
        )
        self.app = self.gateway.app()
        self.now = 100.0  # of allowances, s
        self.taken = []
        self.places = []  # names of the controllers that were loaded
        self.ended = 0
        self.record.cycle = -1
        self.cycles.append(ring.RecordKind.CYCLE, self.record.raw)
        self.finish_cycle()

    # The loop

    def take(self, refusal=None):
        """Take what a cycle takes and answer it; return it."""
        commands = list(self.mailbox.drain_commands())
        for command in commands:
            place = self._place(command) if refusal is None else None
            self.mailbox.answer_command(command.number, refusal or Completion(self.ended - 1, place))
        self.taken += commands
        return commands

    def _place(self, command):
        """Return the place of a controller that is loaded, as the loop's manager chooses it."""
        if command.kind == "unload" and (name := json.loads(command.data)["controller"]) in self.places:
            self.places[self.places.index(name)] = None
        if command.kind != "load":
            return None
        name = json.loads(command.data)["name"]
        if None in self.places:
            self.places[self.places.index(None)] = name
        else:
            self.places.append(name)
        return 3 + self.places.index(name)

    def finish_cycle(self):
        self.record.cycle, self.record.woken_ns = self.ended, 1_000_000_000 + self.ended * PERIOD_NS
        self.cycles.append(ring.RecordKind.CYCLE, self.record.raw)
        self.ended += 1
        self.heartbeat.cycle(self.ended, 0)

    # The client

    def ask(self, *words, refusal=None, **options):
        """Ask the gateway, with a loop that answers; return status and content."""
        return asyncio.run(self._ask_and_answer(refusal, words, options))

    async def _ask_and_answer(self, refusal, words, options):
        asked = asyncio.ensure_future(self.request(*words, **options))
        while not asked.done():
            self.take(refusal)
            self.link.collect_messages()
            await asyncio.sleep(0)
        return asked.result()

    @staticmethod
    def frames(stream):
        data = stream.frames()
        while stream.behind:
            data += stream.frames()
        found = []
        while data:
            end = FRAME_LENGTH.size + FRAME_LENGTH.unpack_from(data)[0]
            found.append(msgspec.msgpack.decode(data[FRAME_LENGTH.size : end], type=Frame))
            data = data[end:]
        return found

    async def request(
        self,
        method,
        path,
        body=b"",
        *,
        headers=(),
        chunks=None,
        client=("process 1", Role.ADMIN),
        heard=None,
    ):
        """Request something by ASGI; return status and content.

        Args:
            chunks: Messages that come from the client instead of a body.
            heard: Gets a number for each message that is awaited.
        """
        body = body if isinstance(body, bytes) else json.dumps(body).encode()
        coming = iter([{"type": "http.request", "body": body}] if chunks is None else chunks)
        said = []

        async def receive():
            if heard is not None:
                heard.append(1)
            if (chunk := next(coming, None)) is None:
                await asyncio.Event().wait()
            return chunk

        async def send(message):
            said.append(message)

        path, _, query = path.partition("?")
        given = [(name.encode(), value) for name, value in headers]
        scope = {"type": "http", "method": method, "path": path, "query_string": query.encode()}
        await self.app({**scope, "headers": given, "client": client}, receive, send)
        self.headers = dict(said[0]["headers"])
        content = b"".join(message.get("body", b"") for message in said[1:])
        return said[0]["status"], json.loads(content) if content else None


@pytest.fixture
def desk(no_memory_left):
    return Desk()


@pytest.fixture
def desk_of(no_memory_left):
    """Make a desk of another text's robot."""
    return Desk


STOP = b"POST /stop HTTP/1.1\r\nHost: x\r\nContent-Length: 0\r\n\r\n"


class Door:
    """The gateway's server on a socket, and the ways in which clients come."""

    network = None

    def __init__(self, desk, path):
        self.desk, self.path = desk, str(path)

    def open(self, act):
        """Serve until `act` has ended; return what it returned."""
        return asyncio.run(self._open(act))

    async def _open(self, act):
        listener = socket.socket(socket.AF_UNIX)
        listener.bind(self.path)
        listener.listen(64)
        ours, control = socket.socketpair()
        serving = asyncio.ensure_future(
            serve_gateway(self.desk.link, self.desk.gateway, listener, control, self.network)
        )
        looping = asyncio.ensure_future(self._loop())
        try:
            return await act()
        finally:
            looping.cancel()
            ours.close()
            await serving
            listener.close()
            control.close()

    async def _loop(self):
        while True:
            self.desk.take()
            await asyncio.sleep(0.001)

    async def connect(self, data=b""):
        reader, writer = await asyncio.open_unix_connection(self.path)
        writer.write(data)
        return reader, writer

    async def say(self, data):
        """Send what a client may send, and return what it is answered before the connection is closed."""
        reader, writer = await self.connect(data)
        writer.write_eof()
        answer = await reader.read()
        writer.close()
        return answer

    async def stopped(self):
        """Say whether `stop` is taken from a client that comes now."""
        reader, writer = await self.connect(STOP)
        status = await reader.readline()
        writer.close()
        return status == b"HTTP/1.1 200 OK\r\n" and self.desk.taken[-1].kind == "stop"


@pytest.fixture
def door(desk, tmp_path):
    return Door(desk, tmp_path / "s.sock")
