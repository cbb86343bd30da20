"""Virtual link: a robot in virtual time that serves the client of a running robot."""

from __future__ import annotations

import asyncio
import itertools
import os
import selectors
import socket
import threading
from collections.abc import Callable, Sequence
from dataclasses import astuple
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from starlette.types import Message

from dxlrun.channels import heartbeat, mailbox, ring
from dxlrun.channels.cycle import MOST_CONTROLLERS, cycle_capacity
from dxlrun.channels.event_records import LONGEST_EVENT, Event
from dxlrun.channels.heartbeat import Heartbeat, Phase
from dxlrun.channels.mailbox import Mailbox
from dxlrun.channels.ring import Payload, RecordKind, RingWriter
from dxlrun.channels.tagged import decode
from dxlrun.channels.topic_messages import LEAST_CAPACITY, LONGEST_RECORD, OpenedTopic, TopicRecord
from dxlrun.errors import RunGone
from dxlrun.plan.robot_plan import Plan
from dxlrun.remote.gateway import GatewayApp
from dxlrun.remote.job import Descriptors
from dxlrun.remote.link import Link
from dxlrun.remote.preparation import Preparation
from dxlrun.remote.requests.request_table import Role
from dxlrun.run.virtual_run import VirtualRobot

PATIENCE = 10.0
"""Real time for a virtual second in which another process may work, s; the machine may be busy."""
_EVENTS_CAPACITY = 1 << 20
"""Size of the ring of events, bytes; small, because the gateway reads the events after each cycle."""


class VirtualLink:
    """Link to a robot in virtual time. Its loop runs in a thread, alternately with the client.

    `RemoteRobot(plan.robot, VirtualLink(plan))` is a client like any other. The gateway of a run replies, in
    the client's turn. Where the gateway would wait, the robot runs a cycle, so two runs are identical.

    Args:
        plan: Plan whose buses are simulated.
        log: Path of the log; None: no log.
        client: Name of the client for the log.
        each_cycle: Called with the number of each cycle, in the robot's turn, so that tests can inject
            faults.
    """

    def __init__(
        self,
        plan: Plan,
        *,
        log: Path | None = None,
        client: str = "client",
        each_cycle: Callable[[int], None] = lambda cycle: None,
    ) -> None:
        self.name = plan.robot
        self.each_cycle = each_cycle
        self._client = client.encode()
        self._cycles: list[bytes] = []
        self._events: list[Event] = []
        loop = plan.loop
        size = loop.layout.size
        memory = Descriptors(
            heartbeat=heartbeat.create(),
            cycles=ring.create("cycles", cycle_capacity(loop.period_ns, size), size),
            events=ring.create("events", _EVENTS_CAPACITY, LONGEST_EVENT),
            guardian=ring.create("guardian", _EVENTS_CAPACITY, LONGEST_EVENT),
            mailbox=mailbox.create(MOST_CONTROLLERS),
            answers=ring.create("answers", mailbox.ANSWERS_CAPACITY, mailbox.LONGEST_ANSWER),
            messages=ring.create("messages", LEAST_CAPACITY, LONGEST_RECORD),
        )
        self._heartbeat = Heartbeat(memory.heartbeat)
        messages = RingWriter(memory.messages)
        self._cycle_ring = RingWriter(memory.cycles)
        self._rings = {Event: RingWriter(memory.events), OpenedTopic: messages, TopicRecord: messages}
        inbox = Mailbox(memory.mailbox, RingWriter(memory.answers))
        self.simulated = VirtualRobot(plan, log=log, watch=self._watch, inbox=inbox)
        self.gateways_link = Link(plan, memory)
        for descriptor in astuple(memory):
            os.close(descriptor)
        preparation = Preparation.from_plan(plan)
        log_path = str(log) if log else None
        # One second per request, so that no rate limit applies.
        seconds = itertools.count()
        self._gateway = GatewayApp(self.gateways_link, preparation, log_path, lambda: next(seconds)).app()
        self._waiting = _VirtualTime(lambda: self.now_s, self.run_cycle)
        self._closing = False
        self._robots_turn, self._our_turn = threading.Semaphore(0), threading.Semaphore(0)
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()
        self._our_turn.acquire()
        if self._error is not None:
            raise self._error
        self._heartbeat.enter_phase(Phase.RUNNING)

    # The robot's turn

    def _run(self) -> None:
        try:
            self.simulated.run()
        # The exception is raised again in the client's turn.
        except BaseException as error:
            self._error = error
        finally:
            self._our_turn.release()

    def _watch(self, kind: RecordKind, payload: Payload) -> None:
        if kind is RecordKind.TAGGED:
            found = decode(payload)
            if type(found) in self._rings:
                self._rings[type(found)].append(kind, payload)
            if isinstance(found, Event):
                self._events.append(found)
        elif kind is RecordKind.CYCLE:
            self._cycle_ring.append(kind, payload)
            cycle = self.simulated.record.cycle
            # The record before the first cycle is not a cycle.
            if cycle < 0:
                return
            self._cycles.append(bytes(payload))
            self._heartbeat.cycle(self.simulated.cycles + 1, self.simulated.skipped)
            self.each_cycle(cycle)
            if not self._closing:
                self._our_turn.release()
                self._robots_turn.acquire()

    # The client's turn

    @property
    def now_s(self) -> float:
        """Time of the virtual run, s."""
        return self.simulated.clock.now_ns() * 1e-9

    def run_cycle(self) -> None:
        """Run a cycle of the robot, and pass its records to the gateway. Raises RunGone after the run."""
        if not self._thread.is_alive():
            result = self.simulated.result
            detail = str(self._error or (result.detail if result else ""))
            raise RunGone(f"the run of {self.name} ended{f': {detail}' if detail else ''}")
        self._robots_turn.release()
        self._our_turn.acquire()
        if self._error is not None or self.simulated.result is not None:
            self._thread.join()
        self.gateways_link.collect_messages()

    def new(self) -> tuple[NDArray[np.void], Sequence[Event]]:
        """Return the cycles and events since the last call."""
        cycles = np.frombuffer(b"".join(self._cycles), self.simulated.record.layout.dtype)
        events, self._cycles, self._events = self._events, [], []
        return cycles, events

    # Requests of the client

    def exchange(self, method: str, path: str, body: bytes | None) -> tuple[int, bytes]:
        """Pass a request to the gateway; raises RunGone if it needs a cycle after the end or `close`."""
        if self._waiting.is_closed():
            raise RunGone(f"the run of {self.name} ended: its link is closed")
        self.gateways_link.collect_messages()
        return self._waiting.run_until_complete(self._serve_request(method, path, body or b""))

    async def _serve_request(self, method: str, path: str, body: bytes) -> tuple[int, bytes]:
        path, _, query = path.partition("?")
        scope = {
            "type": "http",
            "method": method,
            "path": path,
            "query_string": query.encode(),
            "headers": [(b"x-dxlrun-client", self._client)],
            "client": ("process of the client", Role.ADMIN),
        }
        answer: list[Message] = []

        async def receive() -> Message:
            return {"type": "http.request", "body": body}

        async def send(message: Message) -> None:
            answer.append(message)

        await self._gateway(scope, receive, send)
        return answer[0]["status"], b"".join(message["body"] for message in answer[1:])

    def stream(self, path: str) -> tuple[int, bytes, socket.socket]:
        """Raise OSError. Streams are not supported, because messages would arrive only during a request."""
        raise OSError("a run on virtual time has no streams; read the messages from its log")

    @property
    def alive(self) -> bool:
        """True while the run continues."""
        return self._thread.is_alive()

    def ends(self) -> bool:
        """Return whether the run has ended."""
        return not self.alive

    def close(self) -> None:
        """End the run."""
        if self._thread.is_alive():
            self.simulated.stop.request()
            self._closing = True
            self._robots_turn.release()
            self._thread.join()
        self._waiting.close()


class _VirtualTime(asyncio.SelectorEventLoop):
    """Event loop in virtual time; `turn` replaces each wait that is not for another process."""

    def __init__(self, now_s: Callable[[], float], turn: Callable[[], None]) -> None:
        self._now_s = now_s
        self._turns = _Turns(turn)
        super().__init__(self._turns)

    def time(self) -> float:
        """Return virtual time, and the timeouts of other processes that did not answer, s."""
        return self._now_s() + self._turns.expired_s


class _Turns(selectors.SelectSelector):
    """Selector that waits only for other processes, and otherwise runs a turn."""

    def __init__(self, turn: Callable[[], None]) -> None:
        super().__init__()
        self._turn = turn
        self.expired_s = 0.0

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        """Return the ready descriptors, after a turn if the caller would wait.

        Virtual time stands still while another process prepares an answer. When that takes PATIENCE times the
        timeout, the timeout expires.
        """
        waits = timeout is None or timeout > 0
        if waits and len(self.get_map()) > 1:  # the pipe of the other process, and that of the event loop
            ready = super().select(None if timeout is None else PATIENCE * timeout)
            self.expired_s += 0.0 if ready or timeout is None else timeout
            return ready
        if waits:
            self._turn()
        return super().select(0)
