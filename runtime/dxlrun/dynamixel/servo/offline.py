"""Offline servos of one bus: probed in idle time, checked as at the start, and taken back; reboots.

A servo returns in its desired mode and with its desired registers. It has torque only when it kept it, or
when the policy for returned servos gives it back after a reboot and the servo does not reboot repeatedly.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from dxlrun.description.modes import Mode
from dxlrun.dynamixel.control_table import control_table
from dxlrun.dynamixel.exchange.idle import IdleScheduler, Urgency
from dxlrun.dynamixel.plan.bus_plan import BusPlan, RegisterValue
from dxlrun.dynamixel.plan.planning import plan_line
from dxlrun.dynamixel.servo import modes, watchdog
from dxlrun.dynamixel.servo.checks import BusSurvey, inspect, inspect_states
from dxlrun.dynamixel.servo.desired import DesiredState
from dxlrun.dynamixel.servo.life import Life, Loss, ServoEvent
from dxlrun.dynamixel.servo.registers import settle
from dxlrun.dynamixel.servo.retry import retry
from dxlrun.dynamixel.wire.transaction import Outcome, Program, Reply, Transaction
from dxlrun.run.channels.events import EventCode, Severity

PROBE_NS = 1_000_000_000
"""An offline servo is probed once a second (failures.md)."""
FIRST_PROBE_NS = 200_000_000
"""The first time a little earlier: most losses are a loose plug or a boot, which is over by then."""
TICK_MODULUS_MS = 32_768
"""Realtime Tick counts milliseconds modulo this (e-Manual XM430-W350, Realtime Tick (120))."""
BLIND_NS = 16_000_000_000
"""After half a turn of the counter nothing shows whether it was less or more (protocol.md)."""
DRIFT = 0.02
"""The servo's clock may go so much faster or slower than the host's [i] (protocol.md)."""
SLACK_MS = 20.0
"""And a reading may be so far off, beside the time from request to reply [i] (protocol.md)."""
WITHIN_NS = 60_000_000_000
TOO_MANY_REBOOTS = 2
"""So many within a minute, and a servo gets no torque back in this run (failures.md)."""
_NOT_RECEIVED = frozenset((Outcome.TIMEOUT, Outcome.GARBLED))
_OTHER_TURN = (
    "lost count of its turns when it rebooted, so its goal would be turns away: it gets no torque again in "
    "this mode; start the run anew"
)


class _Reading(NamedTuple):
    tick: int
    middle_ns: int
    half_ms: float
    """The tick was read within this time around the middle."""


class RealtimeTicks:
    """Compares a servo's millisecond counter with the host's clock: a reboot sets it back to 0."""

    __slots__ = ("_last",)

    def __init__(self, servos: int) -> None:
        self._last: list[_Reading | None] = [None] * servos

    def rebooted(self, servo: int, reply: Reply) -> bool | None:
        """Take a reading of Realtime Tick; return whether the servo rebooted since the one before.

        None: there was none before, or it is too long ago to know.
        """
        half_ns = (reply.last_ns - reply.sent_ns) // 2
        now = _Reading(reply.word(), reply.sent_ns + half_ns, half_ns * 1e-6)
        before, self._last[servo] = self._last[servo], now
        if before is None or now.middle_ns - before.middle_ns > BLIND_NS:
            return None
        elapsed_ms = (now.middle_ns - before.middle_ns) * 1e-6
        half = TICK_MODULUS_MS / 2
        off = (now.tick - before.tick - elapsed_ms + half) % TICK_MODULUS_MS - half
        return abs(off) > DRIFT * elapsed_ms + SLACK_MS + now.half_ms + before.half_ms


class RebootCount:
    """Counts the reboots of each servo; after two within a minute it gets no torque back."""

    __slots__ = ("_times", "exhausted")

    def __init__(self, servos: int) -> None:
        self._times: list[deque[int]] = [deque(maxlen=TOO_MANY_REBOOTS) for _ in range(servos)]
        self.exhausted = [False] * servos
        """True for a servo that rebooted TOO_MANY_REBOOTS times within a minute, ever."""

    def add(self, servo: int, now_ns: int) -> bool:
        """Count a reboot; return whether it is the one too many."""
        times = self._times[servo]
        times.append(now_ns)
        if self.exhausted[servo] or len(times) < TOO_MANY_REBOOTS or now_ns - times[0] > WITHIN_NS:
            return False
        self.exhausted[servo] = True
        return True


@dataclass(frozen=True, slots=True)
class Rejoined:
    """What came of a servo that answers again."""

    problems: tuple[str, ...]
    """Why it may take no part, one sentence each."""
    torqued: bool
    """True when torque enable was read as 1."""
    written: tuple[tuple[str, str], ...]
    """Joint, and what was written into its registers."""
    mode: Mode = Mode.UNKNOWN
    """In which it is; UNKNOWN where there are problems."""


class Offline:
    """Probes the offline servos of one bus and takes them back."""

    __slots__ = ("_desired", "_idle", "_life", "_plan", "_reboots", "_tick_reads", "_ticks")

    def __init__(self, plan: BusPlan, idle: IdleScheduler, life: Life, desired: DesiredState) -> None:
        count = len(plan.servos)
        self._plan = plan
        self._idle = idle
        self._life = life
        self._desired = desired
        self._ticks = RealtimeTicks(count)
        self._reboots = RebootCount(count)
        self._tick_reads = [_tick_read(plan, index) for index in range(count)]

    def look(self) -> None:
        """Let the coming idle time probe the servos that are due; called while one is offline."""
        now = self._idle.now_ns()
        for index, loss in enumerate(self._life.losses):
            if loss is not None and not loss.probing and loss.probe_at_ns <= now:
                loss.probing = True
                name = f"the return of {self._plan.servos[index].joint}"
                self._idle.add(self._probe(index, loss), Urgency.REPAIR, name, index)

    def tick(self, index: int) -> Program[bool]:
        """Read a servo's Realtime Tick, if it has one; return whether it shows a reboot, which is counted."""
        read = self._tick_reads[index]
        return False if read is None else bool(self._judge_tick(index, (yield from retry(read))))

    def switch_off(self, index: int) -> None:
        """Switch the torque of a LATCHED servo off in the coming idle time."""
        name = f"torque off of {self._plan.label(self._plan.servos[index])}"
        self._idle.add(self._switch_off(index), Urgency.REPAIR, name, index)

    def _switch_off(self, index: int) -> Program[None]:
        """Switch a servo's torque off and read it back; where that fails, again when it is in order."""
        servo = self._plan.servos[index]
        for _ in range(3):
            yield plan_line(self._plan).write(servo.servo_id, servo.torque_address, b"\0")
            back = yield self._plan.torque_reads[index]
            if back.answered and back.parameters[0] == 0:
                return
        self._life.lose(index)

    def _probe(self, index: int, loss: Loss) -> Program[None]:
        """Ping a servo; when it answers, see what became of it and take it back."""
        reply = yield plan_line(self._plan).ping(self._plan.servos[index].servo_id)
        if reply.answered and (read := self._tick_reads[index]) is not None:
            reply = yield from retry(read)
        problem = ""
        if reply.outcome in _NOT_RECEIVED:
            if reply.outcome is Outcome.GARBLED:
                problem = "answers garbled or twice: do two servos have its ID? If not, check its cable"
        else:
            rejoined = yield from self._rejoin(index, reply)
            if self._life.losses[index] is not loss:
                return  # the line was gone meanwhile: it counts as lost anew, and the next probe decides
            if not rejoined.problems:
                self._take_back(index, loss, rejoined)
                return
            problem = f"answers again, but cannot take part: {'; '.join(rejoined.problems)}"
        if problem and problem != loss.problem:
            loss.problem = problem
            self._life.report(EventCode.SERVO_LOST, Severity.ERROR, index, problem)
        loss.probing, loss.probe_at_ns = False, self._idle.now_ns() + PROBE_NS

    def _rejoin(self, index: int, reply: Reply) -> Program[Rejoined]:
        """Bring a servo that answered to its desired state, with or without torque."""
        plan, servo = self._plan, self._plan.servos[index]
        if self._judge_tick(index, reply) is None:
            enabled = yield from retry(plan.torque_reads[index])
            loss = self._life.losses[index]
            if loss is not None and loss.had_torque and enabled.answered and not enabled.parameters[0]:
                self._count_reboot(index)
        yield from watchdog.disarm(plan, servo)
        torque, mode = self._may_get_torque(index), self._desired.mode(index)
        if torque and servo.continuous and servo.mode_plan(mode).goals[-1].position is not None:
            torque = False
            self._life.report(EventCode.SERVO_LIMP, Severity.ERROR, index, _OTHER_TURN)
        rejoined = yield from rejoin(plan, index, torque, mode, self._desired.registers(index))
        if not rejoined.problems and (problem := (yield from watchdog.arm(plan, servo))):
            rejoined = Rejoined((problem,), False, rejoined.written)
        return rejoined

    def _may_get_torque(self, index: int) -> bool:
        """Return whether the policy gives a servo torque back: once after a reboot, and not if latched."""
        loss = self._life.losses[index]
        if loss is None or loss.latched or self._reboots.exhausted[index]:
            return False
        return loss.rebooted and self._plan.servos[index].torque_on_return

    def _take_back(self, index: int, loss: Loss, rejoined: Rejoined) -> None:
        """Let a servo that is in order take part again."""
        life = self._life
        life.on(index, ServoEvent.RETURNED if rejoined.torqued else ServoEvent.RETURNED_LIMP)
        self._desired.returned(index, rejoined.mode)
        self._desired.report_written(rejoined.written)
        holds = rejoined.torqued and not loss.latched
        how = "holding where it stands" if holds else "limp: it gets no goals"
        life.report(EventCode.SERVO_BACK, Severity.INFO, index, f"is in order and takes part again, {how}")
        if loss.latched:
            life.on(index, ServoEvent.LATCH)
            if rejoined.torqued:
                self.switch_off(index)
        elif holds and not self._plan.split:
            # the next states of a split bus were requested without it: there its torque is read again first
            life.on(index, ServoEvent.TORQUE_ON)
        if not (rejoined.torqued or loss.limp_reported):
            life.report_limp(index, 0)

    def _judge_tick(self, index: int, reply: Reply) -> bool | None:
        """Judge a reply with Realtime Tick; None: it has none, or the one before is too long ago."""
        if self._tick_reads[index] is None or not reply.answered:
            return None
        rebooted = self._ticks.rebooted(index, reply)
        if rebooted:
            self._count_reboot(index)
        return rebooted

    def _count_reboot(self, index: int) -> None:
        loss = self._life.losses[index]
        if loss is not None:
            loss.rebooted, loss.had_torque = True, False
        text = "started anew: it was without power, or something rebooted it"
        self._life.report(EventCode.SERVO_REBOOTED, Severity.ERROR, index, text)
        if self._reboots.add(index, self._idle.now_ns()):
            text = "rebooted twice within a minute: it gets no torque again in this run; check its supply"
            self._life.report(EventCode.SERVO_REBOOTED, Severity.ERROR, index, text)


def rejoin(
    plan: BusPlan,
    servo_index: int,
    torque: bool,
    mode: Mode | None = None,
    registers: Sequence[RegisterValue] | None = None,
) -> Program[Rejoined]:
    """Take one servo back that was lost or was reset, as at the start: check, set registers, then hold it.

    `torque`: switch it on; without, a limp servo stays limp and gets no goal, as a goal may switch torque on
    (protocol.md), and one that still holds keeps its torque: were torque written to it, a reboot a moment ago
    would be a way to torque that no policy gave. `mode`: None is its first one. `registers`: None are those
    that the robot file declares; see `DesiredState`.
    """
    servo = plan.servos[servo_index]
    line, mode = plan_line(plan), servo.start_mode if mode is None else mode
    found = BusSurvey()
    if (yield from inspect(plan, servo, line, found, take_over=True)):
        yield from inspect_states(plan, [servo], line, found)
    if found.problems:
        return Rejoined(tuple(found.problems), False, ())
    settled = yield from settle(plan, servo, servo.registers if registers is None else registers, line)
    written = tuple(settled.written)
    if not settled.problems and (problem := (yield from modes.enter(plan, servo, mode, again=False))):
        settled.problems.append(f"{plan.label(servo)} {problem}")
    enabled = yield from retry(plan.torque_reads[servo_index])
    if not enabled.answered:
        settled.problems.append(f"{plan.label(servo)} did not answer when its torque was read")
    if settled.problems or not torque:
        holds = not settled.problems and enabled.parameters[0] == 1
        return Rejoined(tuple(settled.problems), holds, written, mode)
    held = yield from modes.hold(plan, servo, servo.mode_plan(mode))
    if held.problem:
        return Rejoined((f"{plan.label(servo)} {held.problem}",), False, written)
    return Rejoined((), True, written, mode)


def _tick_read(plan: BusPlan, index: int) -> Transaction | None:
    servo = plan.servos[index]
    item = control_table(servo.model, plan.protocol).items.get("realtime_tick")
    return None if item is None else plan_line(plan).read(servo.servo_id, item.address, item.size)
