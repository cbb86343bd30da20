"""Client: a running robot from Python.

    import dxlrun

    with dxlrun.connect() as robot:
        robot.send("head", "posvel", {"positions": [0.3, 0.0], "velocities": [1.0, 1.0]})

One connection, one request at a time, of one thread.
"""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias
from urllib.parse import quote, urlencode

import msgspec
from msgspec.structs import asdict

from dxlrun.channels.loop_requests import Rate, RebootRequest, Switch, TorqueRequest
from dxlrun.compile.motion_names import PLAY, find_live_motion, is_name
from dxlrun.errors import DxlrunError, GoalTimeout, Refused
from dxlrun.remote.live.listening import MessageIterator, TopicMessage
from dxlrun.remote.network.network_link import NetworkLink, known_robots
from dxlrun.remote.requests import replies
from dxlrun.remote.requests import request_table as requests
from dxlrun.remote.requests.replies import GoalState, NotDone, Parameter, TopicState
from dxlrun.remote.requests.request_table import Answer, Body, NewMotion, NewValues, Request, Row, Value
from dxlrun.remote.sockets import MOST_BYTES, Address, RobotLink, SocketLink, await_sockets, sockets

if TYPE_CHECKING:
    from dxlrun.description.frames.tree import FrameTree
    from dxlrun.log.schemas import LogHeader
    from dxlrun.remote.live.states import RobotStates
    from dxlsim.geometry.transform import Transform

# s; default lease of a stream's set-points, as in the gateway. A client that streams at 10 Hz or more stays
# within it.
LEASE_S = 0.2
# s; timeout of `stop`, which includes the steps of on_exit and the end of the recorder.
_STOP_S = 30.0
_POLL_S = 2.0
_FEEDBACK_S = 0.1
"""Longest wait, s, of one request for the end of a goal: without, and with, a callback for progress."""
_WRONG_INPUT = (404, 413, 422)
"""HTTP statuses of refusals that are independent of the robot's state: unknown name, long or invalid body."""


@dataclass(frozen=True, slots=True)
class RemoteGoal:
    """Handle of a goal that was sent to a running robot, given by its number."""

    robot: RemoteRobot
    number: int

    def state(self) -> GoalState:
        """Return the goal's progress or its result."""
        return self.robot.goal_state(self.number)

    def wait(
        self, timeout: float | None = None, feedback: Callable[[GoalState], object] | None = None
    ) -> GoalState:
        """Wait for the end of the goal and return its result.

        Args:
            timeout: Longest wait, s; None waits without limit. The goal continues after a timeout.
            feedback: Called with the goal's state about ten times a second until the goal ends.

        Raises:
            GoalTimeout: The goal has not ended within `timeout`.
        """
        return self.robot.wait(self.number, timeout, feedback)

    def cancel(self) -> Executed:
        """Cancel the goal. Its controller brings the joints to rest; the goal ends when they are at rest."""
        return self.robot.cancel(self.number)


Executed: TypeAlias = replies.Executed[RemoteGoal]
"""Reply to a command that the robot executed, with its goals as handles."""


def connect(robot: str | None = None, client: str | None = None) -> RemoteRobot:
    """Connect to a running robot; wait until it runs if it is starting on this computer.

    Args:
        robot: Name of the robot; None: the only robot that runs on this computer. `NAME@HOST:PORT`, or a name
            in `robots.yaml` of the settings, is a robot of another computer.
        client: Name of this client in the robot's log.

    Raises:
        DxlrunError: The robot does not run, or several robots run and none was named.
    """
    client = client or f"python {os.getpid()}"
    if robot is not None and robot not in sockets():
        address = Address.parse(robot) if "@" in robot else known_robots().get(robot)
        if address is not None:
            return RemoteRobot(robot, NetworkLink(address, client))
    found = await_sockets(robot)
    names = ", ".join(sorted(found))
    if robot is None:
        if not found:
            raise DxlrunError("no running robot found; start one (dxlrun ROBOT.yaml)")
        if len(found) > 1:
            raise DxlrunError(f"several robots run: {names}; name one")
        robot = next(iter(found))
    if robot not in found:
        if robot.endswith((".yaml", ".yml")):
            raise DxlrunError(f"{robot} is a robot file; give the robot's `name` that the file has")
        raise DxlrunError(
            f"robot {robot} is not running; " + (f"choose one of: {names}" if names else "start it")
        )
    return RemoteRobot(robot, SocketLink(found[robot], client))


class RemoteRobot:
    """A running robot.

        with dxlrun.connect() as robot:
            states = robot.states()
            print(dict(zip(states.joints, states.position)))
            robot.send("head", "posvel", {"positions": [0.1, 0.0], "velocities": [1.0, 1.0]})

    All methods raise Refused with the reason of a refusal, and DxlrunError when the robot is gone.
    """

    def __init__(self, name: str, link: RobotLink) -> None:
        """`name`: the robot's name, for messages; `link`: the connection to its gateway."""
        self.name, self.link = name, link
        self._frames: FrameTree | None = None

    def __enter__(self) -> RemoteRobot:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connection; the robot keeps running."""
        self.link.close()

    # State

    def info(self) -> dict[str, object]:
        """Return the robot's rate (Hz), cycles, joints, files, and its controllers with the commands that
        they accept.
        """
        return self._decoded(self._asked(requests.ROBOT), Row)

    def states(self) -> RobotStates:
        """Return the states of the newest cycle: arrays with one value per joint, source state or controller,
        SI units.
        """
        # Imported here because it imports NumPy, which most commands do not need.
        from dxlrun.remote.live.states import RobotStates, array

        return self._decoded(self._asked(requests.STATES), RobotStates, array)

    def frames(self) -> FrameTree:
        """Return the frames of the robot's URDF; `pose` computes a frame's pose at given positions.

        Raises DxlrunError when the robot has no URDF.
        """
        if self._frames is None:
            # Imported here because most clients do not use frames.
            from dxlrun.description.frames.tree import FramesPlan, FrameTree
            from dxlsim.geometry.urdf import read_urdf

            found = self._ask(requests.FRAMES)
            if found.urdf is None:
                raise DxlrunError(f"{self.name} has no URDF; write `model: {{urdf: ...}}` in the robot file")
            plan = msgspec.convert(found.frames, FramesPlan)
            self._frames = FrameTree(read_urdf(found.urdf), plan.moved, plan.imu, plan.imu_link)
        return self._frames

    def urdf(self) -> str:
        """Return the text of the robot's URDF; empty without a URDF."""
        return self._ask(requests.FRAMES).urdf or ""

    def pose(self, of: str, relative_to: str = "") -> Transform:
        """Return the current pose of a frame in another frame: position, m, and unit quaternion.

        The pose is computed from the newest cycle, including the orientation of the IMU that turns the body.

        Args:
            of: Name of the frame.
            relative_to: Name of the reference frame; empty: the root.

        Raises:
            LookupError: A frame is unknown.
            ValueError: A joint between the two frames was never read.
        """
        tree, states = self.frames(), self.states()
        positions = dict(zip(states.joints, states.position.tolist(), strict=True))
        moved = {name: value for name, value in positions.items() if name in tree.moved}
        sources = dict(zip(states.source_states, states.source_state.tolist(), strict=True))
        return tree.pose(of, relative_to, moved, tree.orientation(sources))

    def log_header(self) -> LogHeader:
        """Return the header from which the log's messages are made, see `log.run_messages`."""
        # Imported here because it imports NumPy, which most clients do not need.
        from dxlrun.log.schemas import LogHeader

        return self._decoded(self._asked(requests.LOG_HEADER), LogHeader)

    def events(self, after: int = 0) -> dict[str, object]:
        """Return the stored events after event number `after`, and the newest number."""
        return self._decoded(self._asked(requests.EVENTS, query={"after": after}), Row)

    # Topics

    def topics(self) -> list[TopicState]:
        """Return the topics that a client can listen to."""
        return list(self._ask(requests.TOPICS).topics)

    def newest(self, topic: str) -> TopicMessage | None:
        """Return the newest message of a topic; None when the topic has had no message yet."""
        with self._listen((topic,), "&once=true") as found:
            return next(iter(found), None)

    def listen(self, *topics: str, newest: bool | None = None, rate: float | None = None) -> MessageIterator:
        """Listen to topics: receive the newest message and all later ones until the run ends.

            for message in robot.listen("/joint_states"):
                print(message.number, message.lost, message.message["position"])

        A client that is up to about ten seconds behind receives every message; `lost` counts the messages
        that were missed. `async for` works as well.

        Args:
            topics: Names of the topics.
            newest: Skip old messages when this client is slower than the robot. The default is True with
                `rate`, and False without.
            rate: Upper limit of deliveries per second, Hz.

        Raises:
            Refused: A topic is unknown.
        """
        only_newest = rate is not None if newest is None else newest
        query = "&newest=true" * only_newest + ("" if rate is None else f"&rate={rate:g}")
        return self._listen(topics, query)

    def _listen(self, topics: Sequence[str], query: str) -> MessageIterator:
        names = "&".join(f"topic={quote('/' + topic.lstrip('/'))}" for topic in topics)
        try:
            status, first, end = self.link.stream(f"{requests.STREAM.path}?{names}{query}")
        except (OSError, ValueError) as error:
            raise self._gone(error) from error
        if status >= 400:
            end.close()
            raise self._refused(status, first)
        return MessageIterator(self.name, self.link, end, first, newest="newest" in query)

    # Goals

    def goals(self) -> list[GoalState]:
        """Return the running goals and the last 100 ended goals."""
        found = self._ask(requests.GOALS)
        return sorted((*found.running, *found.ended), key=lambda goal: goal.number)

    def goal_state(self, number: int, wait: float = 0.0) -> GoalState:
        """Return the state of a goal; with `wait` (s, at most 5), when the goal has ended or that time has
        passed.
        """
        return self._ask(requests.GOAL, number, query={"wait": f"{wait:g}"} if wait else {})

    def wait(
        self,
        goal: RemoteGoal | int,
        timeout: float | None = None,
        feedback: Callable[[GoalState], object] | None = None,
    ) -> GoalState:
        """Wait for the end of a goal and return its result, see RemoteGoal.wait.

        Raises GoalTimeout, or DxlrunError when the robot is gone before the end.
        """
        number = goal.number if isinstance(goal, RemoteGoal) else goal
        until = None if timeout is None else time.monotonic() + timeout
        while True:
            longest = _POLL_S if feedback is None else _FEEDBACK_S
            left = longest if until is None else max(0.0, until - time.monotonic())
            state = self.goal_state(number, min(longest, left))
            if state.status != "running":
                return state
            if feedback is not None:
                feedback(state)
            if left <= 0.0:
                raise GoalTimeout(f"goal {number} of {state.controller} has not ended within {timeout:g} s")

    def cancel(self, goal: RemoteGoal | int | str) -> Executed:
        """Cancel a goal, given by its number or by its controller; the goal ends when the joints are at rest.

        Raises Refused when the goal has ended or is already being cancelled.
        """
        if isinstance(goal, str):
            return self._execute(requests.CANCEL_OF, goal)
        number = goal.number if isinstance(goal, RemoteGoal) else goal
        return self._execute(requests.CANCEL, number)

    # Parameters

    def parameters(self, controller: str) -> dict[str, object]:
        """Return the parameters of a controller by dotted name, as in the robot file."""
        return {one.name: one.value for one in self.parameter_table(controller)}

    def parameter_table(self, controller: str) -> tuple[Parameter, ...]:
        """Return name, value, live, range and description of each parameter of a controller."""
        return self._ask(requests.PARAMETERS, controller).parameters

    def set_parameters(
        self, controller: str, values: Mapping[str, bool | float | str]
    ) -> dict[str, tuple[object, object]]:
        """Change live parameters of a controller in one cycle, all or none; return the old and new values.

        Values are written as in the robot file: `{"gains.p": 4.0, "speed": "20 deg/s"}`.
        """
        found = self._ask(requests.CHANGE, controller, body=NewValues(dict(values)))
        return {one.name: (one.old, one.new) for one in found.changed}

    # Steering

    def send(
        self,
        controller: str,
        kind: str,
        command: Mapping[str, object],
        *,
        units: bool = False,
        seconds: float | None = None,
        goal: bool = False,
    ) -> Executed:
        """Send a typed command to a controller; returns when the loop has accepted the command.

        Some joints by name: `send("arm", "position", {"elbow": 0.35})`, or `velocity`, `effort`, `pwm`. The
        other joints keep their newest goals. Commands of a device:
        `send("board", "device_commands", {"led": 1})`; they go to the controller that commands the device.

        Args:
            controller: Name of the controller or the device.
            kind: Name of the command.
            command: Fields of the command, in SI units.
            units: Quantities are texts with units as in a motion file, such as `"30 deg"`.
            seconds: Duration of the motion, s: of named joints, or of a command with a field `seconds`.
            goal: Make the positions of a group controller a goal.

        Returns:
            The reply. Its `goal` can be waited for when the command is a goal.

        Raises:
            Refused: The command is refused, for example because a value is beyond the limits of its joint.
        """
        query = ({"units": "true"} if units else {}) | ({} if seconds is None else {"in": repr(seconds)})
        query |= {"goal": "true"} if goal else {}
        return self._execute(requests.COMMAND, controller, kind, body=_json(command), query=query)

    def play(self, motion: Path | str, speed: float = 1.0) -> Executed:
        """Play a motion file at `speed` times its speed; returns when its controllers have begun.

        A text can also be a name, as for `dxlrun play`: of a file next to the robot file or in its folder
        motions, or of a controller's own motion. Raises InputError for an unknown or ambiguous name.

        All controllers begin in one cycle, each with a goal, and first move the joints slowly to their first
        poses. Raises Refused with all problems of the file, and all reasons why the robot cannot play it.
        """
        if isinstance(motion, str) and is_name(motion):
            name, motion, player = find_live_motion(motion, self.name, self.info())
            if player:
                return self.send(player, PLAY, {"motion": name, "speed": speed})
        from dxlrun.description.document import read_text  # PyYAML takes long to import

        return self._execute(requests.PLAY, body=NewMotion(read_text(Path(motion)), str(motion), speed))

    def stream(self, controller: str, kind: str, lease: float = LEASE_S) -> Stream:
        """Return a stream of set-points for a controller; the newest set-point is valid for `lease` s."""
        return Stream(self, controller, kind, lease)

    def switch(self, activate: str | Sequence[str] = (), deactivate: str | Sequence[str] = ()) -> Executed:
        """Activate and deactivate controllers in one cycle, all or none; returns when the switch is complete.

        A switch takes longer when servos must change their operating mode first. Raises Refused when a servo
        does not change its mode.
        """
        return self._execute(requests.SWITCH, body=Switch(_listed(activate), _listed(deactivate)))

    def get(self, joint: str, item: str = "") -> dict[str, object]:
        """Return a joint's newest state, SI units, or a control table item of its servo, read in idle time.

        Args:
            joint: Name of a joint; of a device or sensor; or of a state or command, such as
                `imu/orientation.x` or `board/led`.
            item: Control table item; empty returns the state.

        Returns:
            The state of a joint; or `states`, `valid`, `age` and the current `commands` of a device or
            sensor; or `value` (integer of the e-Manual) and `is` (the same with its unit) of an item.
        """
        return self._ask(requests.READ_REGISTER, joint, item) if item else self._ask(requests.JOINT, joint)

    def torque(self, joints: str | Sequence[str], on: bool, *, release: bool = False) -> Executed:
        """Switch the torque of joints on or off; returns when the new state was read back.

        On: each joint is checked as at start-up, and holds its present position. Off: the joint is limp until
        its torque is switched on again, whatever the policies are.

        Args:
            joints: Names of joints, of controllers (their joints), or "all".
            on: True switches torque on.
            release: Deactivate the controllers that command these joints.

        Raises:
            Refused: A controller commands one of the joints, and `release` is False.
        """
        return self._execute(requests.TORQUE, body=TorqueRequest(_listed(joints), on, release))

    def reboot(self, joints: str | Sequence[str], *, release: bool = False) -> Executed:
        """Reboot the servos of joints (Protocol 2.0); returns when the servos are operational again.

        A reboot clears a hardware error. A servo that had torque has torque afterwards.
        """
        return self._execute(requests.REBOOT, body=RebootRequest(_listed(joints), release))

    def set_register(self, joint: str, item: str, value: int | str) -> Executed:
        """Write a RAM item of a joint's servo, such as a gain; returns when the value was read back.

        `value` is the integer of the e-Manual, or a quantity with its unit: `10 rad/s^2`. The value is
        written again when the servo is reset during the run.
        """
        return self._execute(requests.REGISTER, joint, item, body=Value(value))

    def rate(self, rate: float) -> Executed:
        """Change the loop's rate, Hz; returns when the loop has changed it."""
        return self._execute(requests.RATE, body=Rate(rate))

    def halt(self) -> Executed:
        """Deactivate all controllers that command joints; returns when every joint is at rest and holds.

        `halted` of the reply has the duration and the fastest joint. Raises Refused with the code
        `still_moving` when a joint still moves after five seconds.
        """
        return self._execute(requests.HALT)

    def take_over(self) -> Executed:
        """Take command of the robot from a client of another computer, whose next command is refused."""
        return self._execute(requests.TAKE_OVER)

    def pause(self) -> Executed:
        """Hold the joints at their goals, and stop the clock of the controllers until `resume`."""
        return self._execute(requests.PAUSE)

    def resume(self) -> Executed:
        """Resume the controllers' time from the instant of the pause."""
        return self._execute(requests.RESUME)

    def load(self, name: str, entry: Mapping[str, object]) -> Executed:
        """Load a controller into the paused loop; `entry` is written as in the robot file."""
        return self._execute(requests.LOAD, body={**entry, "name": name})

    def unload(self, name: str) -> Executed:
        """Unload an inactive controller from the paused loop."""
        return self._execute(requests.UNLOAD, name)

    def stop(self, wait: bool = True) -> None:
        """Stop the run normally; with `wait`, return when the run has ended and its log is closed.

        The request is repeated when the gateway closes the connection before its reply: a second stop has no
        further effect. Raises DxlrunError when the run has not ended after 30 s.
        """
        until = time.monotonic() + _STOP_S
        while not self._stopping():
            if time.monotonic() > until:
                raise DxlrunError(f"{self.name} closed every connection for {_STOP_S:g} s")
            time.sleep(0.02)
        self.close()
        while wait and self.link.alive:
            if time.monotonic() > until:
                raise DxlrunError(f"{self.name} did not end within {_STOP_S:g} s")
            time.sleep(0.05)

    # Implementation

    def _stopping(self) -> bool:
        """Send one stop request; return True if it was accepted or the robot is gone, False if it must be
        repeated.
        """
        try:
            self._execute(requests.STOP)
        except Refused:
            raise
        except DxlrunError as error:
            if self.link.alive:
                if isinstance(error.__cause__, ConnectionError):
                    return False
                raise
        return True

    def _execute(
        self,
        request: Request[Body, replies.Executed[int]],
        *names: object,
        body: Body | None = None,
        query: Mapping[str, object] = {},
    ) -> Executed:
        done = self._ask(request, *names, body=body, query=query)
        goals = tuple([RemoteGoal(self, number) for number in done.goals])
        return Executed(**asdict(done) | {"goals": goals})

    def _ask(
        self,
        request: Request[Body, Answer],
        *names: object,
        body: Body | None = None,
        query: Mapping[str, object] = {},
    ) -> Answer:
        """Send a request and return its decoded reply; `names` fill the placeholders of its path.

        Raises Refused.
        """
        return self._decoded(self._asked(request, *names, body=body, query=query), request.answer)

    def _asked(
        self,
        request: Request[Body, Answer],
        *names: object,
        body: Body | None = None,
        query: Mapping[str, object] = {},
    ) -> bytes:
        """Send a request and return the reply's body; raises Refused, or DxlrunError for a broken link."""
        path = request.target(*names)
        content = body if body is None or isinstance(body, bytes) else _json(body)
        try:
            target = f"{path}?{urlencode(query)}" if query else path
            status, answer = self.link.exchange(request.method, target, content)
        except (OSError, ValueError) as error:
            raise self._gone(error) from error
        if status >= 400:
            raise self._refused(status, answer)
        return answer

    def _decoded(
        self, answer: bytes, kind: type[Answer], hook: Callable[[type, object], object] | None = None
    ) -> Answer:
        try:
            return msgspec.json.decode(answer, type=kind, dec_hook=hook)
        except msgspec.MsgspecError as error:
            raise DxlrunError(
                f"{self.name} sent an unknown reply; use the same version of dxlrun on both sides"
            ) from error

    def _refused(self, status: int, answer: bytes) -> DxlrunError:
        """Return the exception for a refusal by the robot: Refused, or DxlrunError when the reply is not
        readable.
        """
        try:
            refused = msgspec.json.decode(answer, type=NotDone)
        except msgspec.MsgspecError:
            return DxlrunError(
                f"{self.name} sent an unknown reply; use the same version of dxlrun on both sides"
            )
        sentence, wrong = refused.refused or f"HTTP status {status}", status in _WRONG_INPUT
        return Refused(sentence, code=refused.code, fields=refused.fields, wrong_input=wrong)

    def _gone(self, error: Exception) -> DxlrunError:
        """Return the exception for a link that failed with `error`."""
        return DxlrunError(f"{self.name} no longer answers: {str(error) or type(error).__name__}")


def _listed(names: str | Sequence[str]) -> tuple[str, ...]:
    return (names,) if isinstance(names, str) else tuple(names)


def _json(content: object) -> bytes:
    """Return a request's body as JSON, with NumPy arrays as lists.

    Raises Refused for content JSON cannot express.
    """
    try:
        content = asdict(content) if isinstance(content, msgspec.Struct) else content
        body = json.dumps(content, default=_plain, allow_nan=False).encode()
    except (TypeError, ValueError, RecursionError) as error:
        where = None if isinstance(error, RecursionError) else _not_finite(content)
        problem = (
            f"the request cannot be sent: {error}; use numbers, texts, lists and mappings"
            if where is None
            else f"{where[0]} is {where[1]}, but must be a finite number; correct it"
        )
        raise Refused(problem, code="invalid", fields={"problem": problem}, wrong_input=True) from error
    if len(body) > MOST_BYTES:
        raise Refused(
            f"the request has {len(body)} bytes, more than {MOST_BYTES}; send less at once",
            code="too_long",
            fields={"size": len(body), "most": MOST_BYTES},
            wrong_input=True,
        )
    return body


def _not_finite(content: object, where: str = "") -> tuple[str, float] | None:
    """Return path (`positions[1]`) and value of the first number of a body that is not finite, or None."""
    if isinstance(content, float):
        return None if math.isfinite(content) else (where or "a value", content)
    if isinstance(content, Mapping):
        inner = [(f"{where}.{key}" if where else str(key), value) for key, value in content.items()]
    elif isinstance(content, str | bytes) or not isinstance(content, Sequence):
        lists = getattr(content, "tolist", None)
        return None if lists is None else _not_finite(lists(), where)
    else:
        inner = [(f"{where}[{index}]", value) for index, value in enumerate(content)]
    return next((found for at, value in inner if (found := _not_finite(value, at))), None)


def _plain(value: object) -> object:
    lists = getattr(value, "tolist", None)
    if lists is None:
        raise TypeError(f"{type(value).__name__} cannot be written as JSON")
    return lists()


class Stream:
    """A stream of set-points for one controller. Its joints hold when no set-point arrives within the lease.

    `clamped` counts the values beyond their joints' limits, which the robot clamped. `clamped_joints` are the
    joints of those values in the newest set-point.
    """

    def __init__(self, robot: RemoteRobot, controller: str, kind: str, lease: float) -> None:
        self._robot, self._names, self._query = robot, (controller, kind), {"lease": f"{lease:g}"}
        self.clamped = 0
        self.clamped_joints: tuple[str, ...] = ()

    def send(self, command: Mapping[str, object]) -> int:
        """Send a set-point and return the number of its values that are beyond their joints' limits.

        The reply arrives before the loop has read the set-point.
        """
        body = _json(command)
        found = self._robot._ask(requests.SET_POINT, *self._names, body=body, query=self._query)
        self.clamped_joints = found.clamped_joints
        self.clamped += found.clamped
        return found.clamped

    def __enter__(self) -> Stream:
        return self

    def __exit__(self, *_: object) -> None:
        """Send no last set-point: the lease of the newest one expires, and then the joints hold."""
