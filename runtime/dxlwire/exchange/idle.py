"""Idle scheduler: runs programs of transactions on one bus between two cycles, the most urgent first.

Nothing of it makes a cycle late, as long as it is not urgent and starved: a transaction begins only when its
reply can be there in time, and a program that did not end continues in the next idle time.
"""

from __future__ import annotations

from bisect import insort
from enum import IntEnum, unique

from msgspec import structs
from msgspec.structs import replace

from dxlwire.exchange.bus import NEVER, Bus
from dxlwire.exchange.reports import Reason, ReportSink
from dxlwire.plan.line import SHORT_TIMEOUT_MARGIN_NS
from dxlwire.transaction import Outcome, Program, Reply, Transaction

LEAST_MARGIN_NS = 100_000
"""A reply is awaited at least so long beyond the moment at which it is due; a servo is late by less."""
STARVED = 50
"""Cycles after which an urgent program continues though time is too short: a skipped period is better than a
joint that gets no goals for the rest of the run."""
STARVED_AGAIN = 5  # Cycles between its transactions from then on
WHOLE_BUS = -1  # Instead of a servo: the program is about no single one


@unique
class Urgency(IntEnum):
    """The order of programs: a lower number goes first, between two transactions of others if need be.

    A program other than SLOW that never finds enough time is executed at the cost of the next cycle.
    """

    MODE = 0  # A joint has no goal until its mode is there
    REPAIR = 1  # What a servo is owed: its torque, its alert, its return
    STEERED = 2  # A client waits for it
    SLOW = 3  # Registers of which one reading may be missed; never done without the time for it


class _Task:
    """A program on its way: the transaction that is next, and since when it waits."""

    def __init__(self, program: Program[None], turn: tuple[Urgency, int], name: str, servo: int) -> None:
        self._program = program
        self.turn = turn
        self.name = name
        self.servo = servo
        self.pressed = turn[0]  # The highest urgency of the programs that wait for it
        self.next: Transaction | None = None
        self.begun = False  # True once anything of it was on the line
        self.paused = False
        self.wake_ns = 0
        self.held_ns = NEVER  # since when its transaction waits for owed replies
        self.starved = 0  # Cycles in a row without time for its next transaction
        self.reported = False

    def resume(self, reply: Reply | None) -> bool:
        """Hand over what came of the transaction before, None at the start; return whether one follows."""
        self.begun = reply is not None
        self.held_ns = NEVER
        try:
            self.next = next(self._program) if reply is None else self._program.send(reply)
        except StopIteration:
            return False
        return True


class IdleScheduler:
    """Programs of one bus that wait for time between cycles; a bus executes it as one job per idle time.

    Programs of one servo never mix: one that has begun ends before another one begins. A transaction that
    sends nothing (`line.listen`) is a pause; others use the line meanwhile. Every program comes to its end: a
    line that is gone answers with time-outs (`abandon`).
    """

    def __init__(self, bus: Bus, reports: ReportSink) -> None:
        self.plan = bus.plan
        self.bus = bus
        self._reports = reports
        self.now_ns = bus.now_ns
        self.tasks: list[_Task] = []  # in the order of their turns
        self._current: _Task | None = None
        self._until_ns = 0
        self._count = 0

    def add(
        self,
        program: Program[None],
        urgency: Urgency,
        name: str,
        servo: int = WHOLE_BUS,
    ) -> None:
        """Let a program be executed in the next idle times; at its end it does itself what follows from it.

        `name`: what a person reads when it has to wait: `torque enable of elbow (ID 4 on bus main)`.
        `servo`: index into the plan's servos. May be called from a program.
        """
        self._count += 1
        insort(self.tasks, _Task(program, (urgency, self._count), name, servo), key=_turn)

    @property
    def waiting(self) -> int:
        """How many programs have not come to their end."""
        return len(self.tasks)

    @property
    def least_ns(self) -> int:
        """The least idle time, beside the margin for late replies, in which anything can be done.

        NEVER: nothing waits; 0: what waits is looked at in each.
        """
        least_ns = NEVER
        for task in self.tasks:
            if task.pressed is not Urgency.SLOW or task.begun or task.paused or task.next is None:
                return 0
            least_ns = min(least_ns, self._need_ns(task.next, 0))
        return least_ns

    def begin(self, until_ns: int) -> bool:
        """Prepare for the idle time that ends at `until_ns`; return whether there is anything to do."""
        if not self.tasks:
            return False
        self._until_ns = until_ns
        self._current = None
        return True

    def advance(self, reply: Reply | None) -> Transaction | None:
        """Give a reply to the program that waits for it, return the next transaction that fits."""
        if reply is not None and self._current is not None:
            self._resume(self._current, replace(reply, parameters=bytes(reply.parameters)))
        first = reply is None
        while (task := self._ready()) is not None:
            if task.next is None:
                self._resume(task, None)
            elif not task.next.packet:
                self._pause(task, task.next)
            else:
                self._current = task
                return self._timed(task, task.next, first)
        self._current = None
        return None

    def status(self, index: int, reply: Reply) -> None:
        """Wait for the end of the transaction: a program awaits one status at a time."""

    def abandon(self) -> None:
        """Bring every program to its end without a line: every transaction times out.

        What they add meanwhile waits for the next idle time.
        """
        tasks, self.tasks, self._current = self.tasks, [], None
        for task in tasks:
            more = task.next is not None or task.resume(None)
            while more:
                more = task.resume(_nothing())

    def _ready(self) -> _Task | None:
        """Return the program that is next; of one servo that is the one that has begun."""
        now = self.now_ns()
        for task in self.tasks:
            chosen = task
            if task.servo != WHOLE_BUS and not task.begun:
                chosen = next((one for one in self.tasks if one.begun and one.servo == task.servo), task)
                chosen.pressed = min(chosen.pressed, task.pressed)
            if (not chosen.paused or chosen.wake_ns <= now) and not self._held_back(chosen, now):
                return chosen
        return None

    def _held_back(self, task: _Task, now_ns: int) -> bool:
        """Check whether a transaction has to wait because a late reply could be taken for its own."""
        wanted = task.next
        if wanted is None or not wanted.packet or not self.bus.choose(wanted)[1]:
            return False
        task.held_ns = min(task.held_ns, now_ns)
        return now_ns - task.held_ns < wanted.patience_ns

    def _resume(self, task: _Task, reply: Reply | None) -> None:
        if not task.resume(reply):
            self.tasks.remove(task)

    def _pause(self, task: _Task, pause: Transaction) -> None:
        if not task.paused:
            task.paused, task.wake_ns = True, self.now_ns() + pause.due_ns
        else:
            task.paused = False
            self._resume(task, _nothing(Outcome.SENT))

    def _timed(self, task: _Task, wanted: Transaction, first: bool) -> Transaction | None:
        """Return the transaction with a timeout that the idle time allows; None: it has to wait."""
        left_ns = self._until_ns - self.now_ns()
        latest_ns = self._need_ns(self.bus.choose(wanted)[0], max(self.bus.late_ns, LEAST_MARGIN_NS))
        if latest_ns > left_ns:
            if not first or not self._forced(task, latest_ns, left_ns):
                return None
            left_ns = latest_ns + SHORT_TIMEOUT_MARGIN_NS
        task.starved = 0
        return structs.replace(wanted, timeout_ns=min(wanted.timeout_ns, left_ns))

    def _need_ns(self, wanted: Transaction, margin_ns: int) -> int:
        """Return the time that a transaction takes at most, if its replies are no later than by a margin.

        A reply behind the end would disturb the next cyclic read, which costs far more than this brings.
        """
        return wanted.due_ns + (self.plan.latency_ns + margin_ns if wanted.awaited else 0)

    def _forced(self, task: _Task, need_ns: int, left_ns: int) -> bool:
        """Count the cycles that a program waits; return whether it is done at the cost of the next cycle."""
        task.starved += 1
        if task.pressed is Urgency.SLOW or task.starved <= (STARVED_AGAIN if task.reported else STARVED):
            return False
        if not task.reported:
            task.reported = True
            servos = self.plan.servos
            source = self.plan.name if task.servo == WHOLE_BUS else servos[task.servo].joint
            need, left = need_ns * 1e-6, max(left_ns, 0) * 1e-6
            text = f"{task.name} waits for idle time: it may take {need:.1f} ms, of which the cycle leaves"
            text = f"{text} {left:.1f} ms; periods may be skipped"
            self._reports.report(Reason.NO_IDLE_TIME, source, text)
        return True


def _turn(task: _Task) -> tuple[Urgency, int]:
    return task.turn


def _nothing(outcome: Outcome = Outcome.TIMEOUT) -> Reply:
    return Reply(outcome, 0, b"", 0, 0, False)
