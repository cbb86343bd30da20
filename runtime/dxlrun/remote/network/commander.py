"""Commander: the one client that commands the robot, for as long as it goes on, and what a client may do."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

from dxlrun.channels.answers import Code
from dxlrun.remote.preparation import refused
from dxlrun.remote.requests.table import HALT, STOP, TAKE_OVER, Answer, Body, Request, Role

LEASE_S = 5.0
"""A client that sends no command for so long commands no longer; another may then."""
HERE = "this computer"
"""All clients on the robot's own computer together: they may command side by side."""


class Client(NamedTuple):
    """The other end of a connection; where HTTP has host and port, so it comes along with each request."""

    name: str
    """`process N` of this computer, or `client NAME` with the name in a certificate."""
    role: Role

    @property
    def commands_as(self) -> str:
        """Return as what it commands."""
        return HERE if self.name.startswith("process ") else self.name

    def require_role(self, request: Request[Body, Answer]) -> None:
        """Raise RefusedRequest when its role does not allow a request."""
        if self.role < request.role:
            needed, role = request.role.name.lower(), self.role.name.lower()
            raise refused(Code.NOT_ALLOWED, {"client": self.name, "role": role, "needed": needed})


@dataclass(slots=True)
class Commander:
    """Lets one client command at a time; stop and halt are not its business, nor is what changes nothing."""

    now: Callable[[], float]
    """Returns the time, s."""
    name: str = HERE
    _until: float = field(default=-1.0, init=False)

    def admit(self, client: Client, request: Request[Body, Answer]) -> str | None:
        """Return the client's predecessor when it begins to command with this request.

        Raises RefusedRequest when another client commands.
        """
        if request.method == "GET" or request in (HALT, STOP, TAKE_OVER):
            return None
        if client.commands_as != self.name and self.now() < self._until:
            raise refused(Code.COMMANDED_BY, {"commander": self.name, "seconds": LEASE_S})
        return self.become(client)

    def become(self, client: Client) -> str | None:
        """Make a client the commander, whether or not another one is; return that, None when it was."""
        before, self.name = self.name, client.commands_as
        self._until = self.now() + LEASE_S
        return before if before != self.name else None
