"""WebSocket server of `dxlrun foxglove`, with access control.

A viewer presents the token of the address. If it sends the web page that it belongs to (Origin, as every
browser does), this page must be an allowed one. A connection without a token is closed after five seconds,
and only few of these are open at a time.
"""

from __future__ import annotations

import asyncio
import logging
import secrets
import ssl
import traceback
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from http import HTTPStatus
from typing import Any
from urllib.parse import parse_qs, urlsplit

from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response
from websockets.typing import Origin, Subprotocol

from dxlrun import DxlrunError, InputError
from dxlrun.tooling.live import Listener
from dxlrun_foxglove import protocol
from dxlrun_foxglove.protocol import ERROR, Call, Subscription, ViewerFrame, status, text
from dxlrun_foxglove.viewed_run import ENCODING, HALT, ViewedRun, advertised, advertised_services
from dxlrun_foxglove.viewer import MOST_REQUESTS, Channel, Viewer

MOST_VIEWERS = 8
OPENING_S = 5.0  # Time for TLS and WebSocket handshakes
PING_S = 10.0
"""Interval between pings; a viewer that does not answer for twice as long is disconnected."""
MOST_BYTES = 1 << 16
"""Largest frame that a viewer may send, bytes."""
GOING_AWAY, TRY_AGAIN = 1001, 1013  # Close codes of RFC 6455 and its IANA registry: run ended, no run
ONLY_SHOWN = "the server is read-only; start `dxlrun foxglove --control` to change the robot"
_SILENT = logging.Logger("dxlrun foxglove", logging.CRITICAL)


class FoxgloveServer:
    """Server that shows one robot to viewers. It connects to the robot's current run while viewers exist."""

    def __init__(self, name: str, origins: Sequence[str], *, control: bool = False) -> None:
        """Create a server.

        Args:
            name: Name of the robot.
            origins: Web pages that may connect.
            control: Allow viewers to change parameters and to call services.
        """
        self.name, self.control = name, control
        self.token = secrets.token_urlsafe(16)
        self._origins = [None, *map(Origin, origins)]
        self._viewers: set[Viewer] = set()
        self._run: ViewedRun | None = None
        self._following: asyncio.Task[None] | None = None
        self._beginning = asyncio.Lock()

    async def accept_viewers(self, listener: Listener, tls: ssl.SSLContext | None = None) -> Server:
        """Start accepting viewers at a listening socket; return the running WebSocket server."""
        # Enough threads that no request waits for another.
        workers = ThreadPoolExecutor(2 * MOST_VIEWERS * MOST_REQUESTS)
        asyncio.get_running_loop().set_default_executor(workers)
        self._listener = listener
        more: dict[str, Any] = {"ssl": tls, "ssl_handshake_timeout": OPENING_S} if tls else {}
        return await serve(
            self._served,
            sock=listener,
            origins=self._origins,
            subprotocols=[Subprotocol(one) for one in protocol.SUBPROTOCOLS],
            process_request=self._let_in,
            compression=None,
            server_header=None,
            open_timeout=OPENING_S,
            ping_interval=PING_S,
            ping_timeout=2 * PING_S,
            close_timeout=1,
            max_size=MOST_BYTES,
            logger=_SILENT,
            **more,
        )

    # Access

    def _let_in(self, connection: ServerConnection, request: Request) -> Response | None:
        """Return the HTTP refusal of a connection without the token or beyond MOST_VIEWERS, else None. The
        library checks the origin."""
        given = parse_qs(urlsplit(request.path).query).get("token", [""])[0]
        # A constant-time comparison does not reveal a partly correct token.
        if not secrets.compare_digest(given.encode(), self.token.encode()):
            why = "invalid token; open the address printed by `dxlrun foxglove`\n"
            return connection.respond(HTTPStatus.UNAUTHORIZED, why)
        if len(self._viewers) >= MOST_VIEWERS:
            why = f"{MOST_VIEWERS} viewers are connected already; close one\n"
            return connection.respond(HTTPStatus.SERVICE_UNAVAILABLE, why)
        return None

    async def _served(self, connection: ServerConnection) -> None:
        """Serve a viewer until it disconnects or the run ends. The last viewer ends the link to the run."""
        self._listener.admit(connection.remote_address)
        viewer = Viewer(connection)
        self._viewers.add(viewer)
        sending = asyncio.create_task(viewer.send_queued())
        try:
            run = await self._begun()
            self._greet(viewer, run)
            run.viewers.add(viewer)
            async for frame in connection:
                self._process_frame(viewer, run, frame)
        except DxlrunError as error:
            await connection.close(TRY_AGAIN, str(error)[:100])
        except ConnectionClosed:
            pass
        finally:
            self._viewers.discard(viewer)
            if self._run is not None:
                self._run.viewers.discard(viewer)
            for task in (sending, *viewer.requests):
                task.cancel()
            if not self._viewers and self._following is not None:
                self._following.cancel()
                self._run = self._following = None

    # Run

    async def _begun(self) -> ViewedRun:
        """Return the run that viewers see; the first viewer connects to it.

        Raises:
            DxlrunError: The robot does not run.
        """
        async with self._beginning:
            if self._run is None:
                run = await asyncio.to_thread(ViewedRun, self.name)
                run.on_changed = partial(self._tell_parameters, run)
                self._run, self._following = run, asyncio.create_task(self._follow(run))
            return self._run

    async def _follow(self, run: ViewedRun) -> None:
        """Forward a run's messages; close the connections when it has ended. Viewers then reconnect."""
        try:
            why = await run.forward_messages()
        # Without this handler viewers would show stale data as if the robot still ran.
        except Exception as error:
            traceback.print_exc()
            why = f"{type(error).__name__}: {error}"
        if self._run is run:
            self._run = self._following = None
        for viewer in tuple(run.viewers):
            with suppress(ConnectionClosed):
                await viewer.connection.close(GOING_AWAY, why[:100])

    def _greet(self, viewer: Viewer, run: ViewedRun) -> None:
        can = ["parameters", "parametersSubscribe", "connectionGraph"]
        viewer.reply(
            text(
                "serverInfo",
                name=self.name,
                capabilities=[*can, "services"] if self.control else can,
                supportedEncodings=[ENCODING],
                metadata={"robot": self.name},
                sessionId=str(run.header.epoch_offset_ns),
            )
        )
        viewer.reply(advertised(run.channels))
        if self.control:
            viewer.reply(advertised_services())

    # Requests

    def _process_frame(self, viewer: Viewer, run: ViewedRun, frame: str | bytes) -> None:
        """Process a frame from a viewer. The viewer gets an error status for an invalid frame."""
        try:
            received = protocol.received(frame)
        except ValueError as error:
            viewer.reply(status(ERROR, f"invalid frame: {error}"))
            return
        if isinstance(received, Call):
            self._ask(viewer, run, received)
            return
        match received.op:
            case "subscribe":
                channels = {one.number: one for one in run.channels}
                for one in received.subscriptions:
                    _subscribe(viewer, one, channels.get(one.channel_id))
            case "unsubscribe":
                ended = received.subscription_ids
                kept = {channel: one for channel, one in viewer.subscriptions.items() if one not in ended}
                viewer.subscriptions = kept
            case "subscribeConnectionGraph":
                viewer.graph = True
                viewer.reply(run.graph)
            case "unsubscribeConnectionGraph":
                viewer.graph = False
            case "unsubscribeParameterUpdates":
                viewer.parameters -= set(received.parameter_names or viewer.parameters)
            case _:
                self._ask(viewer, run, received)

    def _ask(self, viewer: Viewer, run: ViewedRun, request: ViewerFrame | Call) -> None:
        """Start a task that sends a request to the robot and answers it, so that messages continue. A request
        is refused while the viewer has MOST_REQUESTS unanswered, a halt while it has twice as many."""
        halts = isinstance(request, Call) and request.service == HALT
        if len(viewer.requests) >= MOST_REQUESTS * (1 + halts):
            viewer.reply(protocol.failure(request, "too many requests at once; wait for earlier answers"))
            return
        task = asyncio.create_task(self._answer_request(viewer, run, request))
        viewer.requests.add(task)
        task.add_done_callback(viewer.requests.discard)

    async def _answer_request(self, viewer: Viewer, run: ViewedRun, request: ViewerFrame | Call) -> None:
        try:
            if not self.control and (isinstance(request, Call) or request.op == "setParameters"):
                raise InputError(ONLY_SHOWN)
            if isinstance(request, Call):
                viewer.reply(protocol.response(request, await asyncio.to_thread(run.call, request)))
                return
            names = request.parameter_names
            if request.op == "setParameters":
                await asyncio.to_thread(run.set_parameters, request.parameters)
                names = [one.name for one in request.parameters]
            found = await asyncio.to_thread(run.parameters, names)
            if request.op == "subscribeParameterUpdates":
                viewer.parameters |= {one.name for one in found}
            else:
                viewer.reply(protocol.values(found, request.id))
        except DxlrunError as error:
            viewer.reply(protocol.failure(request, str(error)))

    def _tell_parameters(self, run: ViewedRun, controller: str) -> None:
        """Send a controller's parameters after a change to the viewers that subscribed to them."""
        for viewer in run.viewers:
            names = [one for one in viewer.parameters if one.startswith(f"{controller}.")]
            if names:
                self._ask(viewer, run, ViewerFrame("getParameters", parameter_names=names))


def _subscribe(viewer: Viewer, one: Subscription, channel: Channel | None) -> None:
    known = viewer.subscriptions
    if channel is None or one.channel_id in known or one.id in known.values():
        why = f"channel {one.channel_id} does not exist, or this subscription exists already"
        viewer.reply(status(ERROR, why))
        return
    known[one.channel_id] = one.id
    if channel.latched and channel.newest is not None:
        viewer.queue_message(channel, *channel.newest)
