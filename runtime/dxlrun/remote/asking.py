"""Asking: how much a client may ask at all, and what of a request is believed."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TypeVar

import msgspec
from starlette.requests import Request

from dxlrun.remote.preparation import Refusal
from dxlrun.remote.sockets import MOST_BYTES

MOST_PEERS = 256
"""Processes whose allowance is remembered."""
CHARGED_BYTES = 16_384
"""So many bytes of a body count as one request more."""
BODY_S = 10.0
"""How long a body may take to arrive."""
LONGEST_ORIGIN = 64
T = TypeVar("T")


@dataclass(slots=True)
class Allowance:
    """So many a second for each process that asks, and no more (token bucket of a tenth of a second).

    Long bodies count as many short ones: what they cost to read and to judge keeps others waiting.
    """

    rate: float
    now: Callable[[], float]
    """Returns the time, s."""
    _left: dict[str, tuple[float, float]] = field(default_factory=dict, init=False)
    """Peer -> what it has left, and since when."""

    def spend(self, peer: str) -> None:
        """Take one; raises Refusal when there is none left."""
        left = self._refilled(peer)
        if left < 1:
            raise Refusal(429, f"more than {self.rate:g} a second, or too much in them; ask less often")
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
    """Return a body, as long as it may be; raises Refusal before more than that is in memory."""
    announced = request.headers.get("content-length", "0")
    if not (announced.isdecimal() and len(announced) < 20) or int(announced) > MOST_BYTES:
        raise Refusal(413, f"at most {MOST_BYTES} bytes are taken at once")
    content = bytearray()
    try:
        async with asyncio.timeout(BODY_S):
            async for chunk in request.stream():
                content += chunk
                if len(content) > MOST_BYTES:
                    raise Refusal(413, f"at most {MOST_BYTES} bytes are taken at once")
    except TimeoutError:
        raise Refusal(408, f"the request did not arrive within {BODY_S:g} s") from None
    finally:
        request.state.received = len(content)
    return bytes(content)


async def typed(request: Request, kind: type[T], example: str) -> T:
    """Return a body that is JSON of a type; raises Refusal."""
    try:
        return msgspec.json.decode(await body(request), type=kind)
    except (msgspec.MsgspecError, RecursionError) as error:
        raise Refusal(422, f"{error}; write for example {example}") from error


def number(request: Request, name: str, default: float) -> float:
    """Return a number of the query; raises Refusal."""
    text = request.query_params.get(name)
    try:
        value = default if text is None else float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise Refusal(422, f"{name}={str(text)[:40]} is no number")
    return value


def peer(request: Request) -> str:
    """Return which process asks, as the kernel told."""
    return request.client.host if request.client else "a process"


def origin(request: Request) -> str:
    """Return who asks, for the log: printable, at most 64 characters; the process when it gives no name."""
    given = request.headers.get("x-dxlrun-client", "").encode("latin-1", "replace").decode(errors="replace")
    name = "".join(letter for letter in given if letter.isprintable())[:LONGEST_ORIGIN]
    return name.strip() or peer(request)
