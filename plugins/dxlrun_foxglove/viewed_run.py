"""Viewed run: the messages of a running robot for its viewers, and the viewers' requests to the robot."""

from __future__ import annotations

import asyncio
from collections.abc import Collection, Sequence
from functools import partial

import msgspec

from dxlrun import DxlrunError, InputError, RemoteRobot, TopicMessage, connect
from dxlrun.tooling.live import LiveMessages, RobotInfo
from dxlrun.tooling.topics import MessageType
from dxlrun_foxglove.protocol import WARNING, Call, ViewerParameter, status, text
from dxlrun_foxglove.viewer import Channel, Viewer

ENCODING = "json"
"""Encoding of the arguments and results of services."""
RATE = 50.0
"""Rate at which the robot's messages are received, Hz; more costs processor time without a visible effect."""
LOOK_S = 2.0
"""Interval between checks for new topics of the run, s."""


class Switch(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Arguments of the service `/switch`: controllers to activate and to deactivate, all in one cycle."""

    activate: tuple[str, ...] = ()
    deactivate: tuple[str, ...] = ()


class TorqueRequest(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Arguments of the service `/torque`, which enables or disables the torque of joints."""

    joints: tuple[str, ...]
    on: bool
    release: bool = False
    """Deactivate the controllers that command the joints, in the same cycle. Without it, torque off is
    refused while any are active. Torque on restarts them at the current positions of the joints."""


class Nothing(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Arguments of a service without arguments, `/halt`."""


SERVICES = (("/halt", Nothing), ("/switch", Switch), ("/torque", TorqueRequest))
"""Name and argument type of each service of the server; the number of a service is its index."""
HALT = 0  # Number of `/halt`


class ViewedRun(LiveMessages):
    """One run of a robot: sends its messages to the viewers, and their requests to the robot."""

    def __init__(self, name: str) -> None:
        """Read the log header of the robot's current run. Raises DxlrunError if the robot does not run."""
        with _robot(name) as robot:
            super().__init__(robot.log_header())
        self._name = name
        self.viewers: set[Viewer] = set()
        self._channels: list[Channel] = []
        self._open_channels()

    # Messages

    def _channel(self, topic: str, message: MessageType, *, latched: bool = False) -> int:
        self._channels.append(Channel(len(self._channels), topic, message, latched))
        return self._channels[-1].number

    def _put(self, channel: int, t_ns: int, wall_ns: int, data: bytes) -> None:
        put = self._channels[channel]
        first, put.newest = put.newest is None, (wall_ns, data)
        for viewer in self.viewers:
            if first:
                viewer.reply(advertised((put,)))
            if first and viewer.graph:
                viewer.reply(self.graph)
            viewer.queue_message(put, wall_ns, data)

    async def forward_messages(self) -> str:
        """Forward the messages of the robot until its run has ended; return the reason of the end."""
        known: set[str] = set()
        why = ""
        try:
            async with asyncio.TaskGroup() as group:
                while True:
                    if new := await asyncio.to_thread(self._topics) - known:
                        known |= new
                        group.create_task(self._listen(new))
                    await asyncio.sleep(LOOK_S)
        except* DxlrunError as errors:
            why = str(errors.exceptions[0])
        return why

    def _topics(self) -> set[str]:
        """Return the run's topics that are in its log, or from which topics of the log are derived."""
        with _robot(self._name) as robot:
            return self.heard(robot.topics())

    async def _listen(self, topics: set[str]) -> None:
        """Forward the messages of topics until the run ends, which raises DxlrunError."""
        with _robot(self._name) as robot:
            listen = partial(robot.listen, *topics, rate=RATE, newest=False)
            async for message in await asyncio.to_thread(listen):
                self.handle_message(message)
        raise DxlrunError(f"the run of {self._name} has ended")

    def handle_message(self, message: TopicMessage) -> None:
        """Forward a message to the viewers; warn them if messages of its topic were lost before it."""
        if message.lost:
            lost = f"{message.lost} messages of {message.topic} were lost on the way here"
            for viewer in self.viewers:
                viewer.reply(status(WARNING, lost))
        super().handle_message(message)

    # Requests of viewers

    @property
    def channels(self) -> list[Channel]:
        """Channels that have had a message; only these are announced to viewers."""
        return [one for one in self._channels if one.newest is not None]

    @property
    def graph(self) -> str:
        """Text frame with the publishers of each announced topic: controllers, or else the robot."""
        names = [one.name for one in self.header.controllers]
        rows = []
        for topic in [one.topic for one in self.channels]:
            declared = [one.name for one in self.header.controllers if topic in one.publishes]
            owner = topic.split("/")[1]
            rows.append(
                {"name": topic, "publisherIds": declared or [owner if owner in names else self._name]}
            )
        others = ("subscribedTopics", "advertisedServices", "removedTopics", "removedServices")
        return text("connectionGraphUpdate", publishedTopics=rows, **dict.fromkeys(others, ()))

    def parameters(self, names: Collection[str]) -> list[ViewerParameter]:
        """Return the values of these parameters of controllers, or of all without names.

        Parameters that are neither numbers nor texts are omitted. Raises DxlrunError.
        """
        with _robot(self._name) as robot:
            return [
                ViewerParameter(f"{controller}.{one.name}", one.value)
                for controller in _controllers(robot, names)
                for one in robot.parameter_table(controller)
                if isinstance(one.value, bool | int | float | str)
                and (not names or f"{controller}.{one.name}" in names)
            ]

    def set_parameters(self, parameters: Sequence[ViewerParameter]) -> None:
        """Change parameters of controllers, those of one controller in one cycle. Raises DxlrunError."""
        with _robot(self._name) as robot:
            for controller in _controllers(robot, [one.name for one in parameters]):
                begin = f"{controller}."
                own = [one for one in parameters if one.name.startswith(begin)]
                robot.set_parameters(controller, {one.name.removeprefix(begin): one.value for one in own})

    def call(self, call: Call) -> bytes:
        """Send the request of a service call to the robot; return its answer as JSON.

        Raises DxlrunError if the call is invalid or the robot refuses it.
        """
        if call.service >= len(SERVICES) or call.encoding != ENCODING:
            raise InputError(f"service {call.service} with encoding {call.encoding} not found")
        name, kind = SERVICES[call.service]
        try:
            body = msgspec.json.decode(call.body, type=kind)
        except (msgspec.MsgspecError, RecursionError) as error:
            raise InputError(f"{name}: {error}") from error
        with _robot(self._name) as robot:
            match body:
                case Switch(activate, deactivate):
                    done = robot.switch(activate, deactivate)
                case TorqueRequest(joints, on, release):
                    done = robot.torque(joints, on, release=release)
                case _:
                    done = robot.halt()
        return msgspec.json.encode(done)


def _robot(name: str) -> RemoteRobot:
    return connect(name, "dxlrun foxglove")


def _controllers(robot: RemoteRobot, names: Collection[str]) -> list[str]:
    """Return the controllers whose parameters are among these names; without names, all controllers."""
    every = [one.name for one in msgspec.convert(robot.info(), RobotInfo).controllers]
    return [one for one in every if not names or any(name.startswith(f"{one}.") for name in names)]


def advertised(channels: Sequence[Channel]) -> str:
    """Return the text frame that announces channels to a viewer, with the ROS 2 schema of each topic."""
    rows = [
        {
            "id": one.number,
            "topic": one.topic,
            "encoding": "cdr",
            "schemaName": one.type.name,
            "schema": one.type.text,
            "schemaEncoding": "ros2msg",
        }
        for one in channels
    ]
    return text("advertise", channels=rows)


def advertised_services() -> str:
    """Return the text frame that announces all SERVICES to a viewer, with the JSON schema of each."""
    form = {"encoding": ENCODING, "schemaName": "Executed", "schemaEncoding": "jsonschema", "schema": "{}"}
    rows = []
    for number, (name, kind) in enumerate(SERVICES):
        schema = msgspec.json.schema_components((kind,))[1][kind.__name__]
        request = {**form, "schemaName": kind.__name__, "schema": msgspec.json.encode(schema).decode()}
        rows.append({"id": number, "name": name, "type": kind.__name__, "request": request, "response": form})
    return text("advertiseServices", services=rows)
