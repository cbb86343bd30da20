"""`dxlrun fleet`: shows several robots of the network in one table, and starts and stops them."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated
from urllib.parse import quote

from cyclopts import Parameter

from dxlrun import DxlrunError, InputError
from dxlrun.tooling.output import print_error, show_json, show_parts
from dxlrun.tooling.verbs import DebugFlag, JsonFlag

if TYPE_CHECKING:
    from dxlrun_fleet.fleet_file import Fleet

_START_S = 300.0
"""Timeout from a robot's start to its first connection, s. Ten robots that start together on a small computer
take minutes; a robot that cannot listen exits before."""
_POLL_S = 0.2
Names = Annotated[tuple[str, ...], Parameter(negative=(), show_default=False, consume_multiple=True)]


def fleet(
    file: Path,
    /,
    *,
    start: Names = (),
    stop: Names = (),
    serve: str | None = None,
    as_json: JsonFlag = False,
    debug: DebugFlag = False,
) -> int:
    """Show the robots of a file in one live table, or start and stop them.

    q or Ctrl-C ends the table. In a pipe or with --json, the table is printed once. Needs certificates of
    `dxlrun keys`. Exit code: 0, or 1 if a robot is unreachable, or was not started or stopped.

    Parameters
    ----------
    file
        Fleet file: the robots, their addresses, and the agents that start them.
    start
        Robots that their agents start. Needs the role admin.
    stop
        Robots to stop by their policy on_exit. Needs the role command.
    serve
        Name of the agent to run on this computer. It starts the robots that the file assigns to it, when
        `--start` requests them. Robots continue when the agent exits.
    """
    from dxlrun.tooling.live import client_context
    from dxlrun_fleet.fleet_file import read_fleet

    found = read_fleet(file)
    if serve is not None:
        return _serve(found, serve)
    client_context()  # A problem with the certificates affects all robots, so report it once
    found.require_robots((*start, *stop))
    if start or stop:
        return _change(found, start, stop, as_json=as_json)
    return _view(found, as_json=as_json)


def _serve(fleet: Fleet, name: str) -> int:
    if name not in fleet.agents:
        raise InputError(
            f"the fleet file has no agent {name}; its agents: {', '.join(fleet.agents) or 'none'}"
        )
    import asyncio

    from dxlrun_fleet.agent import serve_agent

    agent = fleet.agents[name]
    for robot, words in agent.starts.items():
        if not (fleet.directory / words[0]).is_file():
            raise InputError(
                f"robot file {fleet.directory / words[0]} of {robot} not found; correct it under `starts`"
            )
    show_parts(f"{agent.address} starts {', '.join(agent.starts)}; Ctrl-C ends the agent, not the robots")
    try:
        asyncio.run(serve_agent(agent, fleet.directory))
    except KeyboardInterrupt:
        return 0
    except OSError as error:
        raise DxlrunError(f"{agent.address} cannot listen: {error.strerror or error}") from error
    return 0


def _change(fleet: Fleet, start: tuple[str, ...], stop: tuple[str, ...], *, as_json: bool) -> int:
    """Start and stop robots in parallel, and print the result of each; return 1 if any failed, else 0."""
    work = {
        **{name: partial(_start, fleet) for name in start},
        **{name: partial(_stop, fleet) for name in stop},
    }

    def done(name: str, act: Callable[[str], str]) -> dict[str, object]:
        try:
            return {"robot": name, "done": True, "text": act(name)}
        except (DxlrunError, OSError, ValueError) as error:
            return {"robot": name, "done": False, "text": f"{name}: {error}"}

    with ThreadPoolExecutor(len(work)) as threads:
        rows = list(threads.map(done, work, work.values()))
    failures = [str(row["text"]) for row in rows if not row["done"]]
    code = 1 if failures else 0
    if as_json:
        show_json(rows, code=code, errors=failures)
    for row in () if as_json else rows:
        (show_parts if row["done"] else print_error)(str(row["text"]))
    return code


def _start(fleet: Fleet, name: str) -> str:
    """Request a robot's start from its agent; when the robot accepts connections, return a sentence.

    Raises:
        DxlrunError: The agent refused, the run ended, or the robot accepted no connection in _START_S.
    """
    from dxlrun.tooling.live import NetworkLink
    from dxlrun_fleet.agent import START

    robot, path = NetworkLink(fleet.robots[name], "dxlrun fleet"), START + quote(name)
    with closing(NetworkLink(fleet.agent_of(name).address, "dxlrun fleet")) as agent:
        status, text = agent.exchange("POST", path, None)
        until = time.monotonic() + _START_S
        while status == 200:
            if robot.alive:
                return f"{name} is running"
            if time.monotonic() > until:
                raise DxlrunError(
                    f"started, but {fleet.robots[name]} accepts no connection; "
                    "check --listen in the fleet file"
                )
            time.sleep(_POLL_S)
            status, text = agent.exchange("GET", path, None)
    raise DxlrunError(text.decode(errors="replace"))


def _stop(fleet: Fleet, name: str) -> str:
    from dxlrun import RemoteRobot
    from dxlrun.tooling.live import NetworkLink

    with RemoteRobot(name, NetworkLink(fleet.robots[name], "dxlrun fleet")) as robot:
        robot.info()  # To a client, an unreachable robot counts as stopped
        robot.stop()
    return f"{name} has ended"


def _view(fleet: Fleet, *, as_json: bool) -> int:
    from dxlrun.tooling.output import show_live
    from dxlrun_fleet.fleet_view import LOOK_S, SILENT_S, RobotView, fleet_table

    with ExitStack() as ends:
        views = [
            ends.enter_context(closing(RobotView(name, address))) for name, address in fleet.robots.items()
        ]
        if sys.stdout.isatty() and not as_json:
            show_live(lambda: fleet_table([view.seen() for view in views]), LOOK_S / 2)
            return 0
        until = time.monotonic() + SILENT_S
        for view in views:
            view.tried.wait(max(0.0, until - time.monotonic()))
        rows = [view.seen() for view in views]
    failures = [f"{row.robot} is unreachable: {row.reason}" for row in rows if row.state == "unreachable"]
    code = 1 if failures else 0
    if as_json:
        show_json(rows, code=code, errors=failures)
    else:
        show_parts(fleet_table(rows))
    return code
