"""Agent: starts robots on request of clients with the role admin, over mutual TLS.

It starts only the command lines of its own file: a request contains just a robot's name. Each run is a
separate process, which continues when the agent exits. Its output goes to NAME.out next to the file. This
output file is locked while a process of the run lives, so a robot runs only once, whichever agent started it.
"""

from __future__ import annotations

import asyncio
import fcntl
import os
import subprocess
import sys
from pathlib import Path
from urllib.parse import unquote

from starlette.responses import PlainTextResponse
from starlette.types import Receive, Scope, Send

from dxlrun.tooling.live import Listener, Role, serve_clients
from dxlrun_fleet.fleet_file import Agent

START = "/robots/"
"""Path prefix before a robot's name. POST starts the robot; GET returns 200 if it runs."""
_MAIN = ("-m", "dxlrun")
"""Arguments of Python that run the `dxlrun` command."""
_MOST_TOLD, _LINES_TOLD = 4096, 6  # Bytes and lines of a run's output in an answer


class AgentApp:
    """ASGI application of the agent: starts a robot on POST, and reports on GET whether its run lives.

    `directory` is that of the fleet file; runs are started in it, and their output files are in it.
    """

    def __init__(self, agent: Agent, directory: Path) -> None:
        self._agent, self._directory = agent, directory
        self._runs: list[subprocess.Popen[bytes]] = []

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one HTTP request with the status and text of `answer_request`, for the role of the
        client."""
        status, text = self.answer_request(scope["method"], unquote(scope["path"]), scope["client"].role)
        await PlainTextResponse(text, status)(scope, receive, send)

    def answer_request(self, method: str, path: str, role: Role) -> tuple[int, str]:
        """Execute a request; return HTTP status and text.

        200: the robot was started (POST) or runs (GET); 403: the client is not an admin; 404: the agent does
        not start this robot; 409: it ran before the POST; 410: it does not run, with its last output.
        """
        name = path.removeprefix(START)
        if role < Role.ADMIN:
            return 403, "only a client with the role admin may start robots"
        if method not in ("GET", "POST") or name not in self._agent.starts:
            return 404, f"the agent does not start {name}; it starts {', '.join(self._agent.starts)}"
        self._runs = [run for run in self._runs if run.poll() is None]
        path_out = self._directory / f"{name.replace('/', '_')}.out"
        with os.fdopen(os.open(path_out, os.O_RDWR | os.O_CREAT, 0o600), "r+b") as output:
            try:
                # The run inherits this file as its output, and with it the lock, which outlives the agent.
                fcntl.flock(output, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                return (409, "already running") if method == "POST" else (200, "running")
            if method == "GET":
                output.seek(max(0, os.fstat(output.fileno()).st_size - _MOST_TOLD))
                told = output.read().decode(errors="replace").split("\n")[output.tell() > _MOST_TOLD :]
                last = [line for line in told if line.strip()][-_LINES_TOLD:] or ["nothing"]
                return 410, "\n  ".join([f"not running; {path_out} ends with:", *last])
            output.truncate(0)
            self._runs.append(
                subprocess.Popen(
                    # -P keeps modules in the fleet's directory from shadowing installed ones.
                    [sys.executable, "-P", *_MAIN, *self._agent.starts[name]],
                    stdin=subprocess.DEVNULL,
                    stdout=output,
                    stderr=output,
                    cwd=self._directory,
                    # Ctrl-C at the agent's terminal must not stop the robot.
                    start_new_session=True,
                )
            )
        return 200, "started"


async def serve_agent(agent: Agent, directory: Path) -> None:
    """Run the agent of a fleet file, whose directory is given, until the process ends.

    Raises:
        InputError: The certificates are refused.
        OSError: The address cannot be used.
    """
    await serve_clients(Listener.secured(agent.address), AgentApp(agent, directory))
    await asyncio.Event().wait()
