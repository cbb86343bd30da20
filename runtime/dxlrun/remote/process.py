"""The gateway's process: plug-ins, a socket, and the link to the loop; ends when its line does."""

from __future__ import annotations

import asyncio
import os
import signal
import socket
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress

import msgspec
import uvicorn

from dxlrun import process
from dxlrun.compile.plan import Plan, from_json
from dxlrun.control.plugins import load_plugins
from dxlrun.errors import DxlrunError
from dxlrun.remote.gateway import Gateway
from dxlrun.remote.job import GatewayJob
from dxlrun.remote.link import Link
from dxlrun.remote.preparation import Preparation
from dxlrun.remote.sockets import listen

NICENESS = 10
"""The robot comes first: a busy gateway gets what loop, guardian and recorder leave over."""
MOST_CONNECTIONS = 64


class _Server(uvicorn.Server):
    """Leaves signals alone: the terminal's process tells us when to end."""

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Capture none."""
        yield


async def serve(link: Link, gateway: Gateway, listener: socket.socket, control: socket.socket) -> None:
    """Serve until the other end of `control` is closed."""
    config = uvicorn.Config(
        gateway.app(),
        log_level="critical",
        access_log=False,
        lifespan="off",
        limit_concurrency=MOST_CONNECTIONS,
        timeout_keep_alive=30,
        timeout_graceful_shutdown=1,
        ws="none",
        h11_max_incomplete_event_size=16384,
    )
    server = _Server(config)

    def hung_up() -> None:
        with suppress(OSError):
            if control.recv(4096):
                return
        server.should_exit = True

    asyncio.get_running_loop().add_reader(control.fileno(), hung_up)
    watching = asyncio.create_task(link.watch())
    try:
        await server.serve(sockets=[listener])
    finally:
        watching.cancel()


def main() -> None:
    """Run the gateway's process: `--job-fd N --control-fd M`."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with suppress(OSError):
        os.nice(NICENESS)
    job = msgspec.json.decode(process.whole(int(sys.argv[2])), type=GatewayJob)
    control = socket.socket(fileno=int(sys.argv[4]))
    line = process.Line(control)
    plan: Plan = from_json(process.whole(job.plan))
    try:
        link = Link(plan, job.memory)
        joints = tuple(joint.name for joint in plan.loop.joints)
        gateway = Gateway(link, Preparation(joints, load_plugins()), job.log)
        listener, path = listen(plan.robot)
    except (DxlrunError, OSError) as error:
        line.send({"error": str(error)})
        sys.exit(1)
    line.send({"socket": str(path)})
    try:
        asyncio.run(serve(link, gateway, listener, control))
    finally:
        path.unlink(missing_ok=True)
