"""Commander: the one client that may command the robot at a time, and the roles of clients."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

from dxlrun.channels.answers import Code
from dxlrun.remote.preparation import refused
from dxlrun.remote.requests.table import HALT, STOP, TAKE_OVER, Answer, Body, Request, Role

LEASE_S = 5.0
"""A client that sends no command for this time is no longer the commander; another client may command."""
HERE = "this computer"
"""Common commander name of all clients on the robot's own computer, which may command concurrently."""


class Client(NamedTuple):
    """Client of a connection. Takes the place of ASGI's (host, port), so every request carries it."""

    name: str
    """`process N` on this computer, or `client NAME` with the name in a certificate."""
    role: Role

    @property
    def commands_as(self) -> str:
        """Name under which the client commands."""
        return HERE if self.name.startswith("process ") else self.name

    def require_role(self, request: Request[Body, Answer]) -> None:
        """Raise RefusedRequest when the client's role does not allow a request."""
        if self.role < request.role:
            needed, role = request.role.name.lower(), self.role.name.lower()
            raise refused(Code.NOT_ALLOWED, {"client": self.name, "role": role, "needed": needed})


@dataclass(slots=True)
class Commander:
    """Admission of one commanding client at a time; GET, halt, stop and take-over are always admitted."""

    now: Callable[[], float]
    """Clock, s."""
    name: str = HERE
    _until: float = field(default=-1.0, init=False)

    def admit(self, client: Client, request: Request[Body, Answer]) -> str | None:
        """Return the previous commander when this request changes the commander, else None.

        Raises RefusedRequest when another client commands.
        """
        if request.method == "GET" or request in (HALT, STOP, TAKE_OVER):
            return None
        if client.commands_as != self.name and self.now() < self._until:
            raise refused(Code.COMMANDED_BY, {"commander": self.name, "seconds": LEASE_S})
        return self.become(client)

    def become(self, client: Client) -> str | None:
        """Make a client the commander, whoever is; return the previous commander, None without a change."""
        before, self.name = self.name, client.commands_as
        self._until = self.now() + LEASE_S
        return before if before != self.name else None
