"""Gateway: who may ask a running robot what, over HTTP on a Unix socket; JSON in, JSON out.

    GET  /robot                                 who it is, its controllers and what they take
    GET  /states                                the newest cycle
    GET  /events?after=N                        what happened since event N
    POST /controllers/NAME/commands/KIND        a typed command
    POST /controllers/NAME/set-points/KIND      one of a stream; the newest wins; ?lease=0.2 (seconds)
    POST /switch {activate, deactivate}         controllers, in one cycle or not at all
    POST /rate {rate}, /pause, /resume, /stop
    POST /controllers {name, type, ...}         load one, DELETE /controllers/NAME unload it; in a pause only

`{"done": true}`, or `{"refused": "..."}` with a status of 4xx or 5xx.
"""

from __future__ import annotations

import math
import time
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from typing import TypeAlias

import msgspec
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response
from starlette.routing import Route

from dxlrun.remote.link import Link, Loaded
from dxlrun.remote.preparation import Preparation, Refusal

MOST_BYTES = 1 << 20
"""The longest body; longer ones are refused before they are read."""
MOST_OPERATIONS = 200.0
MOST_SET_POINTS = 4000.0
"""A second, of all clients together; a short burst may be as many at once as come in a tenth of it."""
LEASE_S = (0.01, 0.2, 60.0)
"""Shortest, default and longest time that a set-point of a stream counts."""

Handler: TypeAlias = Callable[[Request], Awaitable[Response]]


@dataclass(slots=True)
class Allowance:
    """So many a second, and no more (token bucket)."""

    rate: float
    _left: float = field(init=False)
    _at: float = field(init=False)

    def __post_init__(self) -> None:
        self._left, self._at = self.rate / 10, time.monotonic()

    def spend(self) -> None:
        """Take one; raises Refusal when there is none left."""
        now = time.monotonic()
        self._left = min(self.rate / 10, self._left + (now - self._at) * self.rate)
        self._at = now
        if self._left < 1:
            raise Refusal(429, f"more than {self.rate:g} a second; ask less often")
        self._left -= 1


class Gateway:
    """The routes; every wish is checked and prepared here, so that the loop only has to take it."""

    def __init__(self, link: Link, preparation: Preparation, log: str | None) -> None:
        self._link = link
        self._preparation = preparation
        self._log = log
        self._operations = Allowance(MOST_OPERATIONS)
        self._set_points = Allowance(MOST_SET_POINTS)

    def app(self) -> Starlette:
        """Return the ASGI application."""

        def route(path: str, handler: Handler, method: str) -> Route:
            return Route(path, _answered(handler), methods=[method])

        routes = [
            route("/robot", self.robot, "GET"),
            route("/states", self.states, "GET"),
            route("/events", self.events, "GET"),
            route("/controllers/{name}/commands/{kind}", self.command, "POST"),
            route("/controllers/{name}/set-points/{kind}", self.set_point, "POST"),
            route("/controllers/{name}", self.unload, "DELETE"),
            route("/controllers", self.load, "POST"),
            route("/switch", self.switch, "POST"),
            route("/rate", self.rate, "POST"),
            route("/pause", self.pause, "POST"),
            route("/resume", self.resume, "POST"),
            route("/stop", self.stop, "POST"),
        ]
        return Starlette(routes=routes, exception_handlers={HTTPException: _no_such_page})

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
        try:
            takes = self._preparation.takes(plan)
        except Refusal:
            takes = {}
        return {
            "name": plan.name,
            "type": plan.type,
            "active": self._link.active(loaded),
            "held": loaded.held,
            "rate": plan.rate or self._link.rate,
            "joints": plan.joints,
            "command": plan.command,
            "takes": takes,
        }

    async def states(self, request: Request) -> Response:
        """The newest cycle; numbers that are not there are null."""
        record = self._link.newest()
        if record is None:
            raise Refusal(503, "the loop has run no cycle yet; ask again")
        states, goals = record.states, record.goals
        rows = {
            joint.name: {
                "position": _number(states.position[row]),
                "velocity": _number(states.velocity[row]),
                "effort": _number(states.effort[row]),
                "valid": bool(states.valid[row]),
                "age": int(states.age_ns[row]) * 1e-9,
                "goal_position": _number(goals.position[row]),
                "goal_velocity": _number(goals.velocity[row]),
            }
            for row, joint in enumerate(self._link.plan.loop.joints)
        }
        return _json({"cycle": record.cycle, "time": record.woken_ns * 1e-9, "joints": rows})

    async def events(self, request: Request) -> Response:
        """What happened since event `after`, as far as it is kept."""
        after = _query(request, "after", 0.0)
        found = [(number, event) for number, event in self._link.events if number > after]
        last = self._link.events[-1][0] if self._link.events else 0
        rows = [
            {
                "number": number,
                "time": event.t_ns * 1e-9,
                "name": event.name,
                "severity": event.severity,
                "source": event.source,
                "text": event.text,
            }
            for number, event in found
        ]
        return _json({"events": rows, "last": last})

    # Steering

    async def command(self, request: Request) -> Response:
        """Check and prepare a typed command, and let the loop hand it over."""
        self._operations.spend()
        loaded, kind = self._addressed(request)
        data = self._preparation.command(loaded.plan, kind, await _body(request))
        await self._link.ask(loaded.plan.name, kind, data, _origin(request))
        return _done()

    async def set_point(self, request: Request) -> Response:
        """Leave the newest of a stream for the loop; what the loop refuses is an event, not an answer."""
        self._set_points.spend()
        shortest, usual, longest = LEASE_S
        lease = _query(request, "lease", usual)
        if not shortest <= lease <= longest:
            raise Refusal(422, f"a lease is {shortest:g} to {longest:g} s, not {lease:g}")
        loaded, kind = self._addressed(request)
        data = self._preparation.command(loaded.plan, kind, await _body(request))
        if not self._link.active(loaded):
            raise Refusal(409, f"{loaded.plan.name} is not active; switch to it first")
        self._link.set_point(loaded, kind, data, _origin(request), round(lease * 1e9))
        return _done(202)

    async def switch(self, request: Request) -> Response:
        """Activate and deactivate controllers in one cycle."""
        await self._ask(request, "switch", await _object(request))
        return _done()

    async def rate(self, request: Request) -> Response:
        """Run the loop at another rate."""
        wish = await _object(request)
        rate = wish.get("rate")
        if not isinstance(rate, int | float) or isinstance(rate, bool) or len(wish) != 1:
            raise Refusal(422, 'write {"rate": 100}, in Hz')
        await self._ask(request, "rate", {"rate": float(rate)})
        self._link.rate = float(rate)
        return _done()

    async def pause(self, request: Request) -> Response:
        """Hold the joints where they are sent; the controllers' time stands still."""
        await self._ask(request, "pause", None)
        self._link.paused = True
        return _done()

    async def resume(self, request: Request) -> Response:
        """Let the controllers' time go on."""
        await self._ask(request, "resume", None)
        self._link.paused = False
        return _done()

    async def stop(self, request: Request) -> Response:
        """End the run in order."""
        await self._link.ask_loop("stop", None, _origin(request))  # always taken: never by allowance
        return _done()

    async def load(self, request: Request) -> Response:
        """Load a controller into a paused loop."""
        plan = self._preparation.controller(await _object(request))
        if plan.name in self._link.controllers:
            raise Refusal(409, f"there is a controller {plan.name} already")
        await self._ask(request, "load", msgspec.to_builtins(plan))
        self._link.load(plan)
        return _done()

    async def unload(self, request: Request) -> Response:
        """Take a controller out of a paused loop."""
        loaded = self._known(request)
        await self._ask(request, "unload", {"controller": loaded.plan.name})
        self._link.controllers.pop(loaded.plan.name, None)
        return _done()

    async def _ask(self, request: Request, kind: str, data: object) -> None:
        self._operations.spend()
        await self._link.ask_loop(kind, data, _origin(request))

    def _known(self, request: Request) -> Loaded:
        name = request.path_params["name"]
        loaded = self._link.controllers.get(name)
        if loaded is None:
            raise Refusal(
                404, f"there is no controller {name}; there are {', '.join(self._link.controllers)}"
            )
        return loaded

    def _addressed(self, request: Request) -> tuple[Loaded, str]:
        return self._known(request), request.path_params["kind"]


def _answered(handler: Handler) -> Handler:
    """Return a handler whose refusals become answers."""

    async def answer(request: Request) -> Response:
        try:
            return await handler(request)
        except Refusal as refusal:
            return _json({"refused": str(refusal)}, refusal.status)
        except ClientDisconnect:
            return Response(status_code=400)  # nobody reads it

    return answer


async def _body(request: Request) -> bytes:
    """Return a body, as long as it may be; raises Refusal before more than that is in memory."""
    announced = request.headers.get("content-length", "0")
    if not announced.isdigit() or int(announced) > MOST_BYTES:
        raise Refusal(413, f"at most {MOST_BYTES} bytes are taken at once")
    body = bytearray()
    async for chunk in request.stream():
        body += chunk
        if len(body) > MOST_BYTES:
            raise Refusal(413, f"at most {MOST_BYTES} bytes are taken at once")
    return bytes(body)


async def _object(request: Request) -> dict[str, object]:
    try:
        return msgspec.json.decode(await _body(request), type=dict[str, object])
    except msgspec.MsgspecError as error:
        raise Refusal(422, f"this is no JSON object: {error}") from error


def _query(request: Request, name: str, default: float) -> float:
    text = request.query_params.get(name)
    try:
        value = default if text is None else float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise Refusal(422, f"{name}={text} is no number")
    return value


def _origin(request: Request) -> str:
    """Return who asks, for the log."""
    name = request.headers.get("x-dxlrun-client", "")
    return "".join(letter for letter in name if letter.isprintable())[:64] or "a client"


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _json(content: object, status: int = 200) -> Response:
    return Response(msgspec.json.encode(content), status, media_type="application/json")


def _done(status: int = 200) -> Response:
    return _json({"done": True}, status)


async def _no_such_page(request: Request, error: Exception) -> Response:
    status = error.status_code if isinstance(error, HTTPException) else 500
    return _json({"refused": f"{request.method} {request.url.path} is nothing that can be asked"}, status)
