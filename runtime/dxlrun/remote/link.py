"""Link: the gateway's shared memory with the loop: mailbox, answers, newest cycle, events and topics."""

from __future__ import annotations

import asyncio
import itertools
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache

import msgspec

from dxlrun.channels.answers import Acceptance, Answer, Code, Completion, Refusal
from dxlrun.channels.commands import LONGEST_COMMAND, LOOP, OWN_ORIGIN, CommandMessage
from dxlrun.channels.cycle import CycleRecord
from dxlrun.channels.event_records import Event, EventCode
from dxlrun.channels.heartbeat import Heartbeat, Phase
from dxlrun.channels.mailbox import LONGEST_SET_POINT, Answers, MailboxWriter
from dxlrun.channels.ring import Gap, RecordKind, RingReader
from dxlrun.channels.tagged import decode
from dxlrun.contract.controller import Outcome
from dxlrun.control.controllers.goal_registry import GOALS_TOPIC
from dxlrun.messages.cdr import Codec
from dxlrun.plan.loop_plan import ControllerPlan, ServoLimit
from dxlrun.plan.robot_plan import Plan
from dxlrun.remote.goal_book import LOST, GoalBook
from dxlrun.remote.job import Descriptors
from dxlrun.remote.live.live_topics import LiveTopics, TopicStream
from dxlrun.remote.preparation import RefusedRequest
from dxlrun.remote.requests.replies import TopicState

ANSWER_S = 2.0
"""Timeout, s, of the loop's answer to a command; two periods of the loop are added."""
MOST_WAITING = 64
MOST_WAITING_BYTES = 2 * LONGEST_COMMAND
"""Limits of number and bytes of the commands without an answer. The rest of the mailbox is for `stop`."""
KEPT_EVENTS = 1000
KEPT_TEXT = 1 << 20
"""Upper limits of the stored events: number, and characters of their texts."""
LONGEST_DATA = LONGEST_COMMAND - 1024
"""Upper limit of a command's payload, bytes: the longest operation of the mailbox minus room for names."""
ENTER_S = 6.0
"""Timeout, s, after the loop replied that servos change their operating mode, or that a goal is planned. The
loop's own timeouts are 5 s, and a cycle is at most 1 s."""
# s; polling intervals while a command is pending, and otherwise. The rings have no wake-up.
_LOOK_S = 0.0005
_IDLE_LOOK_S = 0.02
_HELD = {
    EventCode.STALE_COMMAND: True,
    EventCode.COMMAND: False,
    EventCode.GOAL_ACCEPTED: False,
    EventCode.CONTROLLER_ACTIVATED: False,
    EventCode.CONTROLLER_DEACTIVATED: False,
}
"""Event about a controller -> new value of `LoadedController.held`."""


_codec = lru_cache(Codec)


@dataclass(slots=True)
class LoadedController:
    """A controller in the loop, as the gateway records it: plan, and index of its bit in a cycle record's
    `active` mask.
    """

    plan: ControllerPlan
    place: int
    held: bool = False


@dataclass(slots=True)
class _PendingCommand:
    """A command that was sent to the loop and is not answered yet."""

    size: int
    answer: asyncio.Future[Answer]
    done: Callable[[Completion], object] | None
    """Called with the loop's answer once the command is executed, even after the client stopped waiting."""


class Link:
    """The gateway's copy of the loop's state, and the sender of commands to the loop; one asyncio loop, no
    threads.
    """

    def __init__(self, plan: Plan, memory: Descriptors, epoch_offset_ns: int = 0) -> None:
        """`memory`: shared memory of the run; `epoch_offset_ns`: wall time minus the run's clock."""
        self.plan = plan
        self.rate = 1e9 / plan.loop.period_ns
        self.paused = False
        self._began_ns: int | None = None
        self.heartbeat = Heartbeat(memory.heartbeat)
        self.controllers = {
            one.name: LoadedController(one, place) for place, one in enumerate(plan.loop.controllers)
        }
        self.events: deque[tuple[int, Event]] = deque()
        self.topics = LiveTopics(
            memory.messages, memory.cycles, plan.loop.layout, self.events, epoch_offset_ns
        )
        self.goals = GoalBook()
        self._cycles = RingReader(memory.cycles)
        self._record = CycleRecord(plan.loop.layout)
        self._event_rings = (RingReader(memory.events), RingReader(memory.guardian))
        self._mailbox = MailboxWriter(memory.mailbox)
        self._answers = Answers(memory.answers)
        self._numbers = itertools.count(1)
        self._event_numbers = itertools.count(1)
        self._text = 0
        self._pending: dict[int, _PendingCommand] = {}
        self._pending_bytes = 0
        self._posted = asyncio.Event()
        """Set when a command is posted, whose answer must not wait for the end of an idle interval."""
        self.take_servo_limits: Callable[[str, tuple[ServoLimit, ...]], object] = lambda joint, limits: None
        """Called with a joint's name and the registers of its servo that limit it, which the loop reads at
        start-up.
        """

    def let_begin(self) -> None:
        """Resume the loop, which the supervisor started paused so that it does not move before a client can
        stop it.
        """
        if self._mailbox.used:
            self._mailbox.post_command(CommandMessage(0, LOOP, "resume", b"", OWN_ORIGIN))

    # State

    def newest(self) -> CycleRecord | None:
        """Return the record of the newest cycle; None before the first.

        The next call overwrites the returned record.
        """
        found = self._cycles.newest()
        if found is not None and len(found.payload) == len(self._record.raw):
            self._record.raw[:] = found.payload
            # No client can have changed the rate yet, so the period is that of the plan.
            if self._began_ns is None:
                self._began_ns = self._record.woken_ns - self._record.cycle * self.plan.loop.period_ns
        return self._record if self._record.woken_ns else None

    @property
    def began_ns(self) -> int | None:
        """Start time of the run's first cycle, ns of the run's clock; None before that cycle."""
        self.newest()
        return self._began_ns

    def active(self, loaded: LoadedController) -> bool:
        """Return whether a controller is active in the newest cycle."""
        record = self.newest()
        return record is not None and bool(record.active >> loaded.place & 1)

    @property
    def ended(self) -> bool:
        """True when the loop's process has reported that the run ended normally."""
        return self.heartbeat.phase is Phase.DONE

    def topic_states(self) -> list[TopicState]:
        """Return name, type, rate and count of each topic: those the loop sends, events, and those made from
        cycles.
        """
        self.newest()
        return self.topics.topic_states(max(0, self._cycles.passed - 1))

    def open_stream(self, topics: Sequence[str], *, newest: bool) -> TopicStream:
        """Return a stream of the messages of the named topics; raises RefusedRequest for an unknown topic."""
        known = [one.name for one in self.topic_states()]
        for topic in topics:
            if topic not in known:
                raise RefusedRequest(
                    Refusal(Code.UNKNOWN_TOPIC, {"topic": topic[:80], "topics": ", ".join(known)})
                )
        return TopicStream(self.topics, topics, newest=newest)

    # Commands

    async def command(
        self,
        controller: str,
        kind: str,
        data: bytes,
        origin: str,
        done: Callable[[Completion], object] | None = None,
        *,
        request: bytes = b"",
    ) -> Completion:
        """Send a command to the loop and wait until the loop has executed it.

        `stop` is accepted however many commands wait.

        Args:
            controller: Name of the controller, or LOOP.
            kind: Name of the command.
            data: Prepared payload.
            origin: Name of the client, for the log.
            done: Called when the loop has executed the command, even after the timeout of this wait.
            request: JSON from which `data` was prepared, for the log.

        Raises:
            RefusedRequest: The loop refused the command, did not answer, or the queue is full.
        """
        self._require_running()
        if len(data) > LONGEST_DATA:
            raise RefusedRequest(Refusal(Code.TOO_LONG, {"size": len(data), "most": LONGEST_DATA}))
        command = CommandMessage(next(self._numbers), controller, kind, data, origin, request=request)
        size = len(data) + len(request) + 1024
        stop = controller == LOOP and kind == "stop"
        full = len(self._pending) >= MOST_WAITING or self._pending_bytes + size > MOST_WAITING_BYTES
        if (full and not stop) or not self._mailbox.post_command(command):
            raise RefusedRequest(Refusal(Code.QUEUE_FULL))
        pending = _PendingCommand(size, asyncio.get_running_loop().create_future(), done)
        self._pending[command.number] = pending
        self._pending_bytes += size
        self._posted.set()
        answer = await self._await_answer(pending, ANSWER_S + min(2 / self.rate, ANSWER_S))
        while isinstance(answer, Acceptance):
            answer = await self._await_answer(pending, ENTER_S)
        if isinstance(answer, Refusal):
            raise RefusedRequest(answer)
        return answer

    async def for_loop(
        self, kind: str, data: object, origin: str, done: Callable[[Completion], object] | None = None
    ) -> Completion:
        """Send a command that is not for a controller, as JSON, and wait until the loop executed it; raises
        RefusedRequest.
        """
        return await self.command(
            LOOP, kind, b"" if data is None else msgspec.json.encode(data), origin, done
        )

    def set_point(  # noqa: PLR0917  a command's parts, as they come
        self,
        loaded: LoadedController,
        kind: str,
        data: bytes,
        origin: str,
        lease_ns: int,
        request: bytes = b"",
    ) -> None:
        """Put a controller's set-point into the mailbox in place of one that the loop has not read; no answer
        is awaited.

        Raises RefusedRequest when the run is ending, or the set-point is too long.
        """
        self._require_running()
        number = next(self._numbers)
        command = CommandMessage(number, loaded.plan.name, kind, data, origin, lease_ns, request)
        if not self._mailbox.set_point(loaded.place, command):
            hint = "send the values as a command"
            raise RefusedRequest(
                Refusal(Code.TOO_LONG, {"size": len(data), "most": LONGEST_SET_POINT, "hint": hint})
            )

    async def recorded(self, cycle: int) -> None:
        """Wait until the record of cycle `cycle`, or a later one, can be read, or the run is ending."""
        while self.heartbeat.phase is Phase.RUNNING:
            record = self.newest()
            if record is not None and record.cycle >= cycle:
                return
            await asyncio.sleep(_LOOK_S)

    def _require_running(self) -> None:
        if self.heartbeat.phase is not Phase.RUNNING:
            raise RefusedRequest(Refusal(Code.RUN_ENDING))

    async def _await_answer(self, pending: _PendingCommand, timeout_s: float) -> Answer:
        try:
            return await asyncio.wait_for(asyncio.shield(pending.answer), timeout_s)
        except TimeoutError:
            raise RefusedRequest(Refusal(Code.NO_ANSWER, {"seconds": timeout_s})) from None

    # Reports of the loop

    def loaded(self, plan: ControllerPlan, done: Completion) -> None:
        """Add a controller to `controllers` after the loop loaded it at the place that its answer names."""
        if done.place is not None:
            self.controllers[plan.name] = LoadedController(plan, done.place)

    def unloaded(self, name: str, _: Completion) -> None:
        """Remove a controller from `controllers` after the loop unloaded it."""
        self.controllers.pop(name, None)

    def note_rate(self, rate: float, _: Completion) -> None:
        """Store the loop's new rate, Hz, after the loop changed it."""
        self.rate = rate

    def note_paused(self, paused: bool, _: Completion) -> None:
        """Store that the loop was paused or resumed."""
        self.paused = paused

    async def collect_until_cancelled(self) -> None:
        """Poll the shared memory for answers, events and topics until the task is cancelled."""
        while True:
            if self._began_ns is None:
                self.newest()
            self.collect_messages()
            if self._pending:
                await asyncio.sleep(_LOOK_S)
                continue
            self._posted.clear()
            with suppress(TimeoutError):
                async with asyncio.timeout(_IDLE_LOOK_S):
                    await self._posted.wait()

    def collect_messages(self) -> None:
        """Read the new answers, events and goal reports; abort goals whose reports were lost."""
        for answered in self._answers.new():
            # Other answers belong to set-points of a stream, for which no client waits.
            if answered.number in self._pending:
                self._resolve(answered.number, answered.answer)
        reports = [one for one in self.topics.collect_messages() if one[0].name == GOALS_TOPIC]
        idle: frozenset[str] = frozenset()
        idle_s = 0.0
        for ring in self._event_rings:
            while (record := ring.read_record()) is not None:
                # The log reports the gap.
                if isinstance(record, Gap):
                    if ring is self._event_rings[0]:
                        # All earlier reports of the loop are still in its ring and are read below.
                        idle_s, idle = self._idle()
                # Packets and commands are for the log only.
                elif record.kind == RecordKind.TAGGED:
                    with suppress(ValueError):
                        found = decode(record.payload)
                        if isinstance(found, Event):
                            self._keep(found)
        for topic, message in reports:
            # Only the loop encodes these messages, so a malformed one is not a message of dxlrun.
            with suppress(ValueError):
                self.goals.take_message(_codec(topic.type).unpack(message.data), message.t_ns * 1e-9)
        for goal in [one for one in self.goals.running.values() if one.controller in idle]:
            if goal.accepted < idle_s:
                self.goals.record_end(goal.number, Outcome.ABORTED, LOST, idle_s)

    def _idle(self) -> tuple[float, frozenset[str]]:
        """Return the newest cycle's time, s, and the names of its inactive controllers, which cannot have a
        goal.
        """
        record = self.newest()
        idle = (one.plan.name for one in self.controllers.values() if not self.active(one))
        return (0.0, frozenset()) if record is None else (record.woken_ns * 1e-9, frozenset(idle))

    def _resolve(self, number: int, answer: Answer) -> None:
        pending = self._pending[number]
        if not pending.answer.done():
            pending.answer.set_result(answer)
        if isinstance(answer, Acceptance):
            pending.answer = pending.answer.get_loop().create_future()
            return
        del self._pending[number]
        self._pending_bytes -= pending.size
        if isinstance(answer, Completion) and pending.done is not None:
            pending.done(answer)

    def _keep(self, event: Event) -> None:
        """Store an event, drop the oldest beyond the limits, and update goals, servo limits, `paused` and
        `held` from it.
        """
        self._text += len(event.text)
        while self.events and (self._text > KEPT_TEXT or len(self.events) >= KEPT_EVENTS):
            self._text -= len(self.events.popleft()[1].text)
        self.events.append((next(self._event_numbers), event))
        self.goals.record_event(event)
        if event.code == EventCode.SERVO_LIMITS:
            limits = msgspec.json.decode(event.data, type=tuple[ServoLimit, ...])
            self.take_servo_limits(event.source, limits)
        if event.code == EventCode.STALE_COMMAND and event.source == "loop":
            self.paused = False
        loaded = self.controllers.get(event.source)
        if loaded is not None and event.code in _HELD:
            loaded.held = _HELD[EventCode(event.code)]
