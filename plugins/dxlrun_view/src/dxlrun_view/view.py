"""`dxlrun view`: a running robot, or a log, on a page in the browser."""

from __future__ import annotations

import os
import signal
import sys
import threading
import webbrowser
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from dxlrun import DxlrunError, InputError, running
from dxlrun.tooling.files import suggestion
from dxlrun.tooling.output import leave_real_time, print_warning, progress_bar, show_parts

if TYPE_CHECKING:
    from types import FrameType

    from dxlrun_view.shown import ViewSource


def view(
    what: Annotated[str | None, Parameter(name="robot")] = None,
    /,
    *,
    control: Annotated[bool, Parameter(negative="")] = False,
    browser: bool = True,
    listen: str = "127.0.0.1",
) -> int:
    """Show a running robot, or a log, on a page in the browser: 3-D, curves, joints, controllers.

    Parameters
    ----------
    what
        Name of a running robot, its robot file, or a log (.mcap, or a directory of parts). Default: the only
        running robot.
    control
        Allow viewers to steer the robot: a slider for each joint, and buttons. STOP is always available.
    browser
        Open the page in a browser. A page for other computers is not opened.
    listen
        Address to listen at: HOST:PORT, HOST or :PORT. Beyond this computer, robot and browser authenticate
        with certificates of `dxlrun keys`. The role of the browser decides whether it may steer. Default
        port: 8765, or a free one if that is in use.
    """
    from dxlrun.tooling.live import ListenAddress, in_url

    place = ListenAddress.parse(listen)
    leave_real_time()
    from dxlrun.tooling.live import server_context
    from dxlrun_view.page_server import PORT, Page, hosts_of, scheme_of, server_of

    source = _source(what)
    try:
        # Beyond this computer, a browser must use the name in the robot's certificate.
        names = () if place.is_loopback else (source.describe_page().info.robot,)
        tls = server_context(*names) if names else None
        with place.listener(PORT, tls) as listener:
            address, taken = listener.getsockname()[:2]
            page = Page(source, listener, hosts=hosts_of(place.host, taken, *names), control=control)
            host = names[0] if names else in_url(address)
            url = f"{scheme_of(listener)}://{host}:{taken}/?token={page.token}"
            server = server_of(page)

            def request_exit(number: int, frame: FrameType | None) -> None:
                server.should_exit = True

            signal.signal(signal.SIGINT, request_exit)
            signal.signal(signal.SIGTERM, request_exit)
            robot = source.describe_page().info.robot
            show_parts(f"{robot}: {url}", "Ctrl-C ends the page. A robot in another terminal continues.")
            sys.stdout.flush()
            if browser and not names:
                threading.Thread(target=_open, args=(url,), daemon=True).start()
            server.run(sockets=[listener])
    finally:
        source.close()
    return 0


def _source(what: str | None) -> ViewSource:
    """Open the robot or log that the argument of `dxlrun view` names, by default the only running robot.
    Raises DxlrunError if it does not run, does not exist or is ambiguous."""
    from dxlrun_view.live_robot import LiveRobot

    if what is None:
        names = running()
        if not names:
            raise DxlrunError("no robot is running; start one with `dxlrun ROBOT.yaml`, or name a log")
        if len(names) > 1:
            raise InputError(f"several robots run; name one: {', '.join(names)}")
        return LiveRobot(names[0])
    path = Path(what)
    if path.suffix == ".mcap" or path.is_dir():
        from dxlrun_view.recorded_robot import RecordedRobot

        if not path.exists():
            raise InputError(f"log {path} not found; a run prints the path of its log when it ends")
        with progress_bar(hidden=False) as draw:
            return RecordedRobot(path, lambda share: draw(f"reading {path.name}", share))
    if path.suffix in (".yaml", ".yml"):
        from dxlrun.tooling.robots import read_robot

        name = read_robot(path, {}).robot.name
        if name not in running():
            raise DxlrunError(f"{name} of {path} is not running; start it in another terminal: dxlrun {path}")
        return LiveRobot(name)
    if what not in running():
        raise InputError(f"robot {what} is not running; {suggestion(what, running())}")
    return LiveRobot(what)


def _open(url: str) -> None:
    """Open the page's address in a browser, or print a warning if that is not possible."""
    # Without a display, webbrowser would start a text browser in this terminal.
    if not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")) or not webbrowser.open(url):
        print_warning("no browser could be opened; open the address yourself")
