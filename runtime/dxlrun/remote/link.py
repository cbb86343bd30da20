"""Link: the gateway's end of the loop: its mailbox, its answers, its newest cycle, its events."""

from __future__ import annotations

import asyncio
import itertools
from collections import deque
from contextlib import suppress
from dataclasses import dataclass, replace

import msgspec

from dxlrun.compile.plan import Plan
from dxlrun.control.loop_plan import ControllerPlan
from dxlrun.cycle import CycleLayout, CycleRecord
from dxlrun.events import Event, EventCode, decode_event
from dxlrun.heartbeat import Heartbeat
from dxlrun.inbox import LOOP, Command
from dxlrun.mailbox import Answers, MailboxWriter
from dxlrun.remote.job import Descriptors
from dxlrun.remote.preparation import Refusal
from dxlrun.ring import RingReader

ANSWER_S = 2.0
"""A loop that does not answer in this time is not asked any longer."""
_LOOK_S = 0.002
_KEPT_EVENTS = 1000


@dataclass(slots=True)
class Loaded:
    """A controller and its place: the bit by which the cycles show that it is active."""

    plan: ControllerPlan
    place: int
    held: bool = False


class Link:
    """What the gateway knows of the loop, and how it asks it; one asyncio loop, no threads."""

    def __init__(self, plan: Plan, memory: Descriptors) -> None:
        self.plan = plan
        self.rate = 1e9 / plan.loop.period_ns
        self.paused = False
        self.heartbeat = Heartbeat(memory.heartbeat)
        self.controllers = {one.name: Loaded(one, place) for place, one in enumerate(plan.loop.controllers)}
        self.events: deque[tuple[int, Event]] = deque(maxlen=_KEPT_EVENTS)
        self._cycles = RingReader(memory.cycles)
        joints = tuple(joint.name for joint in plan.loop.joints)
        layout = CycleLayout(joints, tuple(one.name for one in plan.loop.controllers))
        self._record = CycleRecord(layout)
        self._event_rings = [RingReader(memory.events), RingReader(memory.guardian_events)]
        self._mailbox = MailboxWriter(memory.mailbox)
        self._answers = Answers(memory.answers)
        self._numbers = itertools.count(1)
        self._event_numbers = itertools.count(1)
        self._waiting: dict[int, asyncio.Future[str]] = {}

    def newest(self) -> CycleRecord | None:
        """Return the newest cycle, None before the first; the memory is used again."""
        found = self._cycles.newest()
        if found is not None:
            self._record.raw[:] = found
        return self._record if self._record.woken_ns else None

    def active(self, loaded: Loaded) -> bool:
        """Say whether a controller is active in the newest cycle."""
        record = self.newest()
        return record is not None and bool(record.active >> loaded.place & 1)

    async def ask(self, controller: str, kind: str, data: bytes, origin: str) -> None:
        """Hand a command to the loop and wait for its answer; raises Refusal."""
        number = next(self._numbers)
        if not self._mailbox.post(Command(number, controller, kind, data, origin)):
            raise Refusal(429, "the loop's mailbox is full, or the command is too long for it; ask less")
        answer: asyncio.Future[str] = asyncio.get_running_loop().create_future()
        self._waiting[number] = answer
        try:
            refusal = await asyncio.wait_for(answer, ANSWER_S)
        except TimeoutError:
            raise Refusal(503, f"the loop did not answer within {ANSWER_S:g} s") from None
        finally:
            self._waiting.pop(number, None)
        if refusal:
            raise Refusal(409, refusal)

    async def ask_loop(self, kind: str, data: object, origin: str) -> None:
        """Ask the loop itself for something; raises Refusal."""
        await self.ask(LOOP, kind, b"" if data is None else msgspec.json.encode(data), origin)

    def set_point(self, loaded: Loaded, kind: str, data: bytes, origin: str, lease_ns: int) -> None:
        """Leave the newest set-point of a stream for the loop; raises Refusal."""
        command = Command(next(self._numbers), loaded.plan.name, kind, data, origin, lease_ns)
        if not self._mailbox.set_point(loaded.place, command):
            raise Refusal(413, "this command is too long for a stream; send it as a command")

    def load(self, plan: ControllerPlan) -> None:
        """Note a controller that the loop has loaded, in the place that the loop gave it."""
        taken = {one.place for one in self.controllers.values()}
        own = len(self.plan.loop.controllers)
        self.controllers[plan.name] = Loaded(plan, next(i for i in itertools.count(own) if i not in taken))

    async def watch(self) -> None:
        """Collect answers and events for ever."""
        while True:
            for number, refusal in self._answers.new():
                waiting = self._waiting.get(number)
                if waiting is not None and not waiting.done():
                    waiting.set_result(refusal)
            for ring in self._event_rings:
                self._collect(ring)
            await asyncio.sleep(_LOOK_S if self._waiting else 10 * _LOOK_S)

    def _collect(self, ring: RingReader) -> None:
        """Keep the new events of one process; a long text comes in pieces, one after the other."""
        while (record := ring.read()) is not None:
            if not isinstance(record, bytes):
                continue  # the log tells of a gap
            with suppress(ValueError):
                event = decode_event(record)
                if event.part and self.events:
                    number, before = self.events.pop()
                    self.events.append((number, replace(before, text=before.text + event.text)))
                else:
                    self._note(event)

    def _note(self, event: Event) -> None:
        self.events.append((next(self._event_numbers), event))
        loaded = self.controllers.get(event.source)
        if loaded is not None and event.code in (EventCode.STALE_COMMAND, EventCode.COMMAND):
            loaded.held = event.code == EventCode.STALE_COMMAND
