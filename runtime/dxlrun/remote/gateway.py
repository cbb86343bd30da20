"""Gateway: the HTTP interface of a running robot on a Unix socket, with JSON requests and replies.

`requests/table.py` lists the requests; docs/reference/steering.md explains them. The reply to a command is
`{"done": true, "cycle": N}`, with the goal's number in `"goals"` when the command is a goal. The reply to a
set-point has `"clamped"`, the number of values beyond their joints' limits, and `"clamped_joints"` instead. A
refusal is `{"refused": "...", "code": "...", "fields": {...}}` with a status of 4xx or 5xx: a sentence for a
person, and the code of the reason with its data for a program.
"""

from __future__ import annotations

import asyncio
import time
import traceback
from collections import Counter
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import msgspec
import starlette.requests
from msgspec.structs import replace
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.responses import Response, StreamingResponse
from starlette.routing import Route

from dxlrun.channels.answers import Code, CommandOutcome, Completion, Field, Refusal
from dxlrun.channels.commands import LOOP
from dxlrun.channels.cycle import LIMP, CycleRecord
from dxlrun.channels.event_records import Event, EventCode
from dxlrun.channels.heartbeat import Phase
from dxlrun.channels.loop_requests import (
    Cancel,
    NewCommander,
    Rate,
    RebootRequest,
    Switch,
    TorqueRequest,
    Unload,
)
from dxlrun.compile.motions import with_poses
from dxlrun.compile.problems import Problems
from dxlrun.contract.controller import Outcome
from dxlrun.description.motion import parse_motion
from dxlrun.description.source_names import SOURCE_COMMANDS
from dxlrun.errors import InputError
from dxlrun.log.schemas import LogHeader
from dxlrun.plan.loop_plan import ControllerPlan, JointValues
from dxlrun.remote.asked import Allowance, ClientRequest, client_of, peer, received
from dxlrun.remote.computation import computed
from dxlrun.remote.goal_book import LOST
from dxlrun.remote.link import Link, LoadedController
from dxlrun.remote.live.live_topics import TopicStream, framed
from dxlrun.remote.live.states import RobotStates, encoded
from dxlrun.remote.motion_requests import (
    LEAST_SPEED,
    MOST_SPEED,
    PreparedMotion,
    RunSnapshot,
    goal_of,
    schedule_motion,
)
from dxlrun.remote.named.named_commands import INTERFACES, joint_command, source_command, timed_command
from dxlrun.remote.named.named_joints import (
    effort_units,
    joint_row,
    joint_servos,
    named_joints,
    names_in,
    position_unit,
    prepared_reading,
    prepared_register,
    read_register,
    require_installed,
    require_reboots,
    states_of,
)
from dxlrun.remote.named.parameter_changes import PreparedChange, changed, parameters_of
from dxlrun.remote.network.commander import Commander
from dxlrun.remote.network.openapi import openapi
from dxlrun.remote.preparation import (
    BODY_TOO_DEEP,
    Preparation,
    RefusedRequest,
    invalid,
    refused,
    unknown_controllers,
)
from dxlrun.remote.requests import request_table as requests
from dxlrun.remote.requests.replies import (
    FRAME_LENGTH,
    Changed,
    Clamped,
    ControllerInfo,
    EventRow,
    Events,
    Executed,
    Frames,
    Goals,
    GoalState,
    NotDone,
    Parameters,
    RobotInfo,
    RunEnded,
    Topics,
)
from dxlrun.remote.requests.request_table import (
    REQUESTS,
    Answer,
    Body,
    NewMotion,
    NewValues,
    Request,
    Row,
    Value,
)

LEASE_S = (0.01, 0.2, 60.0)
"""Shortest, default and longest lease of a streamed set-point, s; without a newer one, it expires after that
time.
"""
_SHORTEST_LOOK_S, _LONGEST_LOOK_S = 0.0005, 0.02
"""Shortest and longest polling interval of a topic stream, s; between them it is half a period of the loop.
"""
BEAT_S = 2.0
"""Interval, s, at which a topic stream without messages sends an empty frame to show that the gateway runs.
"""
_ENDING_S = 0.5
"""Timeout, s, of a request for a running goal's result once the run is ending."""
LONGEST_WAY_S = 3600.0
"""Longest duration, s, that a client can request for a move of named joints (query parameter `in`)."""
MOTION_S = 8.0
"""Timeout, s, of checking a motion file in a forked process; shorter than the 10 s that a client waits."""
LONGEST_FILE = 200
MOST_MISTAKES = 20
"""Upper limit of the mistakes of a motion file that are listed in a refusal."""
LONGEST_SENTENCE = 2000
_STATUS = {
    Code.UNKNOWN_CONTROLLER: 404,
    Code.UNKNOWN_COMMAND: 404,
    Code.UNKNOWN_JOINT: 404,
    Code.OMITTED: 404,
    Code.UNKNOWN_REGISTER: 404,
    Code.UNKNOWN_PAGE: 404,
    Code.UNKNOWN_GOAL: 404,
    Code.UNKNOWN_TOPIC: 404,
    Code.UNKNOWN_PARAMETER: 404,
    Code.NOT_ALLOWED: 403,
    Code.WRONG_METHOD: 405,
    Code.BODY_TIMEOUT: 408,
    Code.TOO_LONG: 413,
    Code.INVALID: 422,
    Code.INVALID_REGISTER: 422,
    Code.WRONG_QUANTITY: 422,
    Code.BEYOND_LIMITS: 422,
    Code.NAMED_TWICE: 422,
    Code.WRONG_MOTION: 422,
    Code.NOT_LIVE: 422,
    Code.GOAL_REFUSED: 422,
    Code.GOAL_STREAMED: 422,
    Code.TOO_SLOW: 422,
    Code.TOO_OFTEN: 429,
    Code.QUEUE_FULL: 429,
    Code.GATEWAY_FAILED: 500,
    Code.NO_CYCLE: 503,
    Code.NO_ANSWER: 503,
    Code.RUN_ENDING: 503,
}
_CONFLICT = 409
"""HTTP status of refusal codes that are not in `_STATUS`: the robot's present state does not permit the
request.
"""

_Handler: TypeAlias = Callable[["GatewayApp", ClientRequest[Body]], Awaitable[Answer | Response]]
_HANDLERS: dict[Request[Any, Any], _Handler[Any, Any]] = {}


def _answers(
    request: Request[Body, Answer],
) -> Callable[[_Handler[Body, Answer]], _Handler[Body, Answer]]:
    """Return a decorator that registers a method of GatewayApp as the handler of a request."""

    def register_handler(handler: _Handler[Body, Answer]) -> _Handler[Body, Answer]:
        _HANDLERS[request] = handler
        return handler

    return register_handler


class GatewayApp:
    """HTTP application of the gateway.

    It checks and prepares each request, so the loop only has to execute it.
    """

    def __init__(
        self,
        link: Link,
        preparation: Preparation,
        log: str | None,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self._link = link
        self._preparation = preparation
        link.take_servo_limits = preparation.take_servo_limits
        self._log = log
        self._allowances = {one.rate: Allowance(one.rate, now) for one in REQUESTS if one.rate}
        self._commanded = {one.name: one for one in link.plan.loop.sources if one.commandable}
        self._commander = Commander(now)
        self._changing = asyncio.Lock()
        self._playing = asyncio.Lock()
        self._released: dict[str, None] = {}
        """Names of controllers that torque or reboot requests deactivated and that are not active
        again.
        """

    def app(self) -> Starlette:
        """Return the ASGI application with one route for each request of `requests/table.py`."""
        routes = [Route(one.path, self._answered(one), methods=[one.method]) for one in REQUESTS]
        app = Starlette(routes=routes, exception_handlers={HTTPException: _unknown_page})
        app.router.redirect_slashes = False
        return app

    def _answered(
        self, request: Request[Body, Answer]
    ) -> Callable[[starlette.requests.Request], Awaitable[Response]]:
        """Return the endpoint of a request: it checks rate limit, role, body and commander, then calls the
        handler.
        """
        allowance, handler = self._allowances.get(request.rate), _HANDLERS[request]

        async def answer_request(http: starlette.requests.Request) -> Response:
            try:
                if allowance is not None:
                    allowance.spend(peer(http))
                client_of(http).require_role(request)
                asked = await received(request, http, allowance)
                await self._admit(asked, request)
                return _response(await handler(self, asked))
            except RefusedRequest as error:
                return _refused(error.refusal)
            except ClientDisconnect:
                # No client reads this response.
                return Response(status_code=400)
            # Only a deeply nested body causes this.
            except RecursionError:
                return _refused(Refusal(Code.INVALID, {"problem": BODY_TOO_DEEP}))
            # Last resort: one request fails, and the gateway serves the next one.
            except Exception as error:
                traceback.print_exc()
                return _refused(Refusal(Code.GATEWAY_FAILED, {"problem": f"{type(error).__name__}: {error}"}))

        return answer_request

    # State

    @_answers(requests.ROBOT)
    async def robot(self, asked: ClientRequest[None]) -> RobotInfo:
        """Return the robot's name, rate, joints, sources, files, and controllers with their commands."""
        link, plan = self._link, self._link.plan
        joints, began_ns = plan.loop.joints, link.began_ns
        return RobotInfo(
            robot=plan.robot,
            rate=link.rate,
            paused=link.paused,
            began=None if began_ns is None else began_ns * 1e-9,
            cycles=link.heartbeat.cycles,
            skipped=link.heartbeat.skipped,
            joints=tuple(joint.name for joint in joints),
            groups=dict(plan.groups),
            omitted=plan.omitted,
            **vars(JointValues.from_joints(joints, effort_units(plan))),
            controllers=tuple(self._shown(one) for one in link.controllers.values()),
            sources=plan.loop.sources,
            file=str(Path(plan.source_file).absolute()),
            log=self._log,
            servos=joint_servos(plan),
        )

    def _shown(self, loaded: LoadedController) -> ControllerInfo:
        plan = loaded.plan
        return ControllerInfo(
            name=plan.name,
            type=plan.type,
            active=self._link.active(loaded),
            held=loaded.held,
            rate=plan.rate or self._link.rate,
            joints=plan.joints,
            command=plan.command,
            into=plan.into,
            fallback=plan.fallback,
            reference=plan.reference,
            reads=plan.reads,
            optional=plan.optional,
            takes=self._preparation.takes(plan),
            goals=tuple(self._preparation.goals(plan)),
            motions=self._preparation.motions(plan),
        )

    @_answers(requests.STATES)
    async def list_states(self, asked: ClientRequest[None]) -> Response:
        """Return the joint and source states of the newest cycle; numbers that are not known are null."""
        return Response(encoded(self._states()), media_type="application/json")

    def _states(self) -> RobotStates:
        places = {name: one.place for name, one in self._link.controllers.items()}
        return states_of(self._link.plan, self._newest(), places)

    def _newest(self) -> CycleRecord:
        """Return the record of the loop's newest cycle; raises RefusedRequest before the first cycle."""
        record = self._link.newest()
        if record is None:
            raise refused(Code.NO_CYCLE, {})
        return record

    @_answers(requests.FRAMES)
    async def frames(self, asked: ClientRequest[None]) -> Frames:
        """Return the text of the URDF, and the joints that move its links, to compute poses of frames."""
        plan = self._link.plan
        return Frames(plan.urdf, plan.frames)

    @_answers(requests.LOG_HEADER)
    async def log_header(self, asked: ClientRequest[None]) -> Response:
        """Return the header (joints, controllers, layout of a cycle) to decode log messages with."""
        header = LogHeader.from_plan(self._link.plan, self._link.topics.epoch_offset_ns)
        return Response(msgspec.json.encode(header), media_type="application/json")

    @_answers(requests.EVENTS)
    async def list_events(self, asked: ClientRequest[None]) -> Events:
        """Return the stored events with a number above `after`; `last` is the newest event's number."""
        after, kept = asked.number("after", 0.0), self._link.events
        rows = (
            EventRow(number, one.t_ns * 1e-9, one.name, one.severity, one.source, one.text, _origin(one))
            for number, one in kept
            if number > after
        )
        return Events(tuple(rows), kept[-1][0] if kept else 0)

    @_answers(requests.TOPICS)
    async def topics(self, asked: ClientRequest[None]) -> Topics:
        """Return all topics that can be streamed, with message type, rate and count."""
        return Topics((*self._link.topic_states(),))

    @_answers(requests.STREAM)
    async def stream_topics(self, asked: ClientRequest[None]) -> Response:
        """Stream the messages of topics as frames, see `Frame`, until the run ends; `once`: one batch."""
        query, rate = asked.http.query_params, asked.number("rate", requests.MOST_LOOKS)
        topics = query.getlist("topic")
        if not topics or rate <= 0:
            raise invalid(
                "name a topic, and a rate above 0 Hz; write for example /stream?topic=/joint_states"
            )
        stream = self._link.open_stream(topics, newest="newest" in query)
        frames = self._frames(stream, rate, once="once" in query)
        return StreamingResponse(frames, media_type="application/octet-stream")

    async def _frames(self, stream: TopicStream, rate: float, *, once: bool) -> AsyncIterator[bytes]:
        look_s = min(_LONGEST_LOOK_S, max(_SHORTEST_LOOK_S, 0.5 / self._link.rate))
        sent = due = time.monotonic()
        while True:
            ended, now = once or self._link.ended, time.monotonic()
            frames = stream.frames() if now >= due or ended else b""
            if frames:
                due = now + 1 / rate
            elif now - sent > BEAT_S:
                frames = FRAME_LENGTH.pack(0)
            if frames:
                sent = now
                yield frames
            if ended and not stream.behind:
                break
            await asyncio.sleep(0 if stream.behind else max(look_s, min(due - now, BEAT_S)))
        yield framed(RunEnded())

    @_answers(requests.GOALS)
    async def goals(self, asked: ClientRequest[None]) -> Goals:
        """Return the state of the running goals and of the last ended goals."""
        book = self._link.goals
        return Goals((*book.running.values(),), (*book.ended.values(),))

    @_answers(requests.GOAL)
    async def goal(self, asked: ClientRequest[None]) -> GoalState:
        """Return one goal's state; with `wait`, reply when the goal ends, after `wait` s at the latest."""
        wait_s, chosen, goals = asked.wait_s, asked.goal, self._link.goals
        running = self._link.heartbeat.phase is Phase.RUNNING
        if goals.goal_state(chosen).ended is None and not running:
            await goals.wait_for_end(chosen, _ENDING_S)
            if goals.goal_state(chosen).ended is None:
                raise refused(Code.RUN_ENDING, {})
        await goals.wait_for_end(chosen, wait_s)
        return goals.goal_state(chosen)

    # Steering

    @_answers(requests.CANCEL)
    @_answers(requests.CANCEL_OF)
    async def cancel(self, asked: ClientRequest[None]) -> Executed[int]:
        """Cancel a goal by number, or the running goals of a controller; reply with their numbers."""
        if "number" in asked.http.path_params:
            wanted = Cancel(goal=asked.goal)
            goals = [wanted.goal]
        else:
            name = self._known(asked).plan.name
            wanted = Cancel(controller=name)
            goals = [goal.number for goal in self._link.goals.running.values() if goal.controller == name]
        try:
            done = await self._link.for_loop("cancel", wanted, asked.origin)
        except RefusedRequest as error:
            self._note_ended(goals, error.refusal)
            raise
        return Executed(done.cycle, (*goals,))

    def _note_ended(self, goals: Sequence[int], refusal: Refusal) -> None:
        """Record the end of goals whose reports were lost, which a refused cancel reveals."""
        record = self._link.newest()
        if record is not None and refusal.code in (Code.GOAL_ENDED, Code.NO_GOAL):
            outcome = refusal.fields.get("outcome", Outcome.ABORTED)
            known = outcome if outcome in tuple(Outcome) else Outcome.ABORTED
            for goal in goals:
                self._link.goals.record_end(goal, str(known), LOST, record.woken_ns * 1e-9)

    @_answers(requests.PLAY)
    async def play_motion(self, asked: ClientRequest[NewMotion]) -> Executed[int]:
        """Play a motion file: all its controllers begin in one cycle; reply with their goals."""
        given = asked.body
        if not LEAST_SPEED <= given.speed <= MOST_SPEED:
            raise invalid(
                f"a speed of {given.speed:g} is out of range; "
                f"write a factor from {LEAST_SPEED:g} to {MOST_SPEED:g}"
            )
        self._newest()
        file = given.file[:LONGEST_FILE]
        # One at a time, because a check may need a core and about 100 MB.
        async with self._playing:
            if await asked.http.is_disconnected():
                raise ClientDisconnect
            found = await computed(partial(self._played, given, file), MOTION_S)
        if found is None:
            raise refused(Code.TOO_SLOW, {"controller": file, "seconds": MOTION_S})
        played = msgspec.msgpack.decode(found, type=PreparedMotion | Refusal)
        if isinstance(played, Refusal):
            raise RefusedRequest(played)
        # A client that is gone could not cancel the motion by its number.
        if await asked.http.is_disconnected():
            raise ClientDisconnect
        # Another client may have taken command during the check.
        await self._admit(asked, requests.PLAY)
        done = await self._link.command(
            LOOP, "play", played.data, f"{asked.origin}: {file}", request=played.request
        )
        return Executed(done.cycle, done.goals, seconds=played.seconds)

    def _played(self, given: NewMotion, file: str) -> bytes:
        """Check a motion file against the newest cycle, in a forked process; return a Played, or a Refusal,
        as MessagePack.
        """
        answer: PreparedMotion | Refusal
        try:
            plan = self._link.plan
            motion = parse_motion(given.text, Path(file), plan.groups, plan.omitted)
            motion = with_poses(motion, self._preparation.poses, Problems())
            # Read after parsing, which may have taken long: the motion begins where the joints are now.
            record = self._newest()
            controllers = {
                name: self._preparation.compiled(replace(one.plan, active=self._link.active(one)))
                for name, one in self._link.controllers.items()
            }
            answer = schedule_motion(
                motion, RunSnapshot(controllers, self._preparation.joints, record), given.speed
            )
        except InputError as error:
            answer = Refusal(Code.WRONG_MOTION, _mistaken(error))
        except RefusedRequest as error:
            answer = error.refusal
        # As for each request: a bug fails this request only.
        except Exception as error:
            traceback.print_exc()
            answer = Refusal(Code.GATEWAY_FAILED, {"problem": f"{type(error).__name__}: {error}"})
        return msgspec.msgpack.encode(answer)

    @_answers(requests.PARAMETERS)
    async def parameters(self, asked: ClientRequest[None]) -> Parameters:
        """Return name, present value, range and description of each parameter of a controller."""
        now = self._preparation.parameters(self._known(asked).plan)
        return Parameters((*parameters_of(now),))

    @_answers(requests.CHANGE)
    async def change(self, asked: ClientRequest[NewValues]) -> Changed:
        """Change live parameters of a controller, all in one cycle; reply with their old and new values."""
        # One change at a time: values that were checked against the present ones must meet these in the loop.
        async with self._changing:
            loaded = self._known(asked)
            now = self._preparation.parameters(loaded.plan)
            change = changed(loaded.plan, now, asked.body.values)
            noted = partial(self._note_parameters, loaded, change)
            done = await self._link.for_loop("parameters", change.request, asked.origin, noted)
        return Changed(done.cycle, change.shown)

    def _note_parameters(self, loaded: LoadedController, change: PreparedChange, _: Completion) -> None:
        loaded.plan = change.plan

    @_answers(requests.COMMAND)
    async def command(self, asked: ClientRequest[bytes]) -> Executed[int]:
        """Check a typed command, also against joint limits; reply once the loop has executed it."""
        kind, content = asked.part("kind"), asked.body
        require_installed(self._link.plan, names_in(content))
        query, source = asked.http.query_params, self._commanded.get(asked.part())
        if source is not None and kind == SOURCE_COMMANDS:
            name, content = source_command(
                source, content, self._plans(), self._active, self._preparation.takes
            )
            loaded = self._link.controllers[name]
        elif asked.part() not in self._link.controllers and kind in self._link.controllers:
            name = asked.part()[:80]
            raise refused(
                Code.UNKNOWN_CONTROLLER,
                {"controller": name, "hint": f"write the controller first: {kind} {name}"},
            )
        else:
            loaded = self._known(asked)
        units = query.get("units") == "true" and source is None
        seconds = asked.number("in", 0.0) if "in" in query else None
        if seconds is not None and not 0 < seconds <= LONGEST_WAY_S:
            raise invalid(
                f"a duration of {seconds:g} s is out of range; "
                f"write a time above 0 s, at most {LONGEST_WAY_S:g} s"
            )
        if kind in INTERFACES and loaded.plan.joints and (newest := self._link.newest()) is not None:
            known = self._preparation.parse_controller(loaded.plan)
            found = joint_command(
                known, kind, content, newest, units=units, seconds=seconds, groups=self._link.plan.groups
            )
            if found is not None:
                kind, content, units, seconds = found.kind, found.content, False, None
        if seconds is not None:
            known = self._preparation.parse_controller(loaded.plan)
            content = timed_command(known, kind, content, seconds)
        prepared = self._preparation.command(loaded.plan, kind, content, units=units)
        prepared.require_within_limits()
        goal = None
        if query.get("goal") == "true" and kind not in self._preparation.goals(loaded.plan):
            goal = goal_of(prepared, self._preparation.parse_controller(loaded.plan), self._newest())
        if goal is not None:
            done = await self._link.command(LOOP, "play", goal.data, asked.origin, request=goal.request)
        else:
            done = await self._link.command(
                loaded.plan.name, kind, prepared.data, asked.origin, request=prepared.request
            )
        return Executed(done.cycle, done.goals)

    @_answers(requests.SET_POINT)
    async def set_point(self, asked: ClientRequest[bytes]) -> Clamped:
        """Replace the set-point of a stream that the loop reads next; its refusal is an event, not a reply.

        The loop clamps values beyond their joints' limits; the reply counts them.
        """
        shortest, usual, longest = LEASE_S
        lease = asked.number("lease", usual)
        if not shortest <= lease <= longest:
            raise invalid(f"a lease of {lease:g} s is out of range; write {shortest:g} to {longest:g} s")
        loaded, kind = self._known(asked), asked.part("kind")
        name = loaded.plan.name
        if kind in self._preparation.goals(loaded.plan):
            raise refused(Code.GOAL_STREAMED, {"controller": name, "kind": kind})
        require_installed(self._link.plan, names_in(asked.body))
        prepared = self._preparation.command(loaded.plan, kind, asked.body)
        if not self._link.active(loaded):
            raise refused(Code.NOT_ACTIVE, {"controller": name})
        lease_ns = round(lease * 1e9)
        self._link.set_point(loaded, kind, prepared.data, asked.origin, lease_ns, prepared.request)
        return Clamped(len(prepared.beyond), prepared.joints_beyond)

    @_answers(requests.SWITCH)
    async def switch(self, asked: ClientRequest[Switch]) -> Executed[int]:
        """Activate and deactivate controllers in one cycle; reply after servos have changed their modes."""
        switch, known = asked.body, tuple(self._link.controllers)
        if unknown := [name for name in (*switch.activate, *switch.deactivate) if name not in known]:
            raise unknown_controllers(unknown, known, self._plans())
        # Checked here, because the loop must not iterate over thousands of names.
        for names in (switch.activate, switch.deactivate):
            if twice := tuple(name for name, count in Counter(names).items() if count > 1):
                raise refused(Code.NAMED_TWICE, {"controller": twice})
        below = self._below(switch.activate)
        done = await self._link.for_loop("switch", switch, asked.origin)
        # The next set-point of the client must find the controllers active.
        await self._link.recorded(done.cycle)
        return Executed(done.cycle, below=(*below,))

    def _below(self, names: Sequence[str]) -> list[str]:
        """Return the inactive controllers that the named ones send commands to, which the loop activates with
        them.
        """
        found: list[str] = []
        left, seen = list(names), set(names)
        while left:
            for lower in self._link.controllers[left.pop()].plan.into:
                loaded = self._link.controllers.get(lower)
                if loaded is None or lower in seen:
                    continue
                seen.add(lower)
                left.append(lower)
                if not self._link.active(loaded):
                    found.append(lower)
        return found

    @_answers(requests.REGISTER)
    async def register(self, asked: ClientRequest[Value]) -> Executed[int]:
        """Write a RAM item of a joint's servo; reply with old and new value once it was read back."""
        joint, item = asked.part(), asked.part("item")
        register = prepared_register(self._link.plan, joint, item, asked.body.value)
        done = await self._link.for_loop("register", register, asked.origin)
        return Executed(done.cycle, old=done.value, value=register.value)

    @_answers(requests.READ_REGISTER)
    async def read_joint_register(self, asked: ClientRequest[None]) -> Row:
        """Read a control table item of a joint's servo in idle time; reply with value and unit."""
        plan, joint, item = self._link.plan, asked.part(), asked.part("item")
        reading = prepared_reading(plan, joint, item)
        done = await self._link.for_loop("get", reading, asked.origin)
        return {"done": True, "cycle": done.cycle, **read_register(plan, joint, item, done.value)}

    @_answers(requests.JOINT)
    async def joint(self, asked: ClientRequest[None]) -> Row:
        """Return the newest state of a joint, a device, a sensor, or a controller that provides states."""
        plan, joint, states = self._link.plan, asked.part(), self._states()
        if (source := states.source(joint)) is not None:
            return {"source": joint, "cycle": states.cycle, **source}
        joint_row(plan, joint, states.source_names)
        units = {"unit": position_unit(plan, joint), "effort_unit": effort_units(plan).get(joint, "")}
        return {"joint": joint, "cycle": states.cycle, **states.joint(joint), **units}

    @_answers(requests.TORQUE)
    async def torque(self, asked: ClientRequest[TorqueRequest]) -> Executed[int]:
        """Switch the torque of joints on or off, and reply when the new state was read back."""
        joints = named_joints(self._link.plan, self._plans(), asked.body.joints)
        return await self._joints_done("torque", replace(asked.body, joints=joints), asked.origin)

    @_answers(requests.REBOOT)
    async def reboot(self, asked: ClientRequest[RebootRequest]) -> Executed[int]:
        """Reboot the servos of joints, and reply when they are operational again."""
        joints = named_joints(self._link.plan, self._plans(), asked.body.joints)
        require_reboots(self._link.plan, joints)
        return await self._joints_done("reboot", replace(asked.body, joints=joints), asked.origin)

    async def _joints_done(
        self, kind: str, wanted: TorqueRequest | RebootRequest, origin: str
    ) -> Executed[int]:
        done = await self._link.for_loop(kind, wanted, origin)
        # The next states that the client reads must show the change.
        await self._link.recorded(done.cycle + 1)
        self._released |= dict.fromkeys(done.deactivated)
        offered = self._offered() if isinstance(wanted, TorqueRequest) and wanted.on else ()
        return Executed(done.cycle, joints=wanted.joints, deactivated=done.deactivated, offered=offered)

    def _offered(self) -> tuple[str, ...]:
        """Return the controllers that requests deactivated and whose joints all have torque again."""
        record, known = self._link.newest(), self._link.controllers
        for name in [one for one in self._released if one not in known or self._link.active(known[one])]:
            del self._released[name]
        if record is None:
            return ()
        rows = {joint.name: row for row, joint in enumerate(self._link.plan.loop.joints)}
        limp = {joint for joint, row in rows.items() if record.states.torque[row] in LIMP}
        return tuple(name for name in self._released if limp.isdisjoint(known[name].plan.joints))

    @_answers(requests.RATE)
    async def rate(self, asked: ClientRequest[Rate]) -> Executed[int]:
        """Change the loop's rate, Hz."""
        return await self._for_loop(
            "rate", asked.body, asked.origin, partial(self._link.note_rate, asked.body.rate)
        )

    @_answers(requests.HALT)
    async def halt(self, asked: ClientRequest[None]) -> Executed[int]:
        """Stop every joint and deactivate its controllers; reply when all joints are at rest."""
        return await self._for_loop("halt", None, asked.origin)

    @_answers(requests.PAUSE)
    async def pause(self, asked: ClientRequest[None]) -> Executed[int]:
        """Hold the joints at their goals and stop the clock of the controllers until `resume`."""
        return await self._for_loop("pause", None, asked.origin, partial(self._link.note_paused, True))

    @_answers(requests.RESUME)
    async def resume_run(self, asked: ClientRequest[None]) -> Executed[int]:
        """Resume the clock of the controllers after a pause."""
        return await self._for_loop("resume", None, asked.origin, partial(self._link.note_paused, False))

    @_answers(requests.STOP)
    async def stop_run(self, asked: ClientRequest[None]) -> Executed[int]:
        """End the run normally, with the steps of `on_exit`."""
        return await self._for_loop("stop", None, asked.origin)

    async def _for_loop(
        self, kind: str, data: object, origin: str, noted: Callable[[Completion], object] | None = None
    ) -> Executed[int]:
        """Send the loop a command that is not for a controller; `noted` is called once the loop has executed
        it.
        """
        done = await self._link.for_loop(kind, data, origin, noted)
        return Executed(done.cycle, halted=done.halted)

    @_answers(requests.TAKE_OVER)
    async def take_over(self, asked: ClientRequest[None]) -> Executed[int]:
        """Make this client the commander, the only client that may command, in place of another one."""
        before = self._commander.become(client_of(asked.http))
        return await self._note_commander(before or self._commander.name, asked.origin)

    async def _admit(self, asked: ClientRequest[Body], request: Request[Body, Answer]) -> None:
        """Require that a client may make a request as commander; log when it became commander.

        Raises RefusedRequest.
        """
        client = client_of(asked.http)
        before = self._commander.admit(client, request)
        if before is not None:
            await self._note_commander(before, asked.origin)
            # Another client may have taken over while the change was logged.
            self._commander.admit(client, request)

    async def _note_commander(self, before: str, origin: str) -> Executed[int]:
        """Have the loop log that the commander is no longer the client `before`."""
        return await self._for_loop("commander", NewCommander(self._commander.name, before), origin)

    @_answers(requests.LOAD)
    async def load_controller(self, asked: ClientRequest[Row]) -> Executed[int]:
        """Check a controller's entry as in the robot file, and load it into a paused loop."""
        others = {name: loaded.plan for name, loaded in self._link.controllers.items()}
        plan = self._preparation.controller(asked.body, others, self._link.rate)
        return await self._for_loop("load", plan, asked.origin, partial(self._link.loaded, plan))

    @_answers(requests.UNLOAD)
    async def unload_controller(self, asked: ClientRequest[None]) -> Executed[int]:
        """Unload an inactive controller from a paused loop."""
        name = self._known(asked).plan.name
        return await self._for_loop("unload", Unload(name), asked.origin, partial(self._link.unloaded, name))

    @_answers(requests.DESCRIPTION)
    async def description(self, asked: ClientRequest[None]) -> Row:
        """Return the OpenAPI description of all requests."""
        return openapi({request: (handler.__doc__ or "").strip() for request, handler in _HANDLERS.items()})

    def _plans(self) -> list[ControllerPlan]:
        return [one.plan for one in self._link.controllers.values()]

    def _active(self, plan: ControllerPlan) -> bool:
        return self._link.active(self._link.controllers[plan.name])

    def _known(self, asked: ClientRequest[Body]) -> LoadedController:
        name = asked.part()
        loaded = self._link.controllers.get(name)
        if loaded is None:
            raise unknown_controllers([name], (*self._link.controllers, *self._commanded), self._plans())
        return loaded


def _response(reply: object, status: int = 200) -> Response:
    """Return a handler's reply as JSON, with status 200, or 202 for a set-point; a Response is unchanged."""
    if isinstance(reply, Response):
        return reply
    if isinstance(reply, Executed | Changed | Clamped):
        status = 202 if isinstance(reply, Clamped) else 200
        reply = {"done": True, **msgspec.to_builtins(reply)}
    return Response(msgspec.json.encode(reply), status, media_type="application/json")


def _mistaken(error: InputError) -> dict[str, Field]:
    """Return the fields of a refused motion file: a text with all mistakes, and their places, problems and
    fixes.
    """
    found = error.problems[:MOST_MISTAKES]
    if not found:
        return {"problem": str(error)}
    return {
        "problem": "; ".join(map(str, found)),
        "places": tuple(f"{one.mark.line}:{one.mark.column}" for one in found),
        "problems": tuple(one.what for one in found),
        "fixes": tuple(one.fix for one in found),
    }


def _origin(event: Event) -> str:
    """Return the client whose command an event reports; empty for other events."""
    if event.code not in (EventCode.STEERED, EventCode.COMMAND_REFUSED) or not event.data:
        return ""
    return msgspec.json.decode(event.data, type=CommandOutcome).origin


def _refused(refusal: Refusal) -> Response:
    status = _STATUS.get(refusal.code, _CONFLICT)
    sentence = " ".join(refusal.text.split())[:LONGEST_SENTENCE]
    response = _response(NotDone(sentence, refusal.code, refusal.fields), status)
    if status in (408, 413):
        # The rest of the body is not read, so the connection cannot be used again.
        response.headers["connection"] = "close"
    return response


async def _unknown_page(http: starlette.requests.Request, error: Exception) -> Response:
    method = isinstance(error, HTTPException) and error.status_code == 405
    code = Code.WRONG_METHOD if method else Code.UNKNOWN_PAGE
    return _refused(Refusal(code, {"method": http.method, "path": http.url.path[:80]}))
