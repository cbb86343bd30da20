"""The gateway's process: plug-ins, a socket, and the link to the loop; ends when its line does."""

from __future__ import annotations

import asyncio
import ctypes
import math
import signal
import socket
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress

import msgspec
import uvicorn
from msgspec.json import Decoder

from dxlrun.compile.plan import Plan, from_json
from dxlrun.control.controllers.plugins import load_plugins
from dxlrun.errors import DxlrunError
from dxlrun.remote.connection import MOST_CONNECTIONS, SILENCE_S, Connection
from dxlrun.remote.gateway import Gateway
from dxlrun.remote.job import GatewayJob
from dxlrun.remote.link import Link
from dxlrun.remote.preparation import Preparation
from dxlrun.remote.sockets import listen
from dxlrun.run.channels import process
from dxlrun.run.channels.process import Failed, Finish, Listening, MessageChannel

_PR_SET_PDEATHSIG = 1


class _Server(uvicorn.Server):
    """Leaves signals alone: the terminal's process tells us when to end."""

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Capture none."""
        yield


async def serve(link: Link, gateway: Gateway, listener: socket.socket, control: socket.socket) -> None:
    """Serve until the other end of `control` is closed, or the link fails, whose error is raised."""
    config = uvicorn.Config(
        gateway.app(),
        http=Connection,
        ws="none",
        lifespan="off",
        log_config=None,
        log_level="critical",
        access_log=False,
        proxy_headers=False,
        server_header=False,
        backlog=MOST_CONNECTIONS,
        timeout_keep_alive=math.ceil(SILENCE_S) + 1,  # the connection's own patience ends before
        timeout_graceful_shutdown=1,
        h11_max_incomplete_event_size=16384,
    )
    server = _Server(config)

    def end(*_: object) -> None:
        server.should_exit = True

    def hung_up() -> None:
        with suppress(OSError):
            if control.recv(4096):
                return
        end()

    asyncio.get_running_loop().add_reader(control.fileno(), hung_up)
    watching = asyncio.create_task(link.watch())
    watching.add_done_callback(end)
    await server.serve(sockets=[listener])
    watching.cancel()
    with suppress(asyncio.CancelledError):
        await watching


def main() -> None:
    """Run the gateway's process: `--job-fd N --control-fd M`."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    sys.stdout = sys.stderr = process.Printed(sys.stderr.fileno())
    # a plug-in's endless `prepare` must not outlive the run
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    job = msgspec.json.decode(process.whole(int(sys.argv[2])), type=GatewayJob)
    control = socket.socket(fileno=int(sys.argv[4]))
    channel = MessageChannel(
        control, Decoder(Finish)
    )  # nothing is sent to a gateway: it ends with the channel
    plan: Plan = from_json(process.whole(job.plan))
    try:
        link = Link(plan, job.memory)
        joints = {joint.name: joint for joint in plan.loop.joints}
        gateway = Gateway(link, Preparation(joints, load_plugins()), job.log)
        listener, path = listen(plan.robot)
    except (DxlrunError, OSError) as error:
        channel.send(Failed(str(error)))
        sys.exit(1)
    channel.send(Listening(str(path)))
    try:
        asyncio.run(serve(link, gateway, listener, control))
    finally:
        path.unlink(missing_ok=True)
