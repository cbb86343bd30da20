"""Gateway: who may ask a running robot what, over HTTP on a Unix socket; JSON in, JSON out.

    GET  /robot                                 who it is, its controllers and what they take
    GET  /states                                the newest cycle
    GET  /events?after=N                        what happened since event N
    POST /controllers/NAME/commands/KIND        a typed command
    POST /controllers/NAME/set-points/KIND      one of a stream; the newest wins; ?lease=0.2 (seconds)
    POST /switch {activate, deactivate}         controllers, in one cycle or not at all
    POST /joints/NAME/registers/ITEM {value}    a RAM item of a joint's servo; answered when it is there
    POST /rate {rate}, /pause, /resume, /stop
    POST /controllers {name, type, ...}         load one, DELETE /controllers/NAME unload it; in a pause only

`{"done": true}`, of a set-point with `"clamped"`, the number of values beyond their joints' limits; or
`{"refused": "..."}` with a status of 4xx or 5xx.
"""

from __future__ import annotations

import math
import time
import traceback
from collections.abc import Awaitable, Callable
from functools import partial
from typing import TypeAlias

import msgspec
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response
from starlette.routing import Route

from dxlrun.control.steering import Rate, Switch
from dxlrun.errors import suggestion
from dxlrun.mode import Mode
from dxlrun.remote.asking import Allowance, body, number, origin, peer, typed
from dxlrun.remote.link import Link, Loaded
from dxlrun.remote.preparation import Preparation, Refusal
from dxlrun.remote.registers import Value, register_wish
from dxlrun.run.channels.cycle import CycleRecord

MOST_OPERATIONS = 200.0
MOST_SET_POINTS = 4000.0
MOST_LOOKS = 2000.0
"""A second, of one process; a short burst may be as many at once as come in a tenth of it."""
LEASE_S = (0.01, 0.2, 60.0)
"""Shortest, default and longest time that a set-point of a stream counts."""
LONGEST_SENTENCE = 2000

Handler: TypeAlias = Callable[[Request], Awaitable[Response]]


class Gateway:
    """The routes; every wish is checked and prepared here, so that the loop only has to take it."""

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
        self._operations = Allowance(MOST_OPERATIONS, now)
        self._set_points = Allowance(MOST_SET_POINTS, now)
        self._looks = Allowance(MOST_LOOKS, now)

    def app(self) -> Starlette:
        """Return the ASGI application."""

        def route(path: str, handler: Handler, method: str, allowance: Allowance | None) -> Route:
            return Route(path, _answered(handler, allowance), methods=[method])

        looks, operations = self._looks, self._operations
        routes = [
            route("/robot", self.robot, "GET", looks),
            route("/states", self.states, "GET", looks),
            route("/events", self.events, "GET", looks),
            route("/controllers/{name}/commands/{kind}", self.command, "POST", operations),
            route("/controllers/{name}/set-points/{kind}", self.set_point, "POST", self._set_points),
            route("/controllers/{name}", self.unload, "DELETE", operations),
            route("/controllers", self.load, "POST", operations),
            route("/switch", self.switch, "POST", operations),
            route("/joints/{name}/registers/{item}", self.register, "POST", operations),
            route("/rate", self.rate, "POST", operations),
            route("/pause", self.pause, "POST", operations),
            route("/resume", self.resume, "POST", operations),
            route("/stop", self.stop, "POST", None),  # always taken
        ]
        app = Starlette(routes=routes, exception_handlers={HTTPException: _no_such_page})
        app.router.redirect_slashes = False
        return app

    # Looking

    async def robot(self, request: Request) -> Response:
        """Who it is, its controllers and what they take."""
        link = self._link
        return _json(
            {
                "robot": link.plan.robot,
                "rate": link.rate,
                "paused": link.paused,
                "cycles": link.heartbeat.cycles,
                "skipped": link.heartbeat.skipped,
                "joints": [joint.name for joint in link.plan.loop.joints],
                "controllers": [self._told(one) for one in link.controllers.values()],
                "log": self._log,
            }
        )

    def _told(self, loaded: Loaded) -> dict[str, object]:
        plan = loaded.plan
        return {
            "name": plan.name,
            "type": plan.type,
            "active": self._link.active(loaded),
            "held": loaded.held,
            "rate": plan.rate or self._link.rate,
            "joints": plan.joints,
            "command": plan.command,
            "takes": self._preparation.takes(plan),
        }

    async def states(self, request: Request) -> Response:
        """The newest cycle; numbers that are not there are null."""
        record = self._link.newest()
        if record is None:
            raise Refusal(503, "the loop has run no cycle yet; ask again")
        joints = self._link.plan.loop.joints
        rows = {joint.name: _state(record, row) for row, joint in enumerate(joints)}
        return _json({"cycle": record.cycle, "time": record.woken_ns * 1e-9, "joints": rows})

    async def events(self, request: Request) -> Response:
        """What happened since event `after`, as far as it is kept; `last` is the newest's number."""
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
        return _json({"events": rows, "last": newest})

    # Steering

    async def command(self, request: Request) -> Response:
        """Check and prepare a typed command, within the limits, and let the loop hand it over."""
        loaded, kind = self._known(request), request.path_params["kind"]
        prepared = self._preparation.command(loaded.plan, kind, await body(request))
        prepared.require_within_limits(f"{kind} of {loaded.plan.name}")
        await self._link.ask(loaded.plan.name, kind, prepared.data, origin(request))
        return _done()

    async def set_point(self, request: Request) -> Response:
        """Leave the newest of a stream for the loop; what the loop refuses is an event, not an answer.

        The last gate clamps values beyond their joints' limits; the answer counts them.
        """
        shortest, usual, longest = LEASE_S
        lease = number(request, "lease", usual)
        if not shortest <= lease <= longest:
            raise Refusal(422, f"a lease is {shortest:g} to {longest:g} s, not {lease:g}")
        loaded, kind = self._known(request), request.path_params["kind"]
        prepared = self._preparation.command(loaded.plan, kind, await body(request))
        if self._link.controllers.get(loaded.plan.name) is not loaded:
            raise Refusal(404, f"{loaded.plan.name} was unloaded meanwhile")
        if not self._link.active(loaded):
            raise Refusal(409, f"{loaded.plan.name} is not active; switch to it first")
        self._link.set_point(loaded, kind, prepared.data, origin(request), round(lease * 1e9))
        return _json({"done": True, "clamped": len(prepared.beyond)}, 202)

    async def switch(self, request: Request) -> Response:
        """Activate and deactivate controllers in one cycle; answer when those that wait for modes are in."""
        wish = await typed(request, Switch, '{"activate": ["head"], "deactivate": []}')
        for names in (wish.activate, wish.deactivate):
            if len(set(names)) != len(names):
                raise Refusal(422, "a controller is named twice; name it once")
            for name in names:
                self._named(name)
        done = partial(self._link.switched, wish.activate, wish.deactivate)
        answer = await self._ask(request, "switch", wish, done)
        await self._link.entered(wish.activate)
        return answer

    async def register(self, request: Request) -> Response:
        """Have a RAM item of a joint's servo written, and answer when it was read back."""
        wish = await typed(request, Value, '{"value": 800}')
        joint, item = request.path_params["name"], request.path_params["item"]
        prepared = register_wish(self._link.plan, joint, item, wish.value)
        return await self._ask(request, "register", prepared, None)

    async def rate(self, request: Request) -> Response:
        """Run the loop at another rate."""
        wish = await typed(request, Rate, '{"rate": 100}')
        return await self._ask(request, "rate", wish, lambda: setattr(self._link, "rate", wish.rate))

    async def pause(self, request: Request) -> Response:
        """Hold the joints where they are sent; the controllers' time stands still."""
        return await self._ask(request, "pause", None, lambda: setattr(self._link, "paused", True))

    async def resume(self, request: Request) -> Response:
        """Let the controllers' time go on."""
        return await self._ask(request, "resume", None, lambda: setattr(self._link, "paused", False))

    async def stop(self, request: Request) -> Response:
        """End the run in order."""
        return await self._ask(request, "stop", None, None)

    async def load(self, request: Request) -> Response:
        """Load a controller into a paused loop."""
        wish = await typed(request, dict[str, object], '{"name": "arm", "type": "..."}')
        plan = self._preparation.controller(wish, self._link.controllers)
        return await self._ask(request, "load", plan, partial(self._link.loaded, plan))

    async def unload(self, request: Request) -> Response:
        """Take a controller out of a paused loop."""
        name = self._known(request).plan.name
        done = partial(self._link.controllers.pop, name, None)
        return await self._ask(request, "unload", {"controller": name}, done)

    async def _ask(
        self, request: Request, kind: str, data: object, done: Callable[[], object] | None
    ) -> Response:
        await self._link.ask_loop(kind, data, origin(request), done)
        return _done()

    def _known(self, request: Request) -> Loaded:
        return self._named(request.path_params["name"])

    def _named(self, name: str) -> Loaded:
        loaded = self._link.controllers.get(name)
        if loaded is None:
            known = suggestion(name[:80], tuple(self._link.controllers))
            raise Refusal(404, f"there is no controller {name[:80]}; {known}")
        return loaded


def _answered(handler: Handler, allowance: Allowance | None) -> Handler:
    """Return a handler whose refusals become answers, for as many requests as a client may make."""

    async def answer(request: Request) -> Response:
        try:
            if allowance is not None:
                allowance.spend(peer(request))
            return await handler(request)
        except Refusal as refusal:
            return _refused(refusal.status, str(refusal))
        except ClientDisconnect:
            return Response(status_code=400)  # nobody reads it
        except Exception as error:  # the last resort: one request fails, the gateway goes on
            traceback.print_exc()
            return _refused(500, f"the gateway failed: {type(error).__name__}: {error}; --debug shows where")
        finally:
            if allowance is not None:
                allowance.charge(peer(request), getattr(request.state, "received", 0))

    return answer


def _state(record: CycleRecord, row: int) -> dict[str, object]:
    states, goals = record.states, record.goals
    return {
        "position": _number(states.position[row]),
        "velocity": _number(states.velocity[row]),
        "effort": _number(states.effort[row]),
        "valid": bool(states.valid[row]),
        "age": int(states.age_ns[row]) * 1e-9,
        "goal_position": _number(goals.position[row]),
        "goal_velocity": _number(goals.velocity[row]),
        "goal_effort": _number(goals.effort[row]),
        "goal_pwm": _number(goals.pwm[row]),
        "temperature": _number(states.temperature[row]),
        "voltage": _number(states.voltage[row]),
        "hardware_error": int(states.hardware_error[row]),
        "mode": Mode(int(states.mode[row])).name.lower(),
    }


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _json(content: object, status: int = 200) -> Response:
    return Response(msgspec.json.encode(content), status, media_type="application/json")


def _done() -> Response:
    return _json({"done": True})


def _refused(status: int, sentence: str) -> Response:
    response = _json({"refused": sentence[:LONGEST_SENTENCE]}, status)
    if status in (408, 413):
        response.headers["connection"] = "close"  # what still comes of the body is not read
    return response


async def _no_such_page(request: Request, error: Exception) -> Response:
    status = error.status_code if isinstance(error, HTTPException) else 500
    return _refused(status, f"{request.method} {request.url.path} is nothing that can be asked")
