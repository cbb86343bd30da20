"""Asked: a received HTTP request with its validated body and query, and the rate limit of each client."""

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
from dxlrun.remote.requests.request_table import EXAMPLES, Answer, Body, Request, Role
from dxlrun.remote.sockets import MOST_BYTES

MOST_PEERS = 256
"""Upper limit of the clients whose rate limit is tracked; the one that was silent longest is dropped."""
CHARGED_BYTES = 16_384
"""Size of a body, bytes, that costs a token of the rate limit; smaller bodies cost only that of the request.
"""
BODY_S = 10.0
"""Timeout for receiving the whole body of a request, s."""
LONGEST_WAIT_S = 5.0
"""Longest wait, s, for the end of a goal in one request; a client repeats the request to wait longer."""
# Characters; a client chooses its name freely, so it must not fill the log.
LONGEST_ORIGIN = 64


@dataclass(frozen=True, slots=True)
class ClientRequest(Generic[Body]):
    """A client's HTTP request with its decoded body."""

    http: starlette.requests.Request
    body: Body

    def part(self, name: str = "name") -> str:
        """Return a parameter of the path, by default `name`."""
        return str(self.http.path_params[name])

    def number(self, name: str, default: float) -> float:
        """Return a number of the query, or `default` when it is not given; raises RefusedRequest if it is not
        finite.
        """
        text = self.http.query_params.get(name)
        try:
            value = default if text is None else float(text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise invalid(f"{name}={str(text)[:40]} is not a number")
        return value

    @property
    def wait_s(self) -> float:
        """Time, s, that the client is willing to wait for the reply; raises RefusedRequest outside 0 to
        LONGEST_WAIT_S.
        """
        wait = self.number("wait", 0.0)
        if not 0 <= wait <= LONGEST_WAIT_S:
            raise invalid(f"wait={wait:g} is out of range; write 0 to {LONGEST_WAIT_S:g} s")
        return wait

    @property
    def goal(self) -> int:
        """Number of the goal in the path; raises RefusedRequest."""
        text = self.part("number")
        if not (text.isdecimal() and text.isascii() and len(text) < 16):
            raise invalid(f"{text[:40]!r} is not the number of a goal; write a whole number, such as 3")
        return int(text)

    @property
    def origin(self) -> str:
        """Name of the client for the log: its own choice, after the name in its certificate; by default its
        process.
        """
        given = self.http.headers.get("x-dxlrun-client", "").encode("latin-1", "replace")
        name = "".join(filter(str.isprintable, given.decode(errors="replace")))[:LONGEST_ORIGIN]
        client = client_of(self.http)
        # The self-chosen name is appended, so it cannot hide the certificate's name.
        if client.commands_as != HERE:
            return f"{client.name}: {name}"[:LONGEST_ORIGIN] if name.strip() else client.name
        return name.strip() or client.name


def client_of(http: starlette.requests.Request) -> Client:
    """Return the client that made a request: name and role."""
    return Client(http.client.host, Role(http.client.port)) if http.client else Client("", Role.OBSERVE)


def peer(http: starlette.requests.Request) -> str:
    """Return the client's name, which counts for rate limits: process ID, or name in its certificate."""
    return client_of(http).name


@dataclass(slots=True)
class Allowance:
    """Rate limit of each client: a token bucket that is filled at `rate` and holds the tokens of 0.1 s.

    A long body costs additional tokens, because reading and checking it delays other clients.
    """

    rate: float
    now: Callable[[], float]
    """Clock with the current time, s."""
    _left: dict[str, tuple[float, float]] = field(default_factory=dict, init=False)
    """Client name -> (remaining tokens, time of the last update in s)."""

    def spend(self, peer: str, count: int = 1, least: int = 1) -> None:
        """Take `count` tokens from a client's bucket, or raise RefusedRequest when it holds fewer than
        `least`.
        """
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
) -> ClientRequest[Body]:
    """Read and decode the body of a request; a long one costs tokens of `allowance`.

    Raises RefusedRequest.
    """
    if request.body is NoneType:
        return ClientRequest(http, cast("Body", None))
    content = await _content(http, allowance)
    if request.body is bytes:
        return ClientRequest(http, cast("Body", content))
    try:
        return ClientRequest(http, msgspec.json.decode(content, type=request.body))
    except (msgspec.MsgspecError, RecursionError) as error:
        raise invalid(f"{error}; write for example {EXAMPLES[request.body]}") from error


async def _content(http: starlette.requests.Request, allowance: Allowance | None) -> bytes:
    """Return a request's body; raises RefusedRequest above MOST_BYTES, or after BODY_S."""
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
