"""Fuzzed frames on the port of viewers: valid ones that command something, mutants of them, and noise."""

import json
import random
import socket
import struct
from contextlib import suppress
from urllib.parse import urlsplit

from tests.foxglove.foreign import ForeignViewer
from tests.kit.awaited import DEADLINE_S
from tests.kit.fuzzed_http import mutated
from websockets.exceptions import ConnectionClosed

SAID: tuple[dict[str, object], ...] = (
    {"op": "subscribe", "subscriptions": [{"id": 1, "channelId": 2}, {"id": 2, "channelId": 3}]},
    {"op": "unsubscribe", "subscriptionIds": [1, 2]},
    {"op": "getParameters", "parameterNames": ["left_arm.speed"], "id": "x"},
    {"op": "setParameters", "parameters": [{"name": "left_arm.speed", "value": 9.0}], "id": "x"},
    {"op": "subscribeParameterUpdates", "parameterNames": []},
    {"op": "unsubscribeParameterUpdates", "parameterNames": []},
    {"op": "subscribeConnectionGraph"},
    {"op": "unsubscribeConnectionGraph"},
    {"op": "advertise", "channels": [{"id": 1, "topic": "/commands", "encoding": "json", "schemaName": "x"}]},
    {"op": "fetchAsset", "uri": "file:///etc/passwd", "requestId": 1},
)
BODIES = (b"{}", b'{"deactivate": ["head"]}', b'{"joints": ["all"], "on": false, "release": true}')
CALLS = [
    struct.pack("<BIII", 2, service, 1, 4) + b"json" + body for service in range(3) for body in BODIES
] + [struct.pack("<BI", 1, 1) + b"{}"]


def fuzz(url: str, count: int, draw: random.Random) -> None:
    """Send so many frames; one in 2000 breaks WebSocket itself, so that its connection ends."""
    while count > 0:
        with ForeignViewer(url) as viewer, suppress(ConnectionClosed):
            while count > 0:
                count -= 1
                text = bool(draw.randrange(2))
                data = json.dumps(draw.choice(SAID)).encode() if text else draw.choice(CALLS)
                if draw.randrange(3):
                    data = mutated(data, draw)
                if not draw.randrange(2000):
                    viewer.socket.socket.sendall(draw.randbytes(draw.randrange(1, 30)))
                viewer.socket.send(data.decode(errors="replace") if text else data)


def knock(url: str, count: int, draw: random.Random) -> None:
    """Connect and send what is no handshake, or one without the token."""
    found = urlsplit(url)
    whole = f"GET /?token=x HTTP/1.1\r\nHost: {found.netloc}\r\nUpgrade: websocket\r\n\r\n".encode()
    for _ in range(count):
        with (
            socket.create_connection((found.hostname, found.port), timeout=DEADLINE_S) as end,
            suppress(OSError),
        ):
            end.sendall(mutated(whole, draw) if draw.randrange(3) else whole)
            end.shutdown(socket.SHUT_WR)
            answer = b"".join(iter(lambda: end.recv(4096), b""))
            assert b" 101 " not in answer[:20]
