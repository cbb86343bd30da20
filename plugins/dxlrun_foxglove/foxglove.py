"""`dxlrun foxglove`: WebSocket server that shows a running robot in Foxglove or Lichtblick."""

from __future__ import annotations

import asyncio
import os
import signal
import ssl
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated
from urllib.parse import quote

from cyclopts import Parameter

from dxlrun import InputError, connect
from dxlrun.tooling.output import leave_real_time, show_parts
from dxlrun.tooling.verbs import DebugFlag, Flag, RobotName

if TYPE_CHECKING:
    from dxlrun.tooling.live import Listener
    from dxlrun_foxglove.foxglove_server import FoxgloveServer

PORT = 8765  # Default port of Foxglove's WebSocket connections
NICENESS = 10
"""Niceness of this process, as of the gateway: viewers use only processor time that the robot leaves."""
APP = "https://app.foxglove.dev"
"""Origin of Foxglove's web viewer, the only web page that may connect without `--origin`."""


def foxglove(
    *,
    robot: RobotName = None,
    control: Flag = False,
    listen: str = "127.0.0.1",
    cert: Path | None = None,
    key: Path | None = None,
    origin: Annotated[tuple[str, ...], Parameter(negative=(), show_default=False)] = (),
    debug: DebugFlag = False,
) -> int:
    """Serve a running robot to Foxglove, Lichtblick and other viewers.

    Viewers get the channels of the log live, and the parameters of the controllers. The printed address
    contains a token, which is different at each start. A viewer without the token is refused.

    Parameters
    ----------
    control
        Allow viewers to steer the robot: change parameters, switch controllers and torque, and halt.
    listen
        Address to listen at: HOST:PORT, HOST or :PORT. Any host other than 127.0.0.1 needs `--cert`. Default
        port: 8765, or a free one if that is in use.
    cert
        Certificate of this computer for TLS, a PEM file.
    key
        Private key of the certificate, a PEM file. Default: the key in the file of `--cert`.
    origin
        Web page that may connect, such as http://localhost:8080 for your own Lichtblick. Can be given several
        times. The page of Foxglove may always connect.
    """
    from dxlrun.tooling.live import ListenAddress

    place = ListenAddress.parse(listen)
    if cert is None and key is not None:
        raise InputError(f"--key {key} has no certificate; add --cert FILE")
    if place.host != "127.0.0.1" and cert is None:
        raise InputError(f"--listen {listen} needs TLS; add --cert FILE --key FILE, or listen at 127.0.0.1")
    leave_real_time()
    try:
        from dxlrun_foxglove.foxglove_server import FoxgloveServer
    except ImportError as error:
        raise InputError("`dxlrun foxglove` needs websockets: pip install 'dxlrun[foxglove]'") from error
    with connect(robot, "dxlrun foxglove") as running:
        name = running.name
    served = FoxgloveServer(name, (APP, *origin), control=control)
    tls, listener = tls_of(cert, key), place.listener(PORT)
    with suppress(OSError):
        os.nice(NICENESS)
    asyncio.run(_serve(served, listener, tls))
    return 0


async def _serve(served: FoxgloveServer, listener: Listener, tls: ssl.SSLContext | None) -> None:
    """Accept viewers until Ctrl-C or SIGTERM. The address with its token is printed at the start."""
    ended = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, ended.set)
    from dxlrun.tooling.live import in_url

    async with await served.accept_viewers(listener, tls):
        host, taken = listener.getsockname()[:2]
        url = f"{'wss' if tls else 'ws'}://{in_url(host)}:{taken}/?token={served.token}"
        app = f"{APP}/~/view?ds=foxglove-websocket&ds.url={quote(url, safe='')}"
        show_parts(f"{served.name}: {url}", f"In a browser: {app}", "Ctrl-C ends the server, not the robot.")
        await ended.wait()


def tls_of(cert: Path | None, key: Path | None) -> ssl.SSLContext | None:
    """Return the server's TLS context, or None without a certificate. `key` defaults to the file of `cert`.

    Raises:
        InputError: The certificate or the key cannot be used.
    """
    if cert is None:
        return None
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    try:
        context.load_cert_chain(cert, key)
    except OSError as error:
        raise InputError(
            f"--cert {cert} with --key {key or cert} cannot be used: {error.strerror or error}; "
            "give a certificate and its private key as PEM files"
        ) from error
    return context
