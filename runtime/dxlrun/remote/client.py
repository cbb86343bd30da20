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
from dxlrun.errors import DxlrunError, GoalTimeout, Refused
from dxlrun.remote.live.listening import Listening, TopicMessage
from dxlrun.remote.network.network_link import NetworkLink, known_robots
from dxlrun.remote.requests import replies
from dxlrun.remote.requests import table as requests
from dxlrun.remote.requests.replies import GoalState, NotDone, Parameter, TopicState
from dxlrun.remote.requests.table import Answer, Body, NewMotion, NewValues, Request, Row, Value
from dxlrun.remote.sockets import MOST_BYTES, Address, RobotLink, SocketLink, sockets

if TYPE_CHECKING:
    from dxlrun.description.frames.tree import FrameTree
    from dxlrun.log.schemas import LogHeader
    from dxlrun.remote.live.states import RobotStates
    from dxlsim.geometry.transform import Transform

LEASE_S = 0.2
_STOP_S = 30.0
_POLL_S = 2.0
_FEEDBACK_S = 0.1
"""How long one request waits for the end of a goal, without and with progress to report."""
_WRONG_INPUT = (404, 413, 422)
"""Statuses of requests that would be refused at any time: no such thing, too long, not as they must be."""


@dataclass(frozen=True, slots=True)
class RemoteGoal:
    """A goal of a running robot, by its number."""

    robot: RemoteRobot
    number: int

    def state(self) -> GoalState:
        """Return how far it is, or how it ended."""
        return self.robot.goal_state(self.number)

    def wait(
        self, timeout: float | None = None, feedback: Callable[[GoalState], object] | None = None
    ) -> GoalState:
        """Return the result when it has ended; `feedback` gets its state some ten times a second meanwhile.

        Raises GoalTimeout after `timeout` s; the goal goes on.
        """
        return self.robot.wait(self.number, timeout, feedback)

    def cancel(self) -> Executed:
        """Let its controller bring the joints to rest; the goal ends when they are."""
        return self.robot.cancel(self.number)


Executed: TypeAlias = replies.Executed[RemoteGoal]
"""The reply to a command that the robot executed."""


def connect(robot: str | None = None, client: str | None = None) -> RemoteRobot:
    """Return a running robot, by its name; without one, the only one that runs here.

    `NAME@HOST:PORT` is a robot of another computer, and so is a name of the settings' `robots.yaml`. `client`
    names you in the robot's log. Raises DxlrunError when no such robot runs, or several do.
    """
    found, client = sockets(), client or f"python {os.getpid()}"
    if robot is not None and robot not in found:
        address = Address.parse(robot) if "@" in robot else known_robots().get(robot)
        if address is not None:
            return RemoteRobot(robot, NetworkLink(address, client))
    names = ", ".join(sorted(found))
    if robot is None:
        if not found:
            raise DxlrunError("no robot runs that can be steered; start one (dxlrun ROBOT.yaml)")
        if len(found) > 1:
            raise DxlrunError(f"several robots run: {names}; name one")
        robot = next(iter(found))
    if robot not in found:
        raise DxlrunError(
            f"no robot {robot} runs that can be steered; " + (f"these do: {names}" if names else "start it")
        )
    return RemoteRobot(robot, SocketLink(found[robot], client))


class RemoteRobot:
    """A running robot.

        with dxlrun.connect() as robot:
            states = robot.states()
            print(dict(zip(states.joints, states.position)))
            robot.send("head", "posvel", {"positions": [0.1, 0.0], "velocities": [1.0, 1.0]})

    Everything raises Refused with the reason, and DxlrunError when the robot is gone.
    """

    def __init__(self, name: str, link: RobotLink) -> None:
        """`link`: how it is reached, see RobotLink."""
        self.name, self.link = name, link
        self._frames: FrameTree | None = None

    def __enter__(self) -> RemoteRobot:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connection; the robot keeps running."""
        self.link.close()

    # Looking

    def info(self) -> dict[str, object]:
        """Return rate, cycles, log, and the controllers with the commands that they take."""
        return self._decoded(self._asked(requests.ROBOT), Row)

    def states(self) -> RobotStates:
        """Return the newest cycle: arrays with a row for each joint, device state, controller; SI units."""
        from dxlrun.remote.live.states import RobotStates, array  # numpy: most commands ask for none

        return self._decoded(self._asked(requests.STATES), RobotStates, array)

    def frames(self) -> FrameTree:
        """Return the robot's frames after its URDF: `pose` computes where one lies at any positions.

        Raises DxlrunError when the robot has no URDF.
        """
        if self._frames is None:
            from dxlrun.description.frames.tree import FramesPlan, FrameTree  # most clients ask for none
            from dxlsim.geometry.urdf import read_urdf

            found = self._ask(requests.FRAMES)
            if found.urdf is None:
                raise DxlrunError(
                    f"{self.name} has no URDF; its robot file names one by `model: {{urdf: ...}}`"
                )
            plan = msgspec.convert(found.frames, FramesPlan)
            self._frames = FrameTree(read_urdf(found.urdf), plan.moved, plan.imu, plan.imu_link)
        return self._frames

    def urdf(self) -> str:
        """Return the text of the robot's URDF; empty: it has none."""
        return self._ask(requests.FRAMES).urdf or ""

    def pose(self, of: str, relative_to: str = "") -> Transform:
        """Return where a frame lies now in another one, by default in the root: m, and a unit quaternion.

        By the newest cycle, and the newest orientation of the IMU that turns the body. Raises LookupError for
        an unknown frame, ValueError when a joint between the two was never read.
        """
        tree, states = self.frames(), self.states()
        positions = dict(zip(states.joints, states.position.tolist(), strict=True))
        moved = {name: value for name, value in positions.items() if name in tree.moved}
        sources = dict(zip(states.source_states, states.source_state.tolist(), strict=True))
        return tree.pose(of, relative_to, moved, tree.orientation(sources))

    def log_header(self) -> LogHeader:
        """Return what the messages of the log are made with, see `log.run_messages`."""
        from dxlrun.log.schemas import LogHeader  # numpy: most clients make none

        return self._decoded(self._asked(requests.LOG_HEADER), LogHeader)

    def events(self, after: int = 0) -> dict[str, object]:
        """Return what happened since event number `after`, as far as it is kept, and the last number."""
        return self._decoded(self._asked(requests.EVENTS, query={"after": after}), Row)

    # Topics

    def topics(self) -> list[TopicState]:
        """Return what there is to listen to."""
        return list(self._ask(requests.TOPICS).topics)

    def newest(self, topic: str) -> TopicMessage | None:
        """Return the newest message of a topic; None when it had none yet."""
        with self._listen((topic,), "&once=true") as found:
            return next(iter(found), None)

    def listen(self, *topics: str, newest: bool | None = None, rate: float | None = None) -> Listening:
        """Listen to topics: their messages as they come, from the newest on, until the run ends.

            for message in robot.listen("/joint_states"):
                print(message.number, message.lost, message.message["position"])

        Every message comes, where this end is no more than some ten seconds behind: `lost` counts those
        that do not. With `newest` what is older is left out when this end is slower, with `rate` (Hz) at most
        so many looks a second are taken, of the newest only unless `newest` is False. `async for` does the
        same. Raises Refused for an unknown topic.
        """
        only_newest = rate is not None if newest is None else newest
        query = "&newest=true" * only_newest + ("" if rate is None else f"&rate={rate:g}")
        return self._listen(topics, query)

    def _listen(self, topics: Sequence[str], query: str) -> Listening:
        names = "&".join(f"topic={quote('/' + topic.lstrip('/'))}" for topic in topics)
        try:
            status, first, end = self.link.stream(f"{requests.STREAM.path}?{names}{query}")
        except (OSError, ValueError) as error:
            raise self._gone(error) from error
        if status >= 400:
            end.close()
            raise self._refused(status, first)
        return Listening(self.name, self.link, end, first, newest="newest" in query)

    # Goals

    def goals(self) -> list[GoalState]:
        """Return the goals that run, and the last 100 that ended."""
        found = self._ask(requests.GOALS)
        return sorted((*found.running, *found.ended), key=lambda goal: goal.number)

    def goal_state(self, number: int, wait: float = 0.0) -> GoalState:
        """Return one goal; with `wait`, at most 5 s, when it has ended or after that time."""
        return self._ask(requests.GOAL, number, query={"wait": f"{wait:g}"} if wait else {})

    def wait(
        self,
        goal: RemoteGoal | int,
        timeout: float | None = None,
        feedback: Callable[[GoalState], object] | None = None,
    ) -> GoalState:
        """Return the result of a goal when it has ended, see RemoteGoal.wait.

        Raises GoalTimeout, and DxlrunError when the robot is gone before.
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
        """Cancel a goal, by its number or by the name of its controller; it ends when the joints rest.

        Raises Refused when it has ended already, and when it is being cancelled already.
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
        """Change live parameters of a controller in one cycle, or none; return the old and the new values.

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
        """Send a controller a typed command; returns when the loop has taken it. Raises Refused for values
        beyond their joints' limits too. Where the command is a goal, the answer has it, to wait for its end;
        with `goal` the positions of a group controller are one, too.

        Numbers are in SI. With `units`, quantities are written as in a motion file, such as `"30 deg"`.

        Some joints by name: `send("arm", "position", {"elbow": 0.35})`, or `velocity`, `effort`, `pwm`; the
        others keep their newest goals. A trajectory controller leads them there in `seconds`. Commands of a
        device: `send("board", "device_commands", {"led": 1})`, which the controller gets that has them.
        """
        query = ({"units": "true"} if units else {}) | ({} if seconds is None else {"in": repr(seconds)})
        query |= {"goal": "true"} if goal else {}
        return self._execute(requests.COMMAND, controller, kind, body=_json(command), query=query)

    def play(self, motion: Path | str, speed: float = 1.0) -> Executed:
        """Play a motion file, `speed` times as fast; returns when its controllers have begun, all in one
        cycle, with a goal for each. They lead the joints to their first poses slowly.

        Raises Refused with all that is wrong with the file, or with the robot for it.
        """
        text = Path(motion).read_text(encoding="utf-8")
        return self._execute(requests.PLAY, body=NewMotion(text, str(motion), speed))

    def stream(self, controller: str, kind: str, lease: float = LEASE_S) -> Stream:
        """Return a stream of set-points for a controller, of which the newest counts, for `lease` seconds."""
        return Stream(self, controller, kind, lease)

    def switch(self, activate: Sequence[str] = (), deactivate: Sequence[str] = ()) -> Executed:
        """Activate and deactivate controllers in one cycle, or not at all; returns when they are.

        Where servos must change their mode first, that takes longer; raises Refused when one does not.
        """
        return self._execute(requests.SWITCH, body=Switch(tuple(activate), tuple(deactivate)))

    def get(self, joint: str, item: str = "") -> dict[str, object]:
        """Return a joint's newest state, SI units, or an item of its servo's memory, read in idle time.

        `joint` may be a device, a sensor, or a state or command of it, `imu/orientation.x`, `board/led`:
        `states`, `valid`, `age`, and `commands`, what controllers command of it now.

        Of an item: `value`, the integer of the e-Manual, and `is`, the same with its unit.
        """
        return self._ask(requests.READ_REGISTER, joint, item) if item else self._ask(requests.JOINT, joint)

    def torque(self, joints: str | Sequence[str], on: bool, *, release: bool = False) -> Executed:
        """Switch the torque of joints on or off; returns when it was read back.

        `joints`: names of joints, of controllers (their joints), or "all". On: each is checked as at the
        start, and holds where it stands. Off: it is limp until its torque is switched on, whatever policies
        say. Refused while a controller commands one of them, unless `release` deactivates that.
        """
        return self._execute(requests.TORQUE, body=TorqueRequest(_listed(joints), on, release))

    def reboot(self, joints: str | Sequence[str], *, release: bool = False) -> Executed:
        """Reboot the servos of joints (Protocol 2.0); returns when they are in order again.

        That clears a hardware error. They have torque afterwards if they had it before.
        """
        return self._execute(requests.REBOOT, body=RebootRequest(_listed(joints), release))

    def set_register(self, joint: str, item: str, value: int | str) -> Executed:
        """Write a RAM item of a joint's servo, such as a gain; returns when it was read back.

        `value` is the integer of the e-Manual, or a quantity with its unit: `10 rad/s^2`. A servo that is
        reset in the run gets it again.
        """
        return self._execute(requests.REGISTER, joint, item, body=Value(value))

    def rate(self, rate: float) -> Executed:
        """Let the loop run at another rate, Hz."""
        return self._execute(requests.RATE, body=Rate(rate))

    def halt(self) -> Executed:
        """Deactivate all controllers that command joints; returns when every joint stands still and holds.

        `halted` of the answer has how long that took, and the fastest joint. Raises Refused with the code
        `still_moving` when one does not after five seconds.
        """
        return self._execute(requests.HALT)

    def take_over(self) -> Executed:
        """Command the robot although a client of another computer does; its next command is refused."""
        return self._execute(requests.TAKE_OVER)

    def pause(self) -> Executed:
        """Hold the joints, and stop the controllers' time."""
        return self._execute(requests.PAUSE)

    def resume(self) -> Executed:
        """Let the controllers' time run again, from where it was."""
        return self._execute(requests.RESUME)

    def load(self, name: str, entry: Mapping[str, object]) -> Executed:
        """Load a controller into the paused loop; `entry` is written as in the robot file."""
        return self._execute(requests.LOAD, body={**entry, "name": name})

    def unload(self, name: str) -> Executed:
        """Take a controller that is not active out of the paused loop."""
        return self._execute(requests.UNLOAD, name)

    def stop(self, wait: bool = True) -> None:
        """End the run in order; with `wait`, return when it has ended and its log is closed.

        A connection that is closed before the answer is opened again: to stop twice does what once does.
        Raises DxlrunError when it has not ended after 30 s.
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

    # Inside

    def _stopping(self) -> bool:
        """Ask once to stop; False when the connection was closed by a gateway that is alive."""
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
        """Ask, and return the answer; `names`: of its path. Raises Refused."""
        return self._decoded(self._asked(request, *names, body=body, query=query), request.answer)

    def _asked(
        self,
        request: Request[Body, Answer],
        *names: object,
        body: Body | None = None,
        query: Mapping[str, object] = {},
    ) -> bytes:
        """Ask, and return the answer as it came; raises Refused."""
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
        """Return an answer as what it is."""
        try:
            return msgspec.json.decode(answer, type=kind, dec_hook=hook)
        except msgspec.MsgspecError as error:
            raise DxlrunError(f"{self.name} answers in a way that this version does not know") from error

    def _refused(self, status: int, answer: bytes) -> DxlrunError:
        """Return the exception for an answer that is a refusal."""
        try:
            refused = msgspec.json.decode(answer, type=NotDone)
        except msgspec.MsgspecError:
            return DxlrunError(f"{self.name} answers in a way that this version does not know")
        sentence, wrong = refused.refused or f"HTTP status {status}", status in _WRONG_INPUT
        return Refused(sentence, code=refused.code, fields=refused.fields, wrong_input=wrong)

    def _gone(self, error: Exception) -> DxlrunError:
        """Return the exception for a link without an answer."""
        return DxlrunError(f"{self.name} no longer answers: {str(error) or type(error).__name__}")


def _listed(names: str | Sequence[str]) -> tuple[str, ...]:
    return (names,) if isinstance(names, str) else tuple(names)


def _json(content: object) -> bytes:
    """Return the body of a request; arrays of numpy are lists there. Raises Refused for what is none."""
    try:
        content = asdict(content) if isinstance(content, msgspec.Struct) else content
        body = json.dumps(content, default=_plain, allow_nan=False).encode()
    except (TypeError, ValueError, RecursionError) as error:
        where = None if isinstance(error, RecursionError) else _not_finite(content)
        problem = f"this cannot be sent: {error}; use numbers, texts, lists and mappings"
        if where is not None:
            problem = f"{where[0]} is {where[1]}, but must be a finite number; correct it"
        raise Refused(problem, code="invalid", fields={"problem": problem}, wrong_input=True) from error
    if len(body) > MOST_BYTES:
        raise Refused(
            f"{len(body)} bytes are too many, at most {MOST_BYTES} are taken at once",
            code="too_long",
            fields={"size": len(body), "most": MOST_BYTES},
            wrong_input=True,
        )
    return body


def _not_finite(content: object, where: str = "") -> tuple[str, float] | None:
    """Return where the first infinite number or NaN of a body is, and the number: `positions[1]`."""
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
        raise TypeError(f"{type(value).__name__} is not JSON")
    return lists()


class Stream:
    """Set-points for one controller; when they cease for longer than the lease, its joints are held.

    `clamped` counts the values beyond their joints' limits, which the robot clamped; `clamped_joints` are the
    joints of those in the newest set-point.
    """

    def __init__(self, robot: RemoteRobot, controller: str, kind: str, lease: float) -> None:
        self._robot, self._names, self._query = robot, (controller, kind), {"lease": f"{lease:g}"}
        self.clamped = 0
        self.clamped_joints: tuple[str, ...] = ()

    def send(self, command: Mapping[str, object]) -> int:
        """Leave the newest set-point, before the loop has taken it; return how many of its values are
        beyond their joints' limits."""
        body = _json(command)
        found = self._robot._ask(requests.SET_POINT, *self._names, body=body, query=self._query)
        self.clamped_joints = found.clamped_joints
        self.clamped += found.clamped
        return found.clamped

    def __enter__(self) -> Stream:
        return self

    def __exit__(self, *_: object) -> None:
        """Send nothing: the lease runs out, and the joints are held."""
