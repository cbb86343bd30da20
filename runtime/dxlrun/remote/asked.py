"""Asked: a request as the gateway gets it, its body and numbers checked, and how many a process may make."""

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
from dxlrun.remote.network.commander import HERE, Client
from dxlrun.remote.preparation import invalid, refused
from dxlrun.remote.requests.table import EXAMPLES, Answer, Body, Request, Role
from dxlrun.remote.sockets import MOST_BYTES

MOST_PEERS = 256
"""Processes whose allowance is kept."""
CHARGED_BYTES = 16_384
"""So many bytes of a body count as one request more."""
BODY_S = 10.0
"""How long a body may take to arrive."""
LONGEST_WAIT_S = 5.0
"""For the end of a goal; a client that waits longer asks again."""
LONGEST_ORIGIN = 64


@dataclass(frozen=True, slots=True)
class Asked(Generic[Body]):
    """A request that a client made."""

    http: starlette.requests.Request
    body: Body

    def part(self, name: str = "name") -> str:
        """Return a name in its path."""
        return str(self.http.path_params[name])

    def number(self, name: str, default: float) -> float:
        """Return a number of the query; raises RefusedRequest."""
        text = self.http.query_params.get(name)
        try:
            value = default if text is None else float(text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise invalid(f"{name}={str(text)[:40]} is no number")
        return value

    @property
    def wait_s(self) -> float:
        """How long the client waits; raises RefusedRequest."""
        wait = self.number("wait", 0.0)
        if not 0 <= wait <= LONGEST_WAIT_S:
            raise invalid(f"wait is 0 to {LONGEST_WAIT_S:g} s, not {wait:g}")
        return wait

    @property
    def goal(self) -> int:
        """The number of a goal in its path; raises RefusedRequest."""
        text = self.part("number")
        if not (text.isdecimal() and text.isascii() and len(text) < 16):
            raise invalid(f"{text[:40]!r} is no number of a goal")
        return int(text)

    @property
    def origin(self) -> str:
        """The client's name for the log: printable, at most 64 characters; the process if it has none."""
        given = self.http.headers.get("x-dxlrun-client", "").encode("latin-1", "replace")
        name = "".join(filter(str.isprintable, given.decode(errors="replace")))[:LONGEST_ORIGIN]
        client = client_of(self.http)
        if client.commands_as != HERE:  # a name that it chose does not hide the certificate's
            return f"{client.name}: {name}"[:LONGEST_ORIGIN] if name.strip() else client.name
        return name.strip() or client.name


def client_of(http: starlette.requests.Request) -> Client:
    """Return the client that sent a request, as its connection has it."""
    return Client(http.client.host, Role(http.client.port)) if http.client else Client("", Role.OBSERVE)


def peer(http: starlette.requests.Request) -> str:
    """Return the process that sent a request, as Linux reports it, or the name in its certificate."""
    return client_of(http).name


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

    def spend(self, peer: str, count: int = 1, least: int = 1) -> None:
        """Take so many; raises RefusedRequest when there are fewer than `least` left."""
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
    """Return a request with its body, which is charged for; raises RefusedRequest."""
    if request.body is NoneType:
        return Asked(http, cast("Body", None))
    content = await _content(http, allowance)
    if request.body is bytes:
        return Asked(http, cast("Body", content))
    try:
        return Asked(http, msgspec.json.decode(content, type=request.body))
    except (msgspec.MsgspecError, RecursionError) as error:
        raise invalid(f"{error}; write for example {EXAMPLES[request.body]}") from error


async def _content(http: starlette.requests.Request, allowance: Allowance | None) -> bytes:
    """Return a body, as long as it may be; raises RefusedRequest before more than that is in memory."""
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
