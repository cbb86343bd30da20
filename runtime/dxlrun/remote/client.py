"""Client: a running robot from Python.

    import dxlrun

    with dxlrun.connect() as robot:
        robot.send("head", "posvel", {"positions": [0.3, 0.0], "velocities": [1.0, 1.0]})

Only the standard library is needed on this side; one connection, one request at a time.
"""

from __future__ import annotations

import http.client
import json
import os
import socket
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from urllib.parse import quote

from dxlrun.errors import DxlrunError, Refused
from dxlrun.remote.sockets import SUFFIX, directory, running

__all__ = ["RemoteRobot", "Stream", "connect", "running"]

TIMEOUT_S = 10.0
"""How long an answer may take; the gateway answers within two seconds or so, whatever the loop does."""
LEASE_S = 0.2
_STOP_S = 30.0


class _Connection(http.client.HTTPConnection):
    """HTTP over a Unix socket."""

    def __init__(self, path: Path) -> None:
        super().__init__("localhost", timeout=TIMEOUT_S)
        self._path = path

    def connect(self) -> None:
        """Connect to the socket's path."""
        self.sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self.sock.settimeout(self.timeout)
        self.sock.connect(str(self._path))


def connect(robot: str | None = None, client: str | None = None) -> RemoteRobot:
    """Return a running robot, by its name; without one, the only one that runs.

    `client` names you in the robot's log. Raises DxlrunError when no such robot runs, or several do.
    """
    names = running()
    if robot is None and len(names) != 1:
        which = f"several robots run: {', '.join(names)}; name one" if names else "no robot runs; start one"
        raise DxlrunError(f"{which} (dxlrun ROBOT.yaml)" if not names else which)
    name = robot or names[0]
    if name not in names:
        found = f"; these run: {', '.join(names)}" if names else ""
        raise DxlrunError(f"no robot {name} runs{found}")
    return RemoteRobot(name, directory() / f"{name}{SUFFIX}", client or f"python {os.getpid()}")


class RemoteRobot:
    """A running robot. Everything raises Refused with the reason, and DxlrunError when the robot is gone."""

    def __init__(self, name: str, path: Path, client: str) -> None:
        self.name = name
        self._path = path
        self._connection = _Connection(path)
        self._headers = {"X-Dxlrun-Client": client, "Content-Type": "application/json"}

    def __enter__(self) -> RemoteRobot:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End the connection; the robot goes on."""
        self._connection.close()

    # Looking

    def info(self) -> dict[str, object]:
        """Return who it is: rate, controllers and what they take, cycles, log."""
        return self._get("/robot")

    def states(self) -> dict[str, object]:
        """Return the newest cycle: each joint's position (rad), velocity (rad/s), effort, age (s), goals."""
        return self._get("/states")

    def events(self, after: int = 0) -> dict[str, object]:
        """Return what happened since event number `after`, and the number of the last one."""
        return self._get(f"/events?after={after}")

    # Steering

    def send(self, controller: str, kind: str, command: Mapping[str, object]) -> None:
        """Give a controller a typed command; returns when the loop has taken it."""
        self._post(f"/controllers/{quote(controller)}/commands/{quote(kind)}", command)

    def stream(self, controller: str, kind: str, lease: float = LEASE_S) -> Stream:
        """Return a stream of set-points for a controller, of which the newest counts, for `lease` seconds."""
        return Stream(self, controller, kind, lease)

    def switch(self, activate: Sequence[str] = (), deactivate: Sequence[str] = ()) -> None:
        """Activate and deactivate controllers in one cycle, or not at all."""
        self._post("/switch", {"activate": list(activate), "deactivate": list(deactivate)})

    def rate(self, rate: float) -> None:
        """Let the loop run at another rate, Hz."""
        self._post("/rate", {"rate": rate})

    def pause(self) -> None:
        """Hold the joints; the controllers' time stands still."""
        self._post("/pause")

    def resume(self) -> None:
        """Let the controllers go on where they were."""
        self._post("/resume")

    def load(self, name: str, entry: Mapping[str, object]) -> None:
        """Load a controller into the paused loop; `entry` is written as in the robot file."""
        self._post("/controllers", {**entry, "name": name})

    def unload(self, name: str) -> None:
        """Take a controller that is not active out of the paused loop."""
        self._ask("DELETE", f"/controllers/{quote(name)}", None)

    def stop(self, wait: bool = True) -> None:
        """End the run in order; with `wait`, return when it has ended. Raises DxlrunError after 30 s."""
        self._post("/stop")
        self.close()
        until = time.monotonic() + _STOP_S
        while wait and self._path.exists():
            if time.monotonic() > until:
                raise DxlrunError(f"{self.name} did not end within {_STOP_S:g} s")
            time.sleep(0.05)

    # Inside

    def _get(self, path: str) -> dict[str, object]:
        return self._ask("GET", path, None)

    def _post(self, path: str, content: Mapping[str, object] | None = None) -> None:
        self._ask("POST", path, content)

    def _ask(self, method: str, path: str, content: Mapping[str, object] | None) -> dict[str, object]:
        body = None if content is None else json.dumps(content).encode()
        try:
            answer, status = self._exchange(method, path, body)
        except (http.client.HTTPException, OSError) as error:
            self.close()
            raise DxlrunError(
                f"{self.name} does not answer any more: {error or type(error).__name__}"
            ) from error
        if "refused" in answer or status >= 400:
            raise Refused(str(answer.get("refused", f"HTTP status {status}")))
        return answer

    def _exchange(self, method: str, path: str, body: bytes | None) -> tuple[dict[str, object], int]:
        try:
            return self._once(method, path, body)
        except (http.client.RemoteDisconnected, BrokenPipeError, ConnectionResetError):
            self.close()  # an idle connection is closed after a while: the next request begins another
            return self._once(method, path, body)

    def _once(self, method: str, path: str, body: bytes | None) -> tuple[dict[str, object], int]:
        self._connection.request(method, path, body, self._headers)
        response = self._connection.getresponse()
        answer = json.loads(response.read())
        return (answer if isinstance(answer, dict) else {}), response.status


class Stream:
    """Set-points for one controller; when they cease for longer than the lease, its joints are held."""

    def __init__(self, robot: RemoteRobot, controller: str, kind: str, lease: float) -> None:
        self._robot = robot
        self._path = f"/controllers/{quote(controller)}/set-points/{quote(kind)}?lease={lease:g}"

    def send(self, command: Mapping[str, object]) -> None:
        """Leave the newest set-point; returns before the loop has taken it."""
        self._robot._post(self._path, command)

    def __enter__(self) -> Stream:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Nothing is said: the lease runs out, and the joints are held."""
