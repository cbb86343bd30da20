"""Absent: servos of one bus that left the exchange; asked now and then, and taken back as at the start."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple, Protocol

from dxlrun.dynamixel.control_table import control_table
from dxlrun.dynamixel.exchange.gaps import Gaps, Urgency
from dxlrun.dynamixel.plan.bus_plan import BusPlan
from dxlrun.dynamixel.plan.planning import plan_line
from dxlrun.dynamixel.registers import bus_watchdog
from dxlrun.dynamixel.registers.inspection import persist, who
from dxlrun.dynamixel.servo.reboots import RealtimeTicks, RebootCount
from dxlrun.dynamixel.servo.startup import Rejoined, rejoin
from dxlrun.dynamixel.servo.wanted import Wanted
from dxlrun.dynamixel.wire.transaction import Outcome, Program, Reply, Transaction
from dxlrun.run.channels.events import EventCode, Severity

PROBE_NS = 1_000_000_000
"""A lost servo is asked once a second (failures.md)."""
FIRST_PROBE_NS = 200_000_000
"""The first time a little earlier: most losses are a loose plug or a boot, which is over by then."""
NEVER = 1 << 62
_UNHEARD = frozenset((Outcome.TIMEOUT, Outcome.GARBLED))
_TURNS = (
    "forgot over that in which turn it stood, so its goal would be turns away: it gets no torque again in "
    "this mode; start the run anew"
)


class Voice(Protocol):
    """Tells something of a servo of the bus."""

    def __call__(self, code: EventCode, severity: Severity, index: int, text: str) -> None:
        """Emit an event whose text goes on after the servo's name."""
        ...


class _Outcome(NamedTuple):
    """What came of asking a lost servo."""

    answered: bool
    garbled: bool = False
    rejoined: Rejoined | None = None


class Absent:
    """Knows who left the exchange, asks them, and hands them back when they are in order.

    One returns into the mode and with the registers that are `wanted` of it. `back` takes the servo and what
    came of its return; it has torque only when it kept it, or when the policy for returned servos gives it
    back after a reboot and the servo is not latched.
    """

    __slots__ = (
        "_anew",
        "_back",
        "_due_ns",
        "_earliest_ns",
        "_gaps",
        "_had_torque",
        "_now_ns",
        "_plan",
        "_reboots",
        "_said",
        "_say",
        "_tick_reads",
        "_ticks",
        "_wanted",
    )

    def __init__(
        self,
        plan: BusPlan,
        gaps: Gaps,
        wanted: Wanted,
        say: Voice,
        back: Callable[[int, Rejoined], None],
    ) -> None:
        count = len(plan.servos)
        self._plan = plan
        self._gaps = gaps
        self._wanted = wanted
        self._now_ns = gaps.now_ns
        self._say = say
        self._back = back
        self._due_ns = [NEVER] * count
        self._earliest_ns = NEVER
        self._had_torque = [False] * count
        self._anew = [False] * count  # who started anew since it took part
        self._said = [""] * count
        self._ticks = RealtimeTicks(count)
        self._reboots = RebootCount(count)
        self._tick_reads = [_tick_read(plan, index) for index in range(count)]

    def lose(self, index: int, had_torque: bool, after_ns: int = FIRST_PROBE_NS) -> None:
        """Ask a servo, first after a while, until it is in order."""
        self._had_torque[index] = had_torque
        self._said[index] = ""
        self._plan_probe(index, after_ns)

    def latch(self, index: int) -> None:
        """Give a servo no torque back after a reboot."""
        self._reboots.latched[index] = True

    def look(self) -> None:
        """Let the coming gaps ask everybody who is due; called once a cycle."""
        if self._earliest_ns == NEVER:
            return
        now = self._now_ns()
        if now < self._earliest_ns:
            return
        for index, due_ns in enumerate(self._due_ns):
            if due_ns <= now:
                self._due_ns[index] = NEVER
                name = f"the return of {self._plan.servos[index].joint}"
                self._gaps.add(self._ask(index), partial(self._asked, index), Urgency.REPAIR, name, index)
        self._earliest_ns = min(self._due_ns)

    def switch_off(self, index: int, failed: Callable[[], None]) -> None:
        """Switch a servo's torque off in the coming gaps; `failed` is called when that was not read back."""

        def done(off: bool) -> None:
            if not off:
                failed()

        name = f"torque off of {who(self._plan, self._plan.servos[index])}"
        self._gaps.add(switch_off(self._plan, index), done, Urgency.REPAIR, name, index)

    def tick(self, index: int) -> Program[bool]:
        """Read a servo's Realtime Tick, if it has one; return whether it shows a reboot, which is counted."""
        read = self._tick_reads[index]
        return False if read is None else bool(self._judge_tick(index, (yield from persist(read))))

    def _plan_probe(self, index: int, after_ns: int) -> None:
        self._due_ns[index] = self._now_ns() + after_ns
        self._earliest_ns = min(self._due_ns)

    def _ask(self, index: int) -> Program[_Outcome]:
        """Ping a servo; when it answers, see what became of it and take it back."""
        plan, servo = self._plan, self._plan.servos[index]
        reply = yield plan_line(plan).ping(servo.servo_id)
        if reply.answered and (read := self._tick_reads[index]) is not None:
            reply = yield from persist(read)
        if reply.outcome in _UNHEARD:
            return _Outcome(False, reply.outcome is Outcome.GARBLED)
        if self._judge_tick(index, reply) is None:
            enabled = yield from persist(plan.torque_reads[index])
            if self._had_torque[index] and enabled.answered and not enabled.parameters[0]:
                self._count(index)
        yield from bus_watchdog.disarm(plan, servo)
        torque = self._anew[index] and servo.torque_on_return and not self._reboots.latched[index]
        mode, registers = self._wanted.modes.wanted(index), self._wanted.registers.wanted(index)
        if torque and servo.continuous and servo.mode_plan(mode).goals[-1].position is not None:
            torque = False  # it came back in another turn: its goal is turns away
            self._say(EventCode.SERVO_LIMP, Severity.ERROR, index, _TURNS)
        rejoined = yield from rejoin(plan, index, torque, mode, registers)
        if not rejoined.problems and (problem := (yield from bus_watchdog.arm(plan, servo))):
            rejoined = Rejoined((problem,), False, None, rejoined.written)
        return _Outcome(True, False, rejoined)

    def _asked(self, index: int, outcome: _Outcome) -> None:
        rejoined = outcome.rejoined
        if rejoined is not None and not rejoined.problems:
            self._anew[index] = False
            self._back(index, rejoined)
            return
        self._plan_probe(index, PROBE_NS)
        text = ""
        if rejoined is not None:
            text = f"answers again, but cannot take part: {'; '.join(rejoined.problems)}"
        elif outcome.garbled:
            text = "answers garbled or twice: do two servos have its ID? If not, check its cable"
        if text and text != self._said[index]:
            self._said[index] = text
            self._say(EventCode.SERVO_LOST, Severity.ERROR, index, text)

    def _judge_tick(self, index: int, reply: Reply) -> bool | None:
        """Judge a reply with Realtime Tick; None: it has none, or the one before is too long ago."""
        if self._tick_reads[index] is None or not reply.answered:
            return None
        rebooted = self._ticks.rebooted(index, reply)
        if rebooted:
            self._count(index)
        return rebooted

    def _count(self, index: int) -> None:
        self._anew[index], self._had_torque[index] = True, False
        text = "started anew: it was without power, or somebody rebooted it"
        self._say(EventCode.SERVO_REBOOTED, Severity.ERROR, index, text)
        if self._reboots.add(index, self._now_ns()):
            text = "rebooted twice within a minute: it gets no torque again in this run; check its supply"
            self._say(EventCode.SERVO_REBOOTED, Severity.ERROR, index, text)


def switch_off(plan: BusPlan, index: int) -> Program[bool]:
    """Switch a servo's torque off; return whether that was read back."""
    servo = plan.servos[index]
    for _ in range(3):
        yield plan_line(plan).write(servo.servo_id, servo.torque_address, b"\0")
        back = yield plan.torque_reads[index]
        if back.answered and back.parameters[0] == 0:
            return True
    return False


def _tick_read(plan: BusPlan, index: int) -> Transaction | None:
    servo = plan.servos[index]
    item = control_table(servo.model, plan.protocol).items.get("realtime_tick")
    return None if item is None else plan_line(plan).read(servo.servo_id, item.address, item.size)
