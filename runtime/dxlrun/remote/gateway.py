"""Gateway: what can be asked of a running robot, over HTTP on a Unix socket; JSON in, JSON out.

REQUESTS has all of it, docs/steering.md what each means. The answer is
`{"done": true, "cycle": N}`, of a goal with its number in `"goals"`, of a set-point instead `"clamped"`, the
number of values beyond their joints' limits, and `"clamped_joints"`; or `{"refused": "...", "code": "...",
"fields": {...}}` with a status of 4xx or 5xx: a sentence for a person, and for a program the code of the
reason with its data.
"""

from __future__ import annotations

import asyncio
import math
import time
import traceback
from collections import Counter
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import NamedTuple, TypeVar

import msgspec
from msgspec.structs import replace
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response, StreamingResponse
from starlette.routing import Route

from dxlrun.channels.answers import Code, Done, Field, Refusal
from dxlrun.channels.commands import LOOP
from dxlrun.channels.cycle import LIMP, CycleRecord
from dxlrun.channels.heartbeat import Phase
from dxlrun.contract.controller import Outcome
from dxlrun.control.joint_requests import RebootRequest, TorqueRequest
from dxlrun.control.steering import Cancel, Rate, Switch, Unload
from dxlrun.description.motion import motion_of
from dxlrun.errors import InputError
from dxlrun.plan.loop_plan import ControllerPlan
from dxlrun.remote.computation import computed
from dxlrun.remote.goals import LOST
from dxlrun.remote.joints import (
    effort_units,
    joint_row,
    named_joints,
    position_unit,
    prepared_reading,
    prepared_register,
    read_register,
    require_reboots,
    states_of,
)
from dxlrun.remote.link import Link, Loaded
from dxlrun.remote.live.states import RobotStates, encoded
from dxlrun.remote.live.topics import TopicStream, framed
from dxlrun.remote.motions import LEAST_SPEED, MOST_SPEED, Played, Running, play
from dxlrun.remote.named_commands import DEVICE_COMMANDS, device_command, joint_command
from dxlrun.remote.parameters import Change, changed, parameters_of
from dxlrun.remote.preparation import (
    Preparation,
    RefusedRequest,
    invalid,
    refused,
    unknown_controllers,
)
from dxlrun.remote.replies import (
    FRAME_LENGTH,
    Changed,
    Clamped,
    Executed,
    Goals,
    NotDone,
    Parameters,
    RunEnded,
    Topics,
    Written,
)
from dxlrun.remote.sockets import MOST_BYTES

MOST_OPERATIONS = 200.0
MOST_SET_POINTS = 4000.0
MOST_LOOKS = 2000.0
"""A second, of one process; a short burst may be as many at once as come in a tenth of it."""
MOST_PEERS = 256
"""Processes whose allowance is kept."""
CHARGED_BYTES = 16_384
"""So many bytes of a body count as one request more."""
BODY_S = 10.0
"""How long a body may take to arrive."""
LEASE_S = (0.01, 0.2, 60.0)
"""Shortest, default and longest time that a set-point of a stream counts."""
LONGEST_WAIT_S = 5.0
"""For the end of a goal; a client that waits longer asks again."""
_SHORTEST_LOOK_S, _LONGEST_LOOK_S = 0.0005, 0.02
"""Between two looks of a stream into the rings: half a period of the loop, within these."""
BEAT_S = 2.0
"""After so long without a message a stream shows that the gateway is alive."""
_ENDING_S = 0.5
"""How long the results of goals may take when the run ends."""
LONGEST_WAY_S = 3600.0
"""To a point that is named by its joints."""
MOTION_S = 8.0
"""How long the check of a motion may take, while other clients are served; a client waits 10 s."""
LONGEST_FILE = 200
MOST_MISTAKES = 20
"""Of a motion, in an answer."""
LONGEST_ORIGIN = 64
LONGEST_SENTENCE = 2000
_STATUS = {
    Code.UNKNOWN_CONTROLLER: 404,
    Code.UNKNOWN_COMMAND: 404,
    Code.UNKNOWN_JOINT: 404,
    Code.UNKNOWN_REGISTER: 404,
    Code.UNKNOWN_PAGE: 404,
    Code.UNLOADED: 404,
    Code.UNKNOWN_GOAL: 404,
    Code.UNKNOWN_TOPIC: 404,
    Code.UNKNOWN_PARAMETER: 404,
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
"""Status of all other refusals: what the loop or a controller cannot do now."""

T = TypeVar("T")


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


class GatewayApp:
    """The routes; every request is checked and prepared here, so that the loop only has to execute it."""

    def __init__(
        self,
        link: Link,
        preparation: Preparation,
        log: str | None,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self._link = link
        self._preparation = preparation
        self._log = log
        rates = (MOST_OPERATIONS, MOST_SET_POINTS, MOST_LOOKS)
        self._allowances = {rate: Allowance(rate, now) for rate in rates}
        self._devices = {one.name: one for one in link.plan.loop.sources if one.kind == "device"}
        self._changing = asyncio.Lock()
        self._playing = asyncio.Lock()
        self._released: dict[str, None] = {}
        """Controllers that torque and reboots took the joints from, until they are active again."""

    def app(self) -> Starlette:
        """Return the ASGI application."""
        routes = [Route(one.path, self._answered(one), methods=[one.method]) for one in REQUESTS]
        app = Starlette(routes=routes, exception_handlers={HTTPException: _unknown_page})
        app.router.redirect_slashes = False
        return app

    def _answered(self, asked: Asked) -> Callable[[Request], Awaitable[Response]]:
        """Return what answers a request: its body is read, and what a client may ask a second is kept."""
        allowance = self._allowances[asked.rate] if asked.rate else None
        handler = partial(asked.handler, self)

        async def answer(request: Request) -> Response:
            try:
                if allowance is not None:
                    allowance.spend(peer(request))
                given = () if asked.body is None else (await typed(request, asked.body),)
                return _response(await handler(request, *given))
            except RefusedRequest as error:
                return _refused(error.refusal)
            except ClientDisconnect:
                return Response(status_code=400)  # no client reads it
            except RecursionError:  # only a body can be so deep
                return _refused(Refusal(Code.INVALID, {"problem": "the body is nested too deeply"}))
            except Exception as error:  # the last resort: one request fails, and the gateway serves the next
                traceback.print_exc()
                return _refused(Refusal(Code.GATEWAY_FAILED, {"problem": f"{type(error).__name__}: {error}"}))
            finally:
                if allowance is not None:
                    allowance.charge(peer(request), getattr(request.state, "received", 0))

        return answer

    # Looking

    async def robot(self, request: Request) -> object:
        """Return the run, its controllers and the commands that they take."""
        link = self._link
        return {
            "robot": link.plan.robot,
            "rate": link.rate,
            "paused": link.paused,
            "cycles": link.heartbeat.cycles,
            "skipped": link.heartbeat.skipped,
            "joints": [joint.name for joint in link.plan.loop.joints],
            "groups": link.plan.groups,
            "units": {joint.name: position_unit(link.plan, joint.name) for joint in link.plan.loop.joints},
            "effort_units": effort_units(link.plan),
            "limits": {one.name: (one.lower, one.upper) for one in link.plan.loop.joints if one.bounded},
            "speeds": {one.name: one.highest_speed for one in link.plan.loop.joints},  # null: without a limit
            "controllers": [self._shown(one) for one in link.controllers.values()],
            "sources": link.plan.loop.sources,
            "file": str(Path(link.plan.source_file).absolute()),
            "log": self._log,
        }

    def _shown(self, loaded: Loaded) -> dict[str, object]:
        plan = loaded.plan
        return {
            "name": plan.name,
            "type": plan.type,
            "active": self._link.active(loaded),
            "held": loaded.held,
            "rate": plan.rate or self._link.rate,
            "joints": plan.joints,
            "command": plan.command,
            "into": plan.into,
            "fallback": plan.fallback,
            "reference": plan.reference,
            "reads": plan.reads,
            "takes": self._preparation.takes(plan),
            "goals": self._preparation.goals(plan),
        }

    async def states(self, request: Request) -> object:
        """Return the newest cycle; numbers that are not known are null."""
        return Response(encoded(self._states()), media_type="application/json")

    def _states(self) -> RobotStates:
        places = {name: one.place for name, one in self._link.controllers.items()}
        return states_of(self._link.plan, self._newest(), places)

    def _newest(self) -> CycleRecord:
        """Return the newest cycle; raises RefusedRequest before the first."""
        record = self._link.newest()
        if record is None:
            raise refused(Code.NO_CYCLE, {})
        return record

    async def frames(self, request: Request) -> object:
        """Return the URDF and what moves it: a client computes where frames lie by itself."""
        plan = self._link.plan
        return {"urdf": plan.urdf, "frames": plan.frames}

    async def events(self, request: Request) -> object:
        """Return the events after number `after` that are kept; `last` is the newest's number."""
        after = number(request, "after", 0.0)
        newest = self._link.events[-1][0] if self._link.events else 0
        rows = [
            {
                "number": n,
                "time": event.t_ns * 1e-9,
                "name": event.name,
                "severity": event.severity,
                "source": event.source,
                "text": event.text,
            }
            for n, event in self._link.events
            if n > after
        ]
        return {"events": rows, "last": newest}

    async def topics(self, request: Request) -> object:
        """Return all topics, with their types and rates."""
        return Topics((*self._link.topic_states(),))

    async def stream(self, request: Request) -> object:
        """Stream the messages of topics as frames, see `Frame`, until the run ends."""
        topics, rate = request.query_params.getlist("topic"), number(request, "rate", MOST_LOOKS)
        if not topics or rate <= 0:
            raise invalid(
                "name a topic, and a rate above 0 Hz; write for example /stream?topic=/joint_states"
            )
        stream = self._link.listen(topics, newest="newest" in request.query_params)
        once = "once" in request.query_params
        return StreamingResponse(self._frames(stream, rate, once), media_type="application/octet-stream")

    async def _frames(self, stream: TopicStream, rate: float, once: bool) -> AsyncIterator[bytes]:
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
            await asyncio.sleep(0 if stream.behind else look_s)
        yield framed(RunEnded())

    async def goals(self, request: Request) -> object:
        """Return the goals that run, and the last that ended."""
        book = self._link.goals
        return Goals((*book.running.values(),), (*book.ended.values(),))

    async def goal(self, request: Request) -> object:
        """Return one goal; with `wait`, s, when it has ended or after that time."""
        wanted, chosen, goals = waiting(request), _goal_number(request), self._link.goals
        running = self._link.heartbeat.phase is Phase.RUNNING
        if goals.status(chosen).ended is None and not running:
            await goals.wait(chosen, _ENDING_S)
            if goals.status(chosen).ended is None:
                raise refused(Code.RUN_ENDING, {})
        await goals.wait(chosen, wanted)
        return goals.status(chosen)

    # Steering

    async def cancel(self, request: Request) -> object:
        """Cancel a goal by its number, or the one that a controller has; answer with its number."""
        if "number" in request.path_params:
            wanted = Cancel(goal=_goal_number(request))
            goals = [wanted.goal]
        else:
            name = self._known(request).plan.name
            wanted = Cancel(controller=name)
            goals = [goal.number for goal in self._link.goals.running.values() if goal.controller == name]
        try:
            done = await self._link.for_loop("cancel", wanted, origin(request))
        except RefusedRequest as error:
            self._note_ended(goals, error.refusal)
            raise
        return Executed(done.cycle, (*goals,))

    def _note_ended(self, goals: Sequence[int], refusal: Refusal) -> None:
        """Note what a refused cancel shows of goals whose reports were lost on their way here."""
        record = self._link.newest()
        if record is not None and refusal.code in (Code.GOAL_ENDED, Code.NO_GOAL):
            outcome = refusal.fields.get("outcome", Outcome.ABORTED)
            known = outcome if outcome in tuple(Outcome) else Outcome.ABORTED
            for goal in goals:
                self._link.goals.end(goal, str(known), LOST, record.woken_ns * 1e-9)

    async def play(self, request: Request, given: NewMotion) -> object:
        """Play a motion file: all its controllers begin in one cycle; answer with their goals."""
        if not LEAST_SPEED <= given.speed <= MOST_SPEED:
            raise invalid(f"speed is a factor from {LEAST_SPEED:g} to {MOST_SPEED:g}, not {given.speed:g}")
        self._newest()
        file = given.file[:LONGEST_FILE]
        async with self._playing:  # one at a time: each may need a core and some 100 MB
            if await request.is_disconnected():
                raise ClientDisconnect
            found = await computed(partial(self._played, given, file), MOTION_S)
        if found is None:
            raise refused(Code.TOO_SLOW, {"controller": file, "seconds": MOTION_S})
        played = msgspec.msgpack.decode(found, type=Played | Refusal)
        if isinstance(played, Refusal):
            raise RefusedRequest(played)
        if await request.is_disconnected():  # it could not be cancelled by its number
            raise ClientDisconnect
        done = await self._link.command(
            LOOP, "play", played.data, f"{origin(request)}: {file}", request=played.request
        )
        return Executed(done.cycle, done.goals, seconds=played.seconds)

    def _played(self, given: NewMotion, file: str) -> bytes:
        """Return a motion ready for the loop, or why it is none: a Played or a Refusal as MessagePack."""
        answer: Played | Refusal
        try:
            motion = motion_of(given.text, Path(file), self._link.plan.groups)
            record = self._newest()  # after the reading of the file, which may have taken long
            controllers = {
                name: self._preparation.compiled(replace(one.plan, active=self._link.active(one)))
                for name, one in self._link.controllers.items()
            }
            answer = play(motion, Running(controllers, self._preparation.joints, record), given.speed)
        except InputError as error:
            answer = Refusal(Code.WRONG_MOTION, _mistaken(error))
        except RefusedRequest as error:
            answer = error.refusal
        except Exception as error:  # as of each request
            traceback.print_exc()
            answer = Refusal(Code.GATEWAY_FAILED, {"problem": f"{type(error).__name__}: {error}"})
        return msgspec.msgpack.encode(answer)

    async def parameters(self, request: Request) -> object:
        """Return a controller's parameters."""
        now = self._preparation.parameters(self._known(request).plan)
        return Parameters((*parameters_of(now),))

    async def change(self, request: Request, given: NewValues) -> object:
        """Change live parameters of a controller, all of them in one cycle."""
        async with self._changing:  # what is checked against the values of now must meet them in the loop
            loaded = self._known(request)
            now = self._preparation.parameters(loaded.plan)
            change = changed(loaded.plan, now, given.values)
            noted = partial(self._note_parameters, loaded, change)
            done = await self._link.for_loop("parameters", change.request, origin(request), noted)
        return Changed(done.cycle, change.shown)

    def _note_parameters(self, loaded: Loaded, change: Change, _: Done) -> None:
        loaded.plan = change.plan

    async def command(self, request: Request) -> object:
        """Check and prepare a typed command, within the limits, and let the loop hand it over."""
        kind, content = request.path_params["kind"], await body(request)
        device = self._devices.get(request.path_params["name"])
        if device is not None and kind == DEVICE_COMMANDS:
            name, content = device_command(
                device, content, self._plans(), self._active, self._preparation.takes
            )
            loaded = self._link.controllers[name]
        else:
            loaded = self._known(request)
        units = request.query_params.get("units") == "true" and device is None
        seconds = None if "in" not in request.query_params else number(request, "in", 0.0)
        if seconds is not None and not 0 < seconds <= LONGEST_WAY_S:
            raise invalid(f"in is a time above 0 s, at most {LONGEST_WAY_S:g} s, not {seconds:g}")
        if loaded.plan.joints and (newest := self._link.newest()) is not None:
            known = self._preparation.known(loaded.plan)
            found = joint_command(
                known, kind, content, newest, units=units, seconds=seconds, groups=self._link.plan.groups
            )
            if found is not None:
                kind, content, units, seconds = found.kind, found.content, False, None
        if seconds is not None:
            raise invalid(f"in is for joints by name; {kind} of {loaded.plan.name} has its own times")
        prepared = self._preparation.command(loaded.plan, kind, content, units=units)
        prepared.require_within_limits()
        done = await self._link.command(
            loaded.plan.name, kind, prepared.data, origin(request), request=prepared.request
        )
        return Executed(done.cycle, done.goals)

    async def set_point(self, request: Request) -> object:
        """Leave the newest of a stream for the loop; what the loop refuses is an event, not an answer.

        The last gate clamps values beyond their joints' limits; the answer counts them.
        """
        shortest, usual, longest = LEASE_S
        lease = number(request, "lease", usual)
        if not shortest <= lease <= longest:
            raise invalid(f"a lease is {shortest:g} to {longest:g} s, not {lease:g}")
        loaded, kind = self._known(request), request.path_params["kind"]
        name = loaded.plan.name
        if kind in self._preparation.goals(loaded.plan):
            raise refused(Code.GOAL_STREAMED, {"controller": name, "kind": kind})
        prepared = self._preparation.command(loaded.plan, kind, await body(request))
        if self._link.controllers.get(name) is not loaded:
            raise refused(Code.UNLOADED, {"controller": name})
        if not self._link.active(loaded):
            raise refused(Code.NOT_ACTIVE, {"controller": name})
        lease_ns = round(lease * 1e9)
        self._link.set_point(loaded, kind, prepared.data, origin(request), lease_ns, prepared.request)
        return Clamped(len(prepared.beyond), prepared.joints_beyond)

    async def switch(self, request: Request, switch: Switch) -> object:
        """Activate and deactivate controllers in one cycle; answer when those that wait for modes are in."""
        known = tuple(self._link.controllers)
        if unknown := [name for name in (*switch.activate, *switch.deactivate) if name not in known]:
            raise unknown_controllers(unknown, known)
        for names in (switch.activate, switch.deactivate):  # here: the loop must not go through thousands
            if twice := tuple(name for name, count in Counter(names).items() if count > 1):
                raise refused(Code.NAMED_TWICE, {"controller": twice})
        below = self._below(switch.activate)
        done = await self._link.for_loop("switch", switch, origin(request))
        await self._link.recorded(done.cycle)  # so that a set-point that follows finds them active
        return Executed(done.cycle, below=(*below,))

    def _below(self, names: Sequence[str]) -> list[str]:
        """Return the inactive controllers that those named command, which are activated with them."""
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

    async def register(self, request: Request, given: Value) -> object:
        """Have a RAM item of a joint's servo written, and answer when it was read back."""
        joint, item = request.path_params["name"], request.path_params["item"]
        register = prepared_register(self._link.plan, joint, item, given.value)
        done = await self._link.for_loop("register", register, origin(request))
        return Executed(done.cycle, old=done.value, value=register.value)

    async def read_register(self, request: Request) -> object:
        """Have an item of a joint's servo read, and return what it has."""
        plan, joint, item = self._link.plan, request.path_params["name"], request.path_params["item"]
        reading = prepared_reading(plan, joint, item)
        done = await self._link.for_loop("get", reading, origin(request))
        return {"done": True, "cycle": done.cycle, **read_register(plan, joint, item, done.value)}

    async def joint(self, request: Request) -> object:
        """Return the newest state of one joint, or of a device, a sensor, a controller that provides some."""
        plan, joint, states = self._link.plan, request.path_params["name"], self._states()
        if (source := states.source(joint)) is not None:
            return {"source": joint, "cycle": states.cycle, **source}
        joint_row(plan, joint, (*states.sources, *states.source_states))
        units = {"unit": position_unit(plan, joint), "effort_unit": effort_units(plan).get(joint, "")}
        return {"joint": joint, "cycle": states.cycle, **states.joint(joint), **units}

    async def torque(self, request: Request, given: TorqueRequest) -> object:
        """Switch the torque of joints on or off, and answer when it was read back."""
        joints = named_joints(self._link.plan, self._plans(), given.joints)
        return await self._joints_done("torque", replace(given, joints=joints), request)

    async def reboot(self, request: Request, given: RebootRequest) -> object:
        """Reboot the servos of joints, and answer when they are in order again."""
        joints = named_joints(self._link.plan, self._plans(), given.joints)
        require_reboots(self._link.plan, joints)
        return await self._joints_done("reboot", replace(given, joints=joints), request)

    async def _joints_done(
        self, kind: str, wanted: TorqueRequest | RebootRequest, request: Request
    ) -> Executed[int]:
        done = await self._link.for_loop(kind, wanted, origin(request))
        await self._link.recorded(done.cycle + 1)  # so that the states that follow show it
        self._released |= dict.fromkeys(done.deactivated)
        offered = self._offered() if isinstance(wanted, TorqueRequest) and wanted.on else ()
        return Executed(done.cycle, joints=wanted.joints, deactivated=done.deactivated, offered=offered)

    def _offered(self) -> tuple[str, ...]:
        """Return the released controllers that could be activated again: their joints have torque."""
        record, known = self._link.newest(), self._link.controllers
        for name in [one for one in self._released if one not in known or self._link.active(known[one])]:
            del self._released[name]
        if record is None:
            return ()
        rows = {joint.name: row for row, joint in enumerate(self._link.plan.loop.joints)}
        limp = {joint for joint, row in rows.items() if record.states.torque[row] in LIMP}
        return tuple(name for name in self._released if limp.isdisjoint(known[name].plan.joints))

    async def rate(self, request: Request, given: Rate) -> object:
        """Run the loop at another rate."""
        return await self._for_loop("rate", given, request, partial(self._link.note_rate, given.rate))

    async def halt(self, request: Request) -> object:
        """Let every joint come to a stop and hold; answered when they stand still."""
        return await self._for_loop("halt", None, request)

    async def pause(self, request: Request) -> object:
        """Hold the joints at their goals, and stop the controllers' time."""
        return await self._for_loop("pause", None, request, partial(self._link.note_paused, True))

    async def resume(self, request: Request) -> object:
        """Let the controllers' time run again."""
        return await self._for_loop("resume", None, request, partial(self._link.note_paused, False))

    async def stop(self, request: Request) -> object:
        """End the run in order."""
        return await self._for_loop("stop", None, request)

    async def _for_loop(
        self, kind: str, data: object, request: Request, noted: Callable[[Done], object] | None = None
    ) -> Executed[int]:
        """Have the loop do something; `noted` is called when it is done."""
        done = await self._link.for_loop(kind, data, origin(request), noted)
        return Executed(done.cycle, halted=done.halted)

    async def load(self, request: Request, entry: dict[str, object]) -> object:
        """Load a controller into a paused loop."""
        others = {name: loaded.plan for name, loaded in self._link.controllers.items()}
        plan = self._preparation.controller(entry, others, self._link.rate)
        return await self._for_loop("load", plan, request, partial(self._link.loaded, plan))

    async def unload(self, request: Request) -> object:
        """Take a controller out of a paused loop."""
        name = self._known(request).plan.name
        return await self._for_loop("unload", Unload(name), request, partial(self._link.unloaded, name))

    def _plans(self) -> list[ControllerPlan]:
        return [one.plan for one in self._link.controllers.values()]

    def _active(self, plan: ControllerPlan) -> bool:
        return self._link.active(self._link.controllers[plan.name])

    def _known(self, request: Request) -> Loaded:
        name = request.path_params["name"]
        loaded = self._link.controllers.get(name)
        if loaded is None:
            raise unknown_controllers([name], (*self._link.controllers, *self._devices))
        return loaded


class Asked(NamedTuple):
    """A request that clients may make."""

    method: str
    path: str
    handler: Callable[..., Awaitable[object]]
    """Gets the request, and its body where that has a type; returns the answer."""
    rate: float
    """How many a second of one process, together with all others of this number; 0: it is always taken."""
    body: type | None = None


REQUESTS = (
    Asked("GET", "/robot", GatewayApp.robot, MOST_LOOKS),
    Asked("GET", "/states", GatewayApp.states, MOST_LOOKS),
    Asked("GET", "/frames", GatewayApp.frames, MOST_LOOKS),
    Asked("GET", "/events", GatewayApp.events, MOST_LOOKS),
    Asked("GET", "/topics", GatewayApp.topics, MOST_LOOKS),
    Asked("GET", "/stream", GatewayApp.stream, MOST_LOOKS),
    Asked("GET", "/goals", GatewayApp.goals, MOST_LOOKS),
    Asked("GET", "/goals/{number}", GatewayApp.goal, MOST_LOOKS),
    Asked("POST", "/goals/{number}/cancel", GatewayApp.cancel, MOST_OPERATIONS),
    Asked("POST", "/controllers/{name}/cancel", GatewayApp.cancel, MOST_OPERATIONS),
    Asked("GET", "/controllers/{name}/parameters", GatewayApp.parameters, MOST_OPERATIONS),
    Asked("POST", "/controllers/{name}/parameters", GatewayApp.change, MOST_OPERATIONS, NewValues),
    Asked("POST", "/controllers/{name}/commands/{kind}", GatewayApp.command, MOST_OPERATIONS),
    Asked("POST", "/controllers/{name}/set-points/{kind}", GatewayApp.set_point, MOST_SET_POINTS),
    Asked("POST", "/controllers", GatewayApp.load, MOST_OPERATIONS, dict[str, object]),
    Asked("DELETE", "/controllers/{name}", GatewayApp.unload, MOST_OPERATIONS),
    Asked("POST", "/play", GatewayApp.play, MOST_OPERATIONS, NewMotion),
    Asked("POST", "/switch", GatewayApp.switch, MOST_OPERATIONS, Switch),
    # a path, since servos that share joints have names such as hip/1
    Asked("POST", "/joints/{name:path}/registers/{item}", GatewayApp.register, MOST_OPERATIONS, Value),
    Asked("GET", "/joints/{name:path}/registers/{item}", GatewayApp.read_register, MOST_OPERATIONS),
    Asked("GET", "/joints/{name:path}", GatewayApp.joint, MOST_LOOKS),
    Asked("POST", "/torque", GatewayApp.torque, MOST_OPERATIONS, TorqueRequest),
    Asked("POST", "/reboot", GatewayApp.reboot, MOST_OPERATIONS, RebootRequest),
    Asked("POST", "/rate", GatewayApp.rate, MOST_OPERATIONS, Rate),
    Asked("POST", "/halt", GatewayApp.halt, 0),
    Asked("POST", "/pause", GatewayApp.pause, MOST_OPERATIONS),
    Asked("POST", "/resume", GatewayApp.resume, MOST_OPERATIONS),
    Asked("POST", "/stop", GatewayApp.stop, 0),
)
"""All of them. Halt and stop are always taken, as far as there is room."""
_EXAMPLES: Mapping[type, str] = {
    NewValues: '{"values": {"speed": "20 deg/s"}}',
    dict[str, object]: '{"name": "arm", "type": "..."}',
    NewMotion: '{"text": "name: wave ...", "speed": 0.5}',
    Switch: '{"activate": ["head"], "deactivate": []}',
    Value: '{"value": 800}',
    TorqueRequest: '{"joints": ["elbow"], "on": false}',
    RebootRequest: '{"joints": ["elbow"]}',
    Rate: '{"rate": 100}',
}
"""Of each body, for what is refused."""


def _response(reply: object) -> Response:
    """Return the response for what a handler returned."""
    if isinstance(reply, Response):
        return reply
    if isinstance(reply, Executed | Changed | Clamped):
        status = 202 if isinstance(reply, Clamped) else 200
        return _json({"done": True, **msgspec.to_builtins(reply)}, status)
    return _json(reply)


def _json(content: object, status: int = 200) -> Response:
    return Response(msgspec.json.encode(content), status, media_type="application/json")


def _mistaken(error: InputError) -> dict[str, Field]:
    """Return the mistakes of a motion: what, where and how to fix it, each a tuple; and all as one text."""
    found = error.problems[:MOST_MISTAKES]
    if not found:
        return {"problem": str(error)}
    return {
        "problem": "; ".join(map(str, found)),
        "places": tuple(f"{one.mark.line}:{one.mark.column}" for one in found),
        "problems": tuple(one.what for one in found),
        "fixes": tuple(one.fix for one in found),
    }


def _goal_number(request: Request) -> int:
    text = request.path_params["number"]
    if not (text.isdecimal() and text.isascii() and len(text) < 16):
        raise invalid(f"{text[:40]!r} is no number of a goal")
    return int(text)


def _refused(refusal: Refusal) -> Response:
    status = _STATUS.get(refusal.code, _CONFLICT)
    sentence = " ".join(refusal.text.split())[:LONGEST_SENTENCE]
    response = _json(NotDone(sentence, refusal.code, refusal.fields), status)
    if status in (408, 413):
        response.headers["connection"] = "close"  # what still comes of the body is not read
    return response


async def _unknown_page(request: Request, error: Exception) -> Response:
    method = isinstance(error, HTTPException) and error.status_code == 405
    code = Code.WRONG_METHOD if method else Code.UNKNOWN_PAGE
    return _refused(Refusal(code, {"method": request.method, "path": request.url.path[:80]}))


# Requests


@dataclass(slots=True)
class Allowance:
    """So many requests a second of each process, and no more (token bucket of a tenth of a second).

    Long bodies count as many short ones: what they cost to read and to check keeps other clients waiting.
    """

    rate: float
    now: Callable[[], float]
    """Returns the time, s."""
    _left: dict[str, tuple[float, float]] = field(default_factory=dict, init=False)
    """Peer -> what it has left, and since when."""

    def spend(self, peer: str) -> None:
        """Take one; raises RefusedRequest when there is none left."""
        left = self._refilled(peer)
        if left < 1:
            raise refused(Code.TOO_OFTEN, {"rate": self.rate})
        self._left[peer] = (left - 1, self.now())

    def charge(self, peer: str, size: int) -> None:
        """Take what a body of so many bytes costs, also when that is more than is left."""
        self._left[peer] = (self._refilled(peer) - size // CHARGED_BYTES, self.now())

    def _refilled(self, peer: str) -> float:
        now, most = self.now(), self.rate / 10
        left, since = self._left.pop(peer, (most, now))
        left = min(most, left + (now - since) * self.rate)
        self._left[peer] = (left, now)
        if len(self._left) > MOST_PEERS:
            del self._left[next(iter(self._left))]
        return left


async def body(request: Request) -> bytes:
    """Return a body, as long as it may be; raises RefusedRequest before more than that is in memory."""
    announced = request.headers.get("content-length", "0")
    if not announced.isdecimal() or len(announced) > 18 or int(announced) > MOST_BYTES:
        raise refused(Code.TOO_LONG, {"size": announced[:20], "most": MOST_BYTES})
    content = bytearray()
    try:
        async with asyncio.timeout(BODY_S):
            async for chunk in request.stream():
                content += chunk
                if len(content) > MOST_BYTES:
                    raise refused(Code.TOO_LONG, {"size": len(content), "most": MOST_BYTES})
    except TimeoutError:
        raise refused(Code.BODY_TIMEOUT, {"seconds": BODY_S}) from None
    finally:
        request.state.received = len(content)
    return bytes(content)


async def typed(request: Request, kind: type[T]) -> T:
    """Return a body that is JSON of a type; raises RefusedRequest."""
    try:
        return msgspec.json.decode(await body(request), type=kind)
    except (msgspec.MsgspecError, RecursionError) as error:
        raise invalid(f"{error}; write for example {_EXAMPLES[kind]}") from error


def number(request: Request, name: str, default: float) -> float:
    """Return a number of the query; raises RefusedRequest."""
    text = request.query_params.get(name)
    try:
        value = default if text is None else float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise invalid(f"{name}={str(text)[:40]} is no number")
    return value


def waiting(request: Request) -> float:
    """Return how long a client waits, s; raises RefusedRequest."""
    wait = number(request, "wait", 0.0)
    if not 0 <= wait <= LONGEST_WAIT_S:
        raise invalid(f"wait is 0 to {LONGEST_WAIT_S:g} s, not {wait:g}")
    return wait


def peer(request: Request) -> str:
    """Return the process that sent a request, as the operating system reports it."""
    return request.client.host if request.client else "a process"


def origin(request: Request) -> str:
    """Return a client's name for the log: printable, at most 64 characters; the process if it has none."""
    given = request.headers.get("x-dxlrun-client", "").encode("latin-1", "replace").decode(errors="replace")
    name = "".join(letter for letter in given if letter.isprintable())[:LONGEST_ORIGIN]
    return name.strip() or peer(request)
