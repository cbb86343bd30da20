"""A viewer after the public text of foxglove.websocket.v1: it knows nothing of dxlrun."""

from __future__ import annotations

import json
import ssl
import struct
from contextlib import ExitStack
from typing import Any

from tests.kit.awaited import DEADLINE_S, until
from websockets.sync.client import connect
from websockets.typing import Origin, Subprotocol

SUBPROTOCOL = "foxglove.websocket.v1"


class ForeignViewer:
    """One connection; frames are kept by what they are, in order."""

    def __init__(
        self,
        url: str,
        subprotocol: str = SUBPROTOCOL,
        origin: str | None = None,
        tls: ssl.SSLContext | None = None,
    ) -> None:
        self._opened = ExitStack()
        asked = connect(
            url,
            subprotocols=[Subprotocol(subprotocol)],
            origin=Origin(origin) if origin else None,
            compression=None,
            max_size=None,
            max_queue=None,
            ssl=tls,
            open_timeout=DEADLINE_S,
            close_timeout=DEADLINE_S,
        )
        self.socket = self._opened.enter_context(asked)
        self.channels: dict[str, dict[str, Any]] = {}
        self.services: dict[str, dict[str, Any]] = {}
        self.messages: list[tuple[str, int, bytes]] = []
        """Topic, time (ns), message."""
        self.responses: dict[int, Any] = {}
        self.failures: dict[int, str] = {}
        self.told: list[dict[str, Any]] = []
        """All other frames of text."""
        self._subscriptions: dict[int, str] = {}

    @property
    def first(self) -> str:
        """The operation of the first frame of text, which is taken here."""
        self.take()
        return str(self.told[0]["op"]) if self.told else "another"

    def __enter__(self) -> ForeignViewer:
        return self

    def __exit__(self, *_: object) -> None:
        self._opened.close()

    def say(self, **words: object) -> None:
        self.socket.send(json.dumps(words))

    def subscribe(self, *topics: str) -> None:
        rows = []
        for topic in topics:
            number = 100 + len(self._subscriptions)
            self._subscriptions[number] = topic
            rows.append({"id": number, "channelId": self.channels[topic]["id"]})
        self.say(op="subscribe", subscriptions=rows)

    def call(self, service: str, body: object, number: int, encoding: bytes = b"json") -> None:
        head = struct.pack("<BIII", 2, self.services[service]["id"], number, len(encoding))
        self.socket.send(head + encoding + json.dumps(body).encode())

    def take(self, timeout: float = DEADLINE_S) -> None:
        frame = self.socket.recv(timeout)
        if isinstance(frame, str):
            self._text(json.loads(frame))
        elif frame[0] == 1:
            subscription, time_ns = struct.unpack_from("<IQ", frame, 1)
            self.messages.append((self._subscriptions[subscription], time_ns, frame[13:]))
        elif frame[0] == 3:
            _, number, length = struct.unpack_from("<III", frame, 1)
            assert frame[13 : 13 + length] == b"json"
            self.responses[number] = json.loads(frame[13 + length :])
        else:
            raise AssertionError(frame)

    def _text(self, words: dict[str, Any]) -> None:
        match words["op"]:
            case "advertise":
                self.channels |= {one["topic"]: one for one in words["channels"]}
            case "advertiseServices":
                self.services |= {one["name"]: one for one in words["services"]}
            case "serviceCallFailure":
                self.failures[words["callId"]] = words["message"]
            case _:
                self.told.append(words)

    def until(self, found: Any) -> Any:
        """Take frames until something is found; return it."""
        return until(
            found, lambda: (self.told[-3:], self.failures, list(self.channels)), check=self.take, pause_s=0.0
        )

    def words(self, operation: str) -> dict[str, Any]:
        """Take frames until there is one of an operation; return the newest, and forget all of it."""
        found = self.until(lambda: [one for one in self.told if one["op"] == operation])
        self.told = [one for one in self.told if one["op"] != operation]
        return found[-1]
