"""Idle scheduler: runs programs of transactions on one bus between two cycles, the most urgent first.

A transaction begins only when its reply can arrive in time, so it does not delay the cycle. The exception
is an urgent program that starves. A program that did not finish continues in the next idle time."""

from __future__ import annotations

from bisect import insort
from enum import IntEnum, unique

from msgspec import structs
from msgspec.structs import replace

from dxlwire.bus_plan import BusPlan
from dxlwire.exchange import reports
from dxlwire.exchange.bus_engine import NEVER, BusEngine
from dxlwire.exchange.reports import Reason, ReportSink
from dxlwire.plan.line import SHORT_TIMEOUT_MARGIN_NS
from dxlwire.transaction import Program, Reply, Transaction, TransactionOutcome

LEAST_MARGIN_NS = 100_000
"""Minimum time (ns) for which a reply is awaited after it is due; servos answer with less delay than this."""
STARVED = 50
"""Cycles after which an urgent program continues although the time is too short. A skipped period is
better than a joint that gets no goals for the rest of the run."""
STARVED_AGAIN = 5  # Cycles between the transactions of a starved program from then on
WHOLE_BUS = -1  # Servo index of a program that concerns the whole bus


@unique
class Urgency(IntEnum):
    """Priority of a program in idle time: a lower number goes first, even between two transactions of another
    program.

    A program that never finds enough time is executed at the cost of the next cycle, unless it is SLOW."""

    MODE = 0  # A joint has no goals until its mode is set
    REPAIR = 1  # Recovery of a servo: its torque, its alert, its return to the cycle
    STEERED = 2  # A client waits for the result
    SLOW = 3  # Registers whose readings may be skipped; never executed without enough time


class _Task:
    """One program that the idle scheduler has not finished, with its next transaction."""

    def __init__(self, program: Program[None], turn: tuple[Urgency, int], name: str, servo: int) -> None:
        self._program = program
        self.turn = turn
        self.name = name
        self.servo = servo
        self.pressed = turn[0]  # Highest urgency among the programs that wait for this one
        self.next: Transaction | None = None
        self.begun = False  # True once one of its transactions was on the line
        self.paused = False
        self.wake_ns = 0
        self.held_ns = NEVER  # Time since which its transaction waits for owed replies
        self.starved = 0  # Consecutive cycles without time for its next transaction
        self.reported = False

    def resume_program(self, reply: Reply | None) -> bool:
        """Run the program to its next transaction, with the reply to the last one, None at the start;
        return False if the program has ended."""
        self.begun = reply is not None
        self.held_ns = NEVER
        try:
            self.next = next(self._program) if reply is None else self._program.send(reply)
        except StopIteration:
            return False
        return True


class IdleScheduler:
    """Queue of the programs that use one bus between cycles; the bus executes them as one job per idle time.

    Programs of one servo never overlap: a program that has begun ends before the next one begins. A
    transaction that sends nothing (`line.listen`) is a pause, and other programs use the line during it.
    Every program runs to completion: on a lost line its transactions time out (`abandon`)."""

    def __init__(self, bus: BusEngine, reports: ReportSink) -> None:
        self.bus = bus
        self._reports = reports
        self.now_ns = bus.now_ns
        self.tasks: list[_Task] = []  # in the order of their turns
        self._current: _Task | None = None
        self._until_ns = 0
        self._count = 0

    @property
    def plan(self) -> BusPlan:
        """Plan of the bus, with its servos as they are placed now."""
        return self.bus.plan

    def add(
        self,
        program: Program[None],
        urgency: Urgency,
        name: str,
        servo: int = WHOLE_BUS,
    ) -> None:
        """Queue a program for the next idle times. The program handles its own result.

        May be called from a program.

        Args:
            program: The transactions, as a generator.
            urgency: Priority of the program.
            name: Name in reports about a wait: `torque enable of elbow (ID 4 on bus main)`.
            servo: Index into the plan's servos, or WHOLE_BUS.
        """
        self._count += 1
        insort(self.tasks, _Task(program, (urgency, self._count), name, servo), key=_turn)

    @property
    def waiting(self) -> int:
        """Number of programs that have not ended."""
        return len(self.tasks)

    @property
    def least_ns(self) -> int:
        """Shortest idle time in which a waiting program can continue, ns, without the margin for late
        replies.

        NEVER: no program waits. 0: check the programs in every idle time."""
        least_ns = NEVER
        for task in self.tasks:
            if task.pressed is not Urgency.SLOW or task.begun or task.paused or task.next is None:
                return 0
            least_ns = min(least_ns, self._need_ns(task.next, 0))
        return least_ns

    def begin_idle(self, until_ns: int) -> bool:
        """Begin an idle time that ends at `until_ns`; return False if no program waits, so that the bus
        need not load this job."""
        if not self.tasks:
            return False
        self._until_ns = until_ns
        self._current = None
        return True

    def next_transaction(self, reply: Reply | None) -> Transaction | None:
        """Pass the reply to the program that awaits it, and return the next transaction that fits into the
        idle time; None: none does."""
        if reply is not None and self._current is not None:
            # The bus reuses the reply object and its buffer, so the program gets a copy.
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
        """Ignore the status of one servo in a reply: `next_transaction` receives the whole reply, and a
        program awaits one status at a time."""

    def abandon(self) -> None:
        """Run every program to its end while the line is lost: each transaction times out at once, and
        nothing is sent.

        Programs added during this call wait for the next idle time."""
        tasks, self.tasks, self._current = self.tasks, [], None
        for task in tasks:
            more = task.next is not None or task.resume_program(None)
            while more:
                more = task.resume_program(_nothing())

    def _ready(self) -> _Task | None:
        """Return the most urgent program that can continue now. A program that has begun precedes all
        others of the same servo."""
        now = self.now_ns()
        for task in self.tasks:
            chosen = task
            if task.servo != WHOLE_BUS and not task.begun:
                chosen = next((one for one in self.tasks if one.begun and one.servo == task.servo), task)
                # Priority inheritance: a slow program that has begun must not block an urgent one of the same
                # servo.
                chosen.pressed = min(chosen.pressed, task.pressed)
            if (not chosen.paused or chosen.wake_ns <= now) and not self._held_back(chosen, now):
                return chosen
        return None

    def _held_back(self, task: _Task, now_ns: int) -> bool:
        """Return True if a program's next transaction must wait because a late reply could be taken for
        its own."""
        wanted = task.next
        if wanted is None or not wanted.packet or not self.bus.choose(wanted)[1]:
            return False
        task.held_ns = min(task.held_ns, now_ns)
        return now_ns - task.held_ns < wanted.patience_ns

    def _resume(self, task: _Task, reply: Reply | None) -> None:
        if not task.resume_program(reply):
            self.tasks.remove(task)

    def _pause(self, task: _Task, pause: Transaction) -> None:
        if not task.paused:
            task.paused, task.wake_ns = True, self.now_ns() + pause.due_ns
        else:
            task.paused = False
            self._resume(task, _nothing(TransactionOutcome.SENT))

    def _timed(self, task: _Task, wanted: Transaction, first: bool) -> Transaction | None:
        """Return the transaction with a timeout that fits the idle time, or None if it must wait for a
        longer one."""
        left_ns = self._until_ns - self.now_ns()
        latest_ns = self._need_ns(self.bus.choose(wanted)[0], max(self.bus.late_ns, LEAST_MARGIN_NS))
        if latest_ns > left_ns:
            if not first or not self._forced(task, latest_ns, left_ns):
                return None
            # A starved program gets a timeout that its reply can meet, at the cost of the next cycle.
            left_ns = latest_ns + SHORT_TIMEOUT_MARGIN_NS
        task.starved = 0
        return structs.replace(wanted, timeout_ns=min(wanted.timeout_ns, left_ns))

    def _need_ns(self, wanted: Transaction, margin_ns: int) -> int:
        """Return the longest duration of a transaction whose replies are late by no more than the margin, ns.

        A reply after the end of idle time would disturb the next cyclic read, which costs more than
        waiting."""
        return wanted.due_ns + (self.plan.latency_ns + margin_ns if wanted.awaited else 0)

    def _forced(self, task: _Task, need_ns: int, left_ns: int) -> bool:
        """Count a cycle in which a program found too little time; return True if it now runs at the cost
        of the next cycle."""
        task.starved += 1
        if task.pressed is Urgency.SLOW or task.starved <= (STARVED_AGAIN if task.reported else STARVED):
            return False
        if not task.reported:
            task.reported = True
            servos = self.plan.servos
            source = self.plan.name if task.servo == WHOLE_BUS else servos[task.servo].joint
            text = reports.idle_time_short(task.name, need_ns, max(left_ns, 0))
            self._reports.report(Reason.NO_IDLE_TIME, source, text)
        return True


def _turn(task: _Task) -> tuple[Urgency, int]:
    return task.turn


def _nothing(outcome: TransactionOutcome = TransactionOutcome.TIMEOUT) -> Reply:
    return Reply(outcome, 0, b"", 0, 0, False)
