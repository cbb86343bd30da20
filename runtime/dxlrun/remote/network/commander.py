"""Commander: the one client that may command the robot at a time, and the roles that certificates give."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

from dxlrun.channels.answers import Code
from dxlrun.remote.preparation import refused
from dxlrun.remote.requests.request_table import HALT, STOP, TAKE_OVER, Answer, Body, Request, Role

LEASE_S = 5.0
"""Time, s, without a command after which a client is no longer the commander and another client may command.
"""
HERE = "this computer"
"""Name of the commander for all clients on the robot's own computer, which may command concurrently."""


class Client(NamedTuple):
    """A connected client. It takes the place of ASGI's `(host, port)`, so that every request carries it."""

    name: str
    """`process N` on this computer, or `client NAME` with the name in a certificate."""
    role: Role

    @property
    def commands_as(self) -> str:
        """Name of this client as commander: its own, or HERE for every client on the robot's computer."""
        return HERE if self.name.startswith("process ") else self.name

    def require_role(self, request: Request[Body, Answer]) -> None:
        """Raise RefusedRequest when the client's role is lower than the role that a request needs."""
        if self.role < request.role:
            needed, role = request.role.name.lower(), self.role.name.lower()
            raise refused(Code.NOT_ALLOWED, {"client": self.name, "role": role, "needed": needed})


@dataclass(slots=True)
class Commander:
    """Record of the present commander.

    Other clients may only read, halt, stop and take over until it is silent.
    """

    now: Callable[[], float]
    """Clock with the current time, s."""
    name: str = HERE
    _until: float = field(default=-1.0, init=False)

    def admit(self, client: Client, request: Request[Body, Answer]) -> str | None:
        """Return the previous commander's name when this request makes the client commander, else None.

        A request extends the commander's time by LEASE_S. Raises RefusedRequest while another client
        commands.
        """
        if request.method == "GET" or request in (HALT, STOP, TAKE_OVER):
            return None
        if client.commands_as != self.name and self.now() < self._until:
            raise refused(Code.COMMANDED_BY, {"commander": self.name, "seconds": LEASE_S})
        return self.become(client)

    def become(self, client: Client) -> str | None:
        """Make a client the commander for LEASE_S; return the name of the one before, None if it was the
        same.
        """
        before, self.name = self.name, client.commands_as
        self._until = self.now() + LEASE_S
        return before if before != self.name else None
