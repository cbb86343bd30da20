"""A robot on virtual time whose client is driven through the gateway's own handlers, in one process."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from tests.kit.wire import all_writes

from dxlrun import RemoteRobot
from dxlrun.channels.answers import Completion
from dxlrun.channels.commands import CommandMessage, QueueInbox
from dxlrun.control.controllers.plugin_loading import load_plugins
from dxlrun.plan.robot_plan import Plan
from dxlrun.remote.gateway import GatewayApp
from dxlrun.remote.link import LoadedController
from dxlrun.remote.preparation import Preparation
from dxlrun.remote.requests.request_table import Role
from dxlrun.testing import simulated_robot
from dxlsim.bus.ledger import LedgerEntry

MS = 1_000_000


class _Loop:
    """The gateway's end of a loop in the same process: what it posts is taken in this cycle."""

    def __init__(self, virtual: Any, inbox: QueueInbox) -> None:
        self.plan, self._robot, self._inbox = virtual.plan, virtual, inbox
        loop = self.plan.loop
        self.rate, self.paused, self.number = 1e9 / loop.period_ns, False, 0
        self.heartbeat = SimpleNamespace(cycles=0, skipped=0)
        self.controllers = {
            one.name: LoadedController(one, place) for place, one in enumerate(loop.controllers)
        }

    def active(self, loaded: LoadedController) -> bool:
        return bool(self._robot.record.active >> loaded.place & 1)

    def newest(self) -> Any:
        return self._robot.record

    @property
    def began_ns(self) -> int:
        record = self.newest()
        return int(record.woken_ns) - record.cycle * self.plan.loop.period_ns

    def set_point(self, loaded: LoadedController, *rest: Any) -> None:
        self.number += 1
        self._inbox.waiting.append(CommandMessage(self.number, loaded.plan.name, *rest))

    async def command(
        self, name: str, kind: str, data: bytes, origin: str, *, request: bytes = b""
    ) -> Completion:
        self.set_point(self.controllers[name], kind, data, origin, 0, request)
        return Completion(self._robot.record.cycle)


async def asgi_request(
    app: Any,
    method: str,
    path: str,
    body: bytes = b"",
    *,
    headers: Iterable[tuple[str, bytes]] = (),
    chunks: Iterable[Mapping[str, Any]] | None = None,
    client: tuple[str, Role] = ("process 1", Role.ADMIN),
    heard: list[int] | None = None,
) -> tuple[int, dict[bytes, bytes], bytes]:
    """Request something by ASGI; return status, headers and content.

    Args:
        chunks: Messages that come from the client instead of a body.
        heard: Gets a number for each message that is awaited.
    """
    path, _, query = path.partition("?")
    scope = {
        "type": "http",
        "http_version": "1.1",
        "method": method,
        "scheme": "http",
        "path": path,
        "raw_path": path.encode(),
        "query_string": query.encode(),
        "root_path": "",
        "headers": [(name.encode(), value) for name, value in headers],
        "client": client,
        "server": None,
    }
    coming = iter([{"type": "http.request", "body": body}] if chunks is None else chunks)
    said: list[dict[str, Any]] = []

    async def receive() -> Mapping[str, Any]:
        if heard is not None:
            heard.append(1)
        chunk = next(coming, None)
        if chunk is None:
            await asyncio.Event().wait()
        assert chunk is not None
        return chunk

    async def send(message: dict[str, Any]) -> None:
        said.append(message)

    await app(scope, receive, send)
    content = b"".join(message.get("body", b"") for message in said[1:])
    return said[0]["status"], dict(said[0]["headers"]), content


class _Gateway:
    """A RobotLink of one process: each request is an ASGI call."""

    alive = True

    def __init__(self, app: Any) -> None:
        self._app, self._asyncio = app, asyncio.new_event_loop()

    def exchange(self, method: str, path: str, body: bytes | None) -> tuple[int, bytes]:
        asked = asgi_request(self._app, method, path, body or b"")
        status, _, content = self._asyncio.run_until_complete(asked)
        return status, content

    def stream(self, path: str) -> Any:
        raise NotImplementedError(path)

    def ends(self) -> bool:
        return True

    def close(self) -> None:
        self._asyncio.close()


class DrivenRobot(QueueInbox):
    """A robot file on virtual time, whose client does something each 20 ms."""

    def __init__(self, robot: Path, duration_s: float, arguments: Mapping[str, str]) -> None:
        super().__init__()
        self.virtual = simulated_robot(robot, arguments=arguments, duration_s=duration_s)
        self.virtual.robot.loop.steering.inbox = self
        loop = self.virtual.plan.loop
        preparation = Preparation(
            {joint.name: joint for joint in loop.joints}, load_plugins(), groups=self.virtual.plan.groups
        )
        link: Any = _Loop(self.virtual, self)
        self._gateway = GatewayApp(link, preparation, None)
        self._tick: Callable[[float], object] = lambda now: None
        self._due_ns = 0

    def drain_commands(self) -> Sequence[CommandMessage]:
        now_ns = self.virtual.clock.now_ns()
        if now_ns >= self._due_ns:
            self._due_ns = now_ns + 20 * MS
            self._tick(now_ns * 1e-9)
        return super().drain_commands()

    def run(self, begin: Callable[[RemoteRobot], Callable[[float], object]]) -> None:
        """Run; `begin` gets the client in the first cycle, and returns what is called from then on."""
        with RemoteRobot("driven", _Gateway(self._gateway.app())) as robot:

            def first(now: float) -> None:
                self._tick = begin(robot)

            self._tick = first
            result = self.virtual.run()
        assert (result.reason, result.detail) == ("ended", ""), result
        refused = {number: one for number, one in self.answers.items() if not isinstance(one, Completion)}
        assert not refused, refused


def changes(
    entries: Iterable[LedgerEntry], plan: Plan, address: int, size: int = 4
) -> dict[int, list[tuple[float, int]]]:
    """Return what was written into an item, by servo ID: time (s) and value, as often as it changed."""
    kept = tuple(entries)
    found: dict[int, list[tuple[float, int]]] = {}
    for bus in plan.buses:
        own = [entry for entry in kept if entry.bus == bus.name]
        for t_ns, servo, begin, data in all_writes(own, bus):
            if begin <= address and address + size <= begin + len(data):
                value = int.from_bytes(data[address - begin :][:size], "little", signed=True)
                known = found.setdefault(servo, [])
                if not known or known[-1][1] != value:
                    known.append((t_ns * 1e-9, value))
    return found
