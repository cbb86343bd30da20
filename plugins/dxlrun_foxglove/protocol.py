"""Frames of `foxglove.websocket.v1`, the protocol of live viewers, in both directions.

The specification is in github.com/foxglove/ws-protocol. `foxglove.sdk.v1` has the same frames.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Annotated, Literal

import msgspec

SUBPROTOCOLS = ("foxglove.websocket.v1", "foxglove.sdk.v1")
MESSAGE, CALL, RESPONSE = 1, 2, 3
"""Opcodes of binary frames; viewers send CALL, the server MESSAGE and RESPONSE."""
MESSAGE_HEAD = struct.Struct("<BIQ")
"""Opcode, subscription, time (ns since 1970); the message follows."""
_CALL_HEAD = struct.Struct("<BIII")
"""Opcode, service, number of the call, length of the encoding's name; name and body follow."""
WARNING, ERROR = 1, 2
"""Levels of a status."""
Operation = Literal[
    "subscribe",
    "unsubscribe",
    "getParameters",
    "setParameters",
    "subscribeParameterUpdates",
    "unsubscribeParameterUpdates",
    "subscribeConnectionGraph",
    "unsubscribeConnectionGraph",
]
Number = Annotated[int, msgspec.Meta(ge=0, lt=1 << 32)]


class Subscription(msgspec.Struct, frozen=True, rename="camel"):
    """Subscription of a viewer: its own number for a channel."""

    id: Number
    channel_id: Number


class Parameter(msgspec.Struct, frozen=True):
    """A parameter of a controller: `arm.gains.p`."""

    name: str
    value: bool | int | float | str


class Words(msgspec.Struct, frozen=True, rename="camel"):
    """Text frame of a viewer. Each operation uses some of the fields."""

    op: Operation
    subscriptions: list[Subscription] = []
    subscription_ids: list[Number] = []
    parameters: list[Parameter] = []
    parameter_names: list[str] = []
    id: str | None = None
    """Number of the request, which its answer repeats."""


class Call(msgspec.Struct, frozen=True):
    """Service call."""

    service: int
    number: int
    encoding: str
    body: bytes


_decode = msgspec.json.Decoder(Words).decode


def received(frame: str | bytes) -> Words | Call:
    """Parse a frame from a viewer.

    Raises:
        ValueError: The frame does not follow the protocol.
    """
    if isinstance(frame, str):
        try:
            return _decode(frame)
        except (msgspec.MsgspecError, RecursionError) as error:
            raise ValueError(str(error)) from error
    if len(frame) < _CALL_HEAD.size or frame[0] != CALL:
        raise ValueError("a binary frame that is not a call of a service")
    _, service, number, length = _CALL_HEAD.unpack_from(frame)
    content = frame[_CALL_HEAD.size :]
    return Call(service, number, content[:length].decode(errors="replace"), content[length:])


def response(call: Call, body: bytes) -> bytes:
    """Return the frame that answers a call."""
    name = call.encoding.encode()
    return _CALL_HEAD.pack(RESPONSE, call.service, call.number, len(name)) + name + body


def failure(request: Words | Call, why: str) -> str:
    """Return the frame that refuses a request, with the reason."""
    if isinstance(request, Call):
        return text("serviceCallFailure", serviceId=request.service, callId=request.number, message=why)
    return status(ERROR, why)


def values(parameters: Sequence[Parameter], number: str | None) -> str:
    """Return the frame with values of parameters; `number` is that of the request."""
    return text("parameterValues", parameters=parameters, **({"id": number} if number else {}))


def text(operation: str, **fields: object) -> str:
    """Return a text frame."""
    return msgspec.json.encode({"op": operation, **fields}).decode()


def status(level: int, message: str) -> str:
    """Return a frame that a viewer shows as a message."""
    return text("status", level=level, message=message)
