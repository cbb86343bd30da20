"""Frames of `foxglove.websocket.v1`, the WebSocket protocol between viewers such as Foxglove and the server.

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
"""Header of a MESSAGE: opcode, number of the subscription, time (ns since 1970); the message follows."""
_CALL_HEAD = struct.Struct("<BIII")
"""Header of CALL and RESPONSE: opcode, number of the service, number of the call, length of the encoding's
name; the encoding's name and the body follow."""
WARNING, ERROR = 1, 2
"""Levels of a status frame, which a viewer shows as a message."""
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
    """Subscription of a viewer: `id` is the viewer's own number for the server's channel `channel_id`."""

    id: Number
    channel_id: Number


class ViewerParameter(msgspec.Struct, frozen=True):
    """Value of a controller's parameter."""

    name: str
    """Controller and parameter: `arm.gains.p` is `gains.p` of the controller `arm`."""
    value: bool | int | float | str


class ViewerFrame(msgspec.Struct, frozen=True, rename="camel"):
    """Text frame (JSON) from a viewer. Each operation `op` uses some of the fields."""

    op: Operation
    subscriptions: list[Subscription] = []
    subscription_ids: list[Number] = []
    parameters: list[ViewerParameter] = []
    parameter_names: list[str] = []
    id: str | None = None
    """Viewer's name for the request, which the answer repeats."""


class Call(msgspec.Struct, frozen=True):
    """Service call from a viewer (binary frame)."""

    service: int
    """Number of the service, as advertised."""
    number: int
    """Viewer's number for the call, which the response repeats."""
    encoding: str
    body: bytes
    """Arguments in this encoding."""


_decode = msgspec.json.Decoder(ViewerFrame).decode


def received(frame: str | bytes) -> ViewerFrame | Call:
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
        raise ValueError("the binary frame is not a service call")
    _, service, number, length = _CALL_HEAD.unpack_from(frame)
    content = frame[_CALL_HEAD.size :]
    return Call(service, number, content[:length].decode(errors="replace"), content[length:])


def response(call: Call, body: bytes) -> bytes:
    """Return the binary frame that answers a service call with the result `body`."""
    name = call.encoding.encode()
    return _CALL_HEAD.pack(RESPONSE, call.service, call.number, len(name)) + name + body


def failure(request: ViewerFrame | Call, why: str) -> str:
    """Return the text frame that refuses a request or a call with the reason."""
    if isinstance(request, Call):
        return text("serviceCallFailure", serviceId=request.service, callId=request.number, message=why)
    return status(ERROR, why)


def values(parameters: Sequence[ViewerParameter], number: str | None) -> str:
    """Return the text frame with the values of parameters; `number` repeats the `id` of the request."""
    return text("parameterValues", parameters=parameters, **({"id": number} if number else {}))


def text(operation: str, **fields: object) -> str:
    """Return a text frame to a viewer: JSON with the operation as `op`, and the fields."""
    return msgspec.json.encode({"op": operation, **fields}).decode()


def status(level: int, message: str) -> str:
    """Return a text frame whose message a viewer shows to its user; `level` is WARNING or ERROR."""
    return text("status", level=level, message=message)
