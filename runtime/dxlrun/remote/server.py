"""Server: the gateway's process and its connections, with a timeout for each and limits on their number.

A client may stop in the middle of a request, never read its reply, or open connections without end. A process
above its limit loses its own connection that was silent longest. A flood therefore closes no connection of
another process, whose `stop` is still served. The process ID comes from the Linux kernel (SO_PEERCRED,
unix(7)). Clients of other computers count by the name in their certificate; see `network/`.
"""

from __future__ import annotations

import asyncio
import ctypes
import math
import os
import selectors
import signal
import socket
import struct
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import partial

import h11
import msgspec
import uvicorn
from msgspec.json import Decoder
from starlette.types import ASGIApp
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.server import ServerState

from dxlrun.channels import child_processes
from dxlrun.channels.child_processes import Failed, Finish, Listening, MessageChannel
from dxlrun.errors import DxlrunError
from dxlrun.plan.robot_plan import Plan, from_json
from dxlrun.remote.computation import PR_SET_PDEATHSIG
from dxlrun.remote.gateway import GatewayApp
from dxlrun.remote.job import GatewayJob
from dxlrun.remote.link import Link
from dxlrun.remote.network.certificates import Certificate, counts
from dxlrun.remote.network.commander import Client
from dxlrun.remote.network.listener import Listener
from dxlrun.remote.preparation import Preparation
from dxlrun.remote.requests.request_table import Role
from dxlrun.remote.sockets import Address, create_listener

MOST_CONNECTIONS = 64
MOST_OF_PROCESS = 16
"""Upper limit of the connections of one process or certificate: three flooding ones leave a quarter to
others.
"""
SILENCE_S = 30.0
"""Timeout, s, of a connection on which the client neither sends a byte nor reads the pending reply."""
LONGEST_HEAD = 16384
"""Upper limit of a request's line and headers, bytes."""

_CREDENTIALS = struct.Struct("3i")


def main() -> None:
    """Run the gateway's process with the arguments `--job-fd N --control-fd M`, until its control socket
    closes.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    sys.stdout = sys.stderr = child_processes.LimitedTextStream(sys.stderr.fileno())
    # An endless `prepare` of a plug-in must not outlive the run.
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    job = msgspec.json.decode(child_processes.whole(int(sys.argv[2])), type=GatewayJob)
    control = socket.socket(fileno=int(sys.argv[4]))
    # The channel carries no message to the gateway, which ends when the socket closes.
    channel = MessageChannel(control, Decoder(Finish))
    plan: Plan = from_json(child_processes.whole(job.plan))
    try:
        link = Link(plan, job.memory, job.epoch_offset_ns)
        gateway = GatewayApp(link, Preparation.from_plan(plan), job.log)
        network = Listener.secured(Address.parse(job.listen, plan.robot)) if job.listen else None
        listener, path = create_listener(plan.robot)
    except (DxlrunError, OSError) as error:
        channel.send_message(Failed(str(error)))
        sys.exit(1)
    channel.send_message(Listening(str(path)))
    link.let_begin()
    try:
        with asyncio.Runner(loop_factory=_event_loop) as runner:
            runner.run(serve_gateway(link, gateway, listener, control, network))
    finally:
        path.unlink(missing_ok=True)


def _event_loop() -> asyncio.AbstractEventLoop:
    """Return an asyncio event loop with timeouts below 1 ms, which the default, epoll(7), rounds to 1 ms."""
    return asyncio.SelectorEventLoop(selectors.SelectSelector())


async def serve_gateway(
    link: Link,
    gateway: GatewayApp,
    listener: socket.socket,
    control: socket.socket,
    network: Listener | None = None,
) -> None:
    """Serve clients until the other end of `control` is closed or the task that reads the loop's reports
    fails.

    Raises the error of that task.
    """
    config = config_of(gateway.app())
    server = _Server(config)
    config.load()
    if network is not None:
        await serve_clients(network, config, server.server_state)

    def request_exit(*_: object) -> None:
        server.should_exit = True

    def hung_up() -> None:
        with suppress(OSError):
            if control.recv(4096):
                return
        request_exit()

    asyncio.get_running_loop().add_reader(control.fileno(), hung_up)
    watching = asyncio.create_task(link.collect_until_cancelled())
    watching.add_done_callback(request_exit)
    await server.serve(sockets=[listener])
    watching.cancel()
    with suppress(asyncio.CancelledError):
        await watching


async def serve_clients(
    listener: Listener, app: ASGIApp | uvicorn.Config, state: ServerState | None = None
) -> None:
    """Serve an application to clients of other computers from now on, each identified by its certificate.

    `scope["client"]` of a request has the name and the role of its client. Silent connections are closed, and
    excess connections of a client.

    Args:
        listener: A listener with TLS.
        app: The application, or the loaded configuration of a server that also serves it elsewhere.
        state: State of that server.
    """
    if isinstance(app, uvicorn.Config):
        config = app
    else:
        config = config_of(app)
        config.load()
    await listener.serve_connections(
        partial(Connection, config, state or ServerState(), {"listener": listener})
    )


def config_of(app: ASGIApp) -> uvicorn.Config:
    """Return the HTTP server's configuration, with the connection class and timeouts of this module."""
    return uvicorn.Config(
        app,
        http=Connection,
        ws="none",
        lifespan="off",
        log_config=None,
        log_level="critical",
        access_log=False,
        proxy_headers=False,
        server_header=False,
        backlog=MOST_CONNECTIONS,
        # The connection's own timeout must expire first.
        timeout_keep_alive=math.ceil(SILENCE_S) + 1,
        timeout_graceful_shutdown=1,
    )


class _Server(uvicorn.Server):
    """HTTP server without signal handlers: it stops when the supervisor closes the control socket."""

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Install no signal handlers."""
        yield


class _JoinedReplies(h11.Connection):
    """HTTP/1.1 codec that returns the head of a reply together with the first bytes of its body.

    uvicorn writes each on its own. The head alone would wake the client, which takes precedence over the
    gateway: on a busy machine, the body would follow some milliseconds later.
    """

    _head: tuple[bytes, ...] = ()

    def send_with_data_passthrough(self, event: h11.Event) -> list[bytes] | None:
        """Return the bytes of an event that are to be written now; None for the end of the connection."""
        data = super().send_with_data_passthrough(event)
        if data is None:
            return None
        joined, self._head = (*self._head, *data), ()
        if isinstance(event, h11.Response):
            self._head, joined = joined, ()
        return list(joined)


class Connection(H11Protocol):
    """HTTP/1.1 connection of a client, which is closed after a silence or when its process has too many."""

    def connection_made(  # type: ignore[override]  # uvicorn leaves its type open
        self, transport: asyncio.Transport
    ) -> None:
        """Accept a connection of this user or of a valid certificate, else close it; above the limits, close
        another.
        """
        super().connection_made(transport)
        self.conn = _JoinedReplies(h11.SERVER, LONGEST_HEAD)
        if listener := self.app_state.get("listener"):
            listener.admit(transport.get_extra_info("peername"))
        self.last_byte_s = self.loop.time()
        self._timer = self.loop.call_later(SILENCE_S, self._check)
        self._certificate = _certificate(transport)
        client = _client(transport, self._certificate)
        if client is None or not self._valid():
            transport.abort()
            return
        self.client = client
        crowded = self._crowded()
        if crowded:
            min(crowded, key=lambda one: (one.busy, one.last_byte_s)).transport.abort()

    def _crowded(self) -> list[Connection]:
        """Return the connections of which one must be closed because of this new one; empty within the
        limits.

        These are the connections of its process when that is above its limit, or those of the process with
        the
        most when all together are above the limit.
        """
        others = [
            one
            for one in self.connections
            if isinstance(one, Connection) and one is not self and not one.transport.is_closing()
        ]
        process = self.client
        counts = Counter(one.client for one in others)
        if counts[process] < MOST_OF_PROCESS:
            if len(others) < MOST_CONNECTIONS:
                return []
            ((process, _),) = counts.most_common(1)
        return [one for one in others if one.client == process]

    def connection_lost(self, exc: Exception | None) -> None:
        """Cancel the timer of silence, which would keep the closed connection in memory."""
        self._timer.cancel()
        self._unset_keepalive_if_required()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Process received bytes; close the connection once the client's certificate is invalid."""
        self.last_byte_s = self.loop.time()
        if self._valid():
            super().data_received(data)
        else:
            self.transport.abort()

    def _valid(self) -> bool:
        """Return True when the client's certificate has not expired or been revoked, or the client is on this
        computer.
        """
        return not self._certificate or counts(self._certificate)

    def resume_writing(self) -> None:
        """Continue to send a reply after the client has read a part."""
        self.last_byte_s = self.loop.time()
        super().resume_writing()

    @property
    def busy(self) -> bool:
        """True while a request is being answered."""
        return self.cycle is not None and not self.cycle.response_complete

    @property
    def listening(self) -> bool:
        """True while a reply is being sent, such as a stream of topics."""
        return self.cycle is not None and self.cycle.response_started and not self.cycle.response_complete

    def _check(self) -> None:
        """Close the connection when it was silent for SILENCE_S or its certificate is invalid, else set the
        timer.
        """
        if self.listening and not self.transport.get_write_buffer_size():
            self.last_byte_s = self.loop.time()
        silent_s = self.loop.time() - self.last_byte_s
        if silent_s >= SILENCE_S or not self._valid():
            # `close` would wait for a reader that may never read.
            self.transport.abort()
        else:
            self._timer = self.loop.call_later(SILENCE_S - silent_s + 0.01, self._check)


def _certificate(transport: asyncio.Transport) -> Certificate:
    """Return the certificate of a client that TLS verified; empty for a client on this computer."""
    secured = transport.get_extra_info("ssl_object")
    found: Certificate = {} if secured is None else secured.getpeercert()
    return found


def _client(transport: asyncio.Transport, certificate: Certificate) -> Client | None:
    """Return name and role of a client; None for another user, or a certificate without a known role."""
    if certificate:
        subject = dict(pair for pairs in certificate["subject"] for pair in pairs)
        role = subject.get("organizationalUnitName", "").upper()
        # The prefix keeps a certificate from posing as a process of this computer.
        name = f"client {subject.get('commonName', '')}"
        return Client(name, Role[role]) if role in Role.__members__ else None
    end = transport.get_extra_info("socket")
    process, user, _ = _CREDENTIALS.unpack(
        end.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
    )
    # Refuse other users, which the mode of the socket excludes as well.
    return Client(f"process {process}", Role.ADMIN) if user in (0, os.getuid()) else None
