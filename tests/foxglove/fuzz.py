"""Fuzzed frames on the port of viewers: valid ones that command something, mutants of them, and noise."""

from __future__ import annotations

import base64
import json
import random
import socket
import struct
import threading
from collections.abc import Iterator
from contextlib import suppress
from urllib.parse import urlsplit

FRAMES_A_CONNECTION = 20_000
BATCH = 200
TEXT, BINARY = 1, 2
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


def frame(kind: int, data: bytes, *, final: int = 0x80) -> bytes:
    """Return a frame of a client (RFC 6455), masked by zeros."""
    size = len(data)
    length = struct.pack("!B", 0x80 | size) if size < 126 else struct.pack("!BH", 0xFE, size)
    return bytes([final | kind]) + length + bytes(4) + data


def mutated(data: bytes, draw: random.Random) -> bytes:
    """Return bytes that differ a little."""
    match draw.randrange(5):
        case 0:
            return data[: draw.randrange(len(data) + 1)]
        case 1:
            return data * draw.randrange(1, 5)
        case 2:
            return draw.randbytes(draw.randrange(60))
        case _:
            found = bytearray(data)
            for _ in range(draw.randrange(1, 4)):
                found[draw.randrange(len(found))] = draw.randrange(256)
            return bytes(found)


def fuzzed(draw: random.Random) -> bytes:
    """Return a frame: one in 2000 breaks the protocol below, so that its connection ends."""
    if not draw.randrange(2000):
        return draw.randbytes(draw.randrange(1, 30))
    text = bool(draw.randrange(2))
    data = json.dumps(draw.choice(SAID)).encode() if text else draw.choice(CALLS)
    if draw.randrange(3):
        data = mutated(data, draw)
    if text:
        data = data.decode(errors="replace").encode()
    return frame(TEXT if text else BINARY, data)


def connected(url: str) -> socket.socket:
    """Return a connection that has shown the token."""
    found = urlsplit(url)
    end = socket.create_connection((found.hostname, found.port), timeout=60)
    words = [
        f"GET {found.path}?{found.query} HTTP/1.1",
        f"Host: {found.netloc}",
        "Upgrade: websocket",
        "Connection: Upgrade",
        f"Sec-WebSocket-Key: {base64.b64encode(bytes(16)).decode()}",
        "Sec-WebSocket-Version: 13",
        "Sec-WebSocket-Protocol: foxglove.websocket.v1",
    ]
    end.sendall("\r\n".join([*words, "", ""]).encode())
    assert end.recv(12) == b"HTTP/1.1 101"
    return end


def fuzz(url: str, count: int, draw: random.Random) -> int:
    """Send so many frames, on as many connections as that takes; return how many those were."""
    sent, connections = 0, 0
    while sent < count:
        end = connected(url)
        connections += 1
        reader = threading.Thread(target=_drain, args=[end])
        reader.start()
        with suppress(OSError):  # it was closed for what broke the protocol
            for _ in range(0, min(FRAMES_A_CONNECTION, count - sent), BATCH):
                end.sendall(b"".join(fuzzed(draw) for _ in range(min(BATCH, count - sent))))
                sent += min(BATCH, count - sent)
            end.sendall(frame(8, b""))
        reader.join()
        end.close()
    return connections


def _drain(end: socket.socket) -> None:
    with suppress(OSError):
        while end.recv(1 << 20):
            pass


def knock(url: str, count: int, draw: random.Random) -> None:
    """Connect and send what is no handshake, or one without the token."""
    found = urlsplit(url)
    whole = f"GET /?token=x HTTP/1.1\r\nHost: {found.netloc}\r\nUpgrade: websocket\r\n\r\n".encode()
    for _ in range(count):
        with socket.create_connection((found.hostname, found.port), timeout=60) as end, suppress(OSError):
            end.sendall(mutated(whole, draw) if draw.randrange(3) else whole)
            end.shutdown(socket.SHUT_WR)
            answer = b"".join(iter(lambda: end.recv(4096), b""))
            assert b" 101 " not in answer[:20]


def half_open(url: str, count: int) -> Iterator[socket.socket]:
    """Yield connections that say nothing."""
    found = urlsplit(url)
    for _ in range(count):
        yield socket.create_connection((found.hostname, found.port), timeout=60)
