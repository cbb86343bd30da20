"""Link: the gateway's end of the loop: its mailbox, its answers, its newest cycle, its events."""

from __future__ import annotations

import asyncio
import itertools
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass

import msgspec

from dxlrun.compile.plan import Plan
from dxlrun.control.loop_plan import ControllerPlan
from dxlrun.remote.job import Descriptors
from dxlrun.remote.preparation import Refusal
from dxlrun.run.channels.commands import LONGEST_COMMAND, LOOP, Command
from dxlrun.run.channels.cycle import CycleLayout, CycleRecord
from dxlrun.run.channels.events import Event, EventCode, decode_event
from dxlrun.run.channels.heartbeat import Heartbeat, Phase
from dxlrun.run.channels.mailbox import Answers, MailboxWriter
from dxlrun.run.channels.ring import Record, RecordKind, RingReader

ANSWER_S = 2.0
"""A loop that does not answer in this time, and two of its periods, is not waited for any longer."""
MOST_WAITING = 64
MOST_WAITING_BYTES = 2 * LONGEST_COMMAND
"""What may wait for the loop's answer; the rest of the mailbox is kept for `stop`."""
KEPT_EVENTS = 1000
KEPT_TEXT = 1 << 20
"""So many of the newest events are kept for clients, and so many characters of their texts."""
LONGEST_DATA = LONGEST_COMMAND - 1024
"""Bytes; what an operation of the mailbox has beside names."""
ENTER_S = 6.0
"""The loop gives joints five seconds to come into their modes."""
_LOOK_S = 0.002
_WAITS, _NOT_ACTIVATED = "waits until", "is not activated"
"""What the events of a controller say whose joints change their modes first, and of one that was given up."""
_HELD = {
    EventCode.STALE_COMMAND: True,
    EventCode.COMMAND: False,
    EventCode.CONTROLLER_ACTIVATED: False,
    EventCode.CONTROLLER_DEACTIVATED: False,
}
"""Events of a controller -> whether its joints are held afterwards because its stream ended."""


@dataclass(slots=True)
class Loaded:
    """A controller and its place: the bit by which the cycles show that it is active."""

    plan: ControllerPlan
    place: int
    held: bool = False
    switched: tuple[bool, int] | None = None
    """What a switch made of it, and how many cycles had ended then: their records do not show it yet."""
    entering: bool = False
    """A switch activates it when its joints are in their modes."""
    excuse: str = ""
    """Why the last switch that had to wait did not activate it."""


@dataclass(slots=True)
class _Asked:
    """A command whose answer is awaited."""

    size: int
    answer: asyncio.Future[str]
    done: Callable[[], object] | None
    """What the gateway knows anew when the loop has done it; also when nobody waits for the answer."""


class Link:
    """What the gateway knows of the loop, and how it asks it; one asyncio loop, no threads."""

    def __init__(self, plan: Plan, memory: Descriptors) -> None:
        self.plan = plan
        self.rate = 1e9 / plan.loop.period_ns
        self.paused = False
        self.heartbeat = Heartbeat(memory.heartbeat)
        self.controllers = {one.name: Loaded(one, place) for place, one in enumerate(plan.loop.controllers)}
        self.events: deque[tuple[int, Event]] = deque()
        self._cycles = RingReader(memory.cycles)
        joints = tuple(joint.name for joint in plan.loop.joints)
        layout = CycleLayout(joints, tuple(one.name for one in plan.loop.controllers))
        self._record = CycleRecord(layout)
        self._event_rings = (RingReader(memory.events), RingReader(memory.guardian))
        self._mailbox = MailboxWriter(memory.mailbox)
        self._answers = Answers(memory.answers)
        self._numbers = itertools.count(1)
        self._event_numbers = itertools.count(1)
        self._text = 0
        self._asked: dict[int, _Asked] = {}
        self._asked_bytes = 0

    # Looking

    def newest(self) -> CycleRecord | None:
        """Return the newest cycle, None before the first; the memory is used again."""
        found = self._cycles.newest()
        if found is not None and len(found.payload) == len(self._record.raw):
            self._record.raw[:] = found.payload
        return self._record if self._record.woken_ns else None

    def active(self, loaded: Loaded) -> bool:
        """Say whether a controller is active: by the newest cycle, or by a switch of the one that runs."""
        if loaded.switched is not None:
            active, ended = loaded.switched
            if self.heartbeat.cycles <= ended:
                return active
            loaded.switched = None
        record = self.newest()
        return record is not None and bool(record.active >> loaded.place & 1)

    # Asking

    async def ask(
        self,
        controller: str,
        kind: str,
        data: bytes,
        origin: str,
        done: Callable[[], object] | None = None,
    ) -> None:
        """Hand a command to the loop and wait for its answer; raises Refusal.

        `done` is called when the loop has done it, also when that is after the wait was given up. `stop` is
        taken however much waits already.
        """
        if self.heartbeat.phase is not Phase.RUNNING:
            raise Refusal(503, "the run is at its end")
        size = len(data) + 1024
        if len(data) > LONGEST_DATA:
            raise Refusal(413, f"{len(data)} bytes are too many for one command; send less at once")
        stop = controller == LOOP and kind == "stop"
        full = len(self._asked) >= MOST_WAITING or self._asked_bytes + size > MOST_WAITING_BYTES
        number = next(self._numbers)
        if (full and not stop) or not self._mailbox.post(Command(number, controller, kind, data, origin)):
            raise Refusal(429, "so much waits for the loop already that there is no room; ask less often")
        answer: asyncio.Future[str] = asyncio.get_running_loop().create_future()
        self._asked[number] = _Asked(size, answer, done)
        self._asked_bytes += size
        patience = ANSWER_S + min(2 / self.rate, ANSWER_S)
        try:
            refusal = await asyncio.wait_for(answer, patience)
        except TimeoutError:
            what = f"the loop did not answer within {patience:.1f} s; it may still do it"
            raise Refusal(503, what) from None
        if refusal:
            raise Refusal(409, refusal)

    async def ask_loop(
        self, kind: str, data: object, origin: str, done: Callable[[], object] | None = None
    ) -> None:
        """Ask the loop itself for something; raises Refusal."""
        await self.ask(LOOP, kind, b"" if data is None else msgspec.json.encode(data), origin, done)

    def set_point(self, loaded: Loaded, kind: str, data: bytes, origin: str, lease_ns: int) -> None:
        """Leave the newest set-point of a stream for the loop; raises Refusal."""
        if self.heartbeat.phase is not Phase.RUNNING:
            raise Refusal(503, "the run is at its end")
        command = Command(next(self._numbers), loaded.plan.name, kind, data, origin, lease_ns)
        if not self._mailbox.set_point(loaded.place, command):
            raise Refusal(413, "this command is too long for a stream; send it as a command")

    # What the loop did

    def switched(self, activate: Sequence[str], deactivate: Sequence[str]) -> None:
        """Note a switch that the loop has done; the record of its cycle is still to come."""
        for names, active in ((deactivate, False), (activate, True)):
            for name in names:
                if (loaded := self.controllers.get(name)) is not None:
                    loaded.switched = (active, self.heartbeat.cycles)
                    loaded.entering = loaded.entering and active

    async def entered(self, names: Sequence[str]) -> None:
        """Wait for controllers whose joints change their modes first; raises Refusal when they do not."""
        until = time.monotonic() + ENTER_S
        for loaded in [self.controllers[name] for name in names if name in self.controllers]:
            while loaded.entering:
                if self.heartbeat.phase is not Phase.RUNNING:
                    raise Refusal(503, "the run is at its end")
                if time.monotonic() > until:
                    raise Refusal(409, f"{loaded.plan.name} is not active after {ENTER_S:g} s")
                await asyncio.sleep(_LOOK_S)
            if loaded.excuse:
                raise Refusal(409, loaded.excuse)

    def loaded(self, plan: ControllerPlan) -> None:
        """Note a controller that the loop has loaded, in the place that the loop gave it."""
        taken = {one.place for one in self.controllers.values()}
        own = len(self.plan.loop.controllers)
        self.controllers[plan.name] = Loaded(plan, next(i for i in itertools.count(own) if i not in taken))

    async def watch(self) -> None:
        """Collect answers and events for ever."""
        while True:
            self.collect()
            await asyncio.sleep(_LOOK_S if self._asked else 10 * _LOOK_S)

    def collect(self) -> None:
        """Collect the answers and events that have come."""
        for number, refusal in self._answers.new():
            asked = self._asked.pop(number, None)
            if asked is None:
                continue  # a set-point of a stream
            self._asked_bytes -= asked.size
            if not refusal and asked.done is not None:
                asked.done()
            if not asked.answer.done():
                asked.answer.set_result(refusal)
        for ring in self._event_rings:
            while (record := ring.read()) is not None:
                # the log reports gaps; packets and commands are for it alone
                if isinstance(record, Record) and record.kind == RecordKind.EVENT:
                    with suppress(ValueError):
                        self._hear(decode_event(record.payload))

    def _hear(self, event: Event) -> None:
        """Keep an event, and note what it says of its controller."""
        self._text += len(event.text)
        while self.events and (self._text > KEPT_TEXT or len(self.events) >= KEPT_EVENTS):
            self._text -= len(self.events.popleft()[1].text)
        self.events.append((next(self._event_numbers), event))
        loaded = self.controllers.get(event.source)
        if loaded is not None:
            self._follow(loaded, event)

    def _follow(self, loaded: Loaded, event: Event) -> None:
        """Note what an event says of its controller."""
        if event.code in _HELD:
            loaded.held = _HELD[EventCode(event.code)]
        if event.code == EventCode.MODE and event.text.startswith(_WAITS):
            loaded.entering, loaded.excuse = True, ""
        elif event.code == EventCode.CONTROLLER_ACTIVATED:
            loaded.switched = (True, self.heartbeat.cycles)
            loaded.entering = False
        elif event.code == EventCode.COMMAND_REFUSED and _NOT_ACTIVATED in event.text:
            loaded.entering, loaded.excuse = False, event.text
