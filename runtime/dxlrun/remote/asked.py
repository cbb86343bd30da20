"""Asked: a received request with its validated body and query, and the rate limit of each client process."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from types import NoneType
from typing import Generic, cast

import msgspec
import starlette.requests

from dxlrun.channels.answers import Code
from dxlrun.remote import texts
from dxlrun.remote.network.commander import HERE, Client
from dxlrun.remote.preparation import invalid, refused
from dxlrun.remote.requests.table import EXAMPLES, Answer, Body, Request, Role
from dxlrun.remote.sockets import MOST_BYTES

MOST_PEERS = 256
"""Upper limit of clients whose token bucket is stored; the least recently used bucket is dropped."""
CHARGED_BYTES = 16_384
"""Body size that costs one additional token of the rate limit."""
BODY_S = 10.0
"""Timeout for receiving a body."""
LONGEST_WAIT_S = 5.0
"""Longest wait for the end of a goal in one request; a client that waits longer repeats the request."""
# Characters; a client chooses its name freely, so it must not fill the log.
LONGEST_ORIGIN = 64


@dataclass(frozen=True, slots=True)
class Asked(Generic[Body]):
    """A client's HTTP request with its decoded body."""

    http: starlette.requests.Request
    body: Body

    def part(self, name: str = "name") -> str:
        """Return a path parameter."""
        return str(self.http.path_params[name])

    def number(self, name: str, default: float) -> float:
        """Return a finite number of the query; raises RefusedRequest."""
        text = self.http.query_params.get(name)
        try:
            value = default if text is None else float(text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise invalid(texts.not_a_number(name, text))
        return value

    @property
    def wait_s(self) -> float:
        """Time that the client waits, s; raises RefusedRequest outside 0 to LONGEST_WAIT_S."""
        wait = self.number("wait", 0.0)
        if not 0 <= wait <= LONGEST_WAIT_S:
            raise invalid(texts.wait_out_of_range(wait, LONGEST_WAIT_S))
        return wait

    @property
    def goal(self) -> int:
        """Goal number in the path; raises RefusedRequest."""
        text = self.part("number")
        if not (text.isdecimal() and text.isascii() and len(text) < 16):
            raise invalid(texts.not_a_goal_number(text))
        return int(text)

    @property
    def origin(self) -> str:
        """Client name for the log: printable, at most 64 characters; default: the client's process."""
        given = self.http.headers.get("x-dxlrun-client", "").encode("latin-1", "replace")
        name = "".join(filter(str.isprintable, given.decode(errors="replace")))[:LONGEST_ORIGIN]
        client = client_of(self.http)
        # The self-chosen name is appended, so it cannot hide the certificate's name.
        if client.commands_as != HERE:
            return f"{client.name}: {name}"[:LONGEST_ORIGIN] if name.strip() else client.name
        return name.strip() or client.name


def client_of(http: starlette.requests.Request) -> Client:
    """Return the client of a request's connection."""
    return Client(http.client.host, Role(http.client.port)) if http.client else Client("", Role.OBSERVE)


def peer(http: starlette.requests.Request) -> str:
    """Return the client's process, as reported by Linux, or the name in its certificate."""
    return client_of(http).name


@dataclass(slots=True)
class Allowance:
    """Rate limit of each client process (token bucket with a capacity of 0.1 s).

    A long body costs additional tokens, because reading and checking it delays other clients.
    """

    rate: float
    now: Callable[[], float]
    """Clock, s."""
    _left: dict[str, tuple[float, float]] = field(default_factory=dict, init=False)
    """Peer -> (remaining tokens, time of the last update)."""

    def spend(self, peer: str, count: int = 1, least: int = 1) -> None:
        """Spend `count` tokens. Raises RefusedRequest when fewer than `least` tokens remain."""
        now, most = self.now(), self.rate / 10
        left, since = self._left.pop(peer, (most, now))
        left = min(most, left + (now - since) * self.rate)
        self._left[peer] = (left - count if left >= least else left, now)
        if len(self._left) > MOST_PEERS:
            del self._left[next(iter(self._left))]
        if left < least:
            raise refused(Code.TOO_OFTEN, {"rate": self.rate})


async def received(
    request: Request[Body, Answer], http: starlette.requests.Request, allowance: Allowance | None
) -> Asked[Body]:
    """Read, charge and decode the body of a request; raises RefusedRequest."""
    if request.body is NoneType:
        return Asked(http, cast("Body", None))
    content = await _content(http, allowance)
    if request.body is bytes:
        return Asked(http, cast("Body", content))
    try:
        return Asked(http, msgspec.json.decode(content, type=request.body))
    except (msgspec.MsgspecError, RecursionError) as error:
        raise invalid(texts.no_body(error, EXAMPLES[request.body])) from error


async def _content(http: starlette.requests.Request, allowance: Allowance | None) -> bytes:
    """Read a body; raises RefusedRequest before more than MOST_BYTES are in memory."""
    announced = http.headers.get("content-length", "0")
    if not announced.isdecimal() or len(announced) > 18 or int(announced) > MOST_BYTES:
        raise refused(Code.TOO_LONG, {"size": announced[:20], "most": MOST_BYTES})
    content = bytearray()
    try:
        async with asyncio.timeout(BODY_S):
            async for chunk in http.stream():
                content += chunk
                if len(content) > MOST_BYTES:
                    raise refused(Code.TOO_LONG, {"size": len(content), "most": MOST_BYTES})
    except TimeoutError:
        raise refused(Code.BODY_TIMEOUT, {"seconds": BODY_S}) from None
    finally:
        if allowance is not None and len(content) >= CHARGED_BYTES:
            allowance.spend(peer(http), len(content) // CHARGED_BYTES, -MOST_BYTES)
    return bytes(content)
