"""Retries and longer timeouts of programs that have time: start-up, return, tools.

Giving a reply up too early is worse than waiting: it comes later, and looks like the reply to the next
request (a status packet does not carry what it answers).
"""

from __future__ import annotations

from msgspec.structs import replace

from dxlrun.dynamixel.plan.line import LONGEST_RETURN_DELAY_NS, Line, listen
from dxlrun.dynamixel.wire.dialect import dialect_of
from dxlrun.plan.bus_plan import BusPlan
from dxlrun.plan.transaction import Outcome, Program, Reply, Result, Transaction

ATTEMPTS = 3
LONGER_NS = 240_000_000
"""Beyond the ordinary timeout [i]: hosts, virtual machines and USB adapters stall for tens of ms."""
DRAIN_NS = 500_000_000
"""For how long a tool hears what may come late, behind a reply that it gave up."""
QUIET_NS = 2_000_000
MOST_LISTENS = 100
"""A line that is never quiet has another host on it, or noise; it is asked nevertheless."""
MOST_SILENCE_NS = 960_000_000
"""Beyond the ordinary timeouts, for all lost replies together: after four a servo is not merely late."""


def setup_line(plan: BusPlan) -> Line:
    """Return the line before the servos' return delays are known: the longest is assumed."""
    delay_ns = max(plan.return_delay_ns, LONGEST_RETURN_DELAY_NS)
    return Line(plan.baud_rate, plan.latency_ns, delay_ns, dialect_of(plan.protocol))


def retry(transaction: Transaction) -> Program[Reply]:
    """Repeat a transaction until it is answered, at most ATTEMPTS times; return the last reply."""
    reply = yield transaction
    for _ in range(ATTEMPTS - 1):
        if reply.answered:
            break
        reply = yield transaction
    return reply


def pause(duration_ns: int) -> Program[None]:
    """Let a moment pass, and take what still comes."""
    yield listen(duration_ns)


def drained(program: Program[Result]) -> Program[Result]:
    """Run a tool's program so that no reply is taken for the next: a status does not carry what it answers.

    Behind each lost one it listens for DRAIN_NS before it asks again, behind each other one until nothing has
    come for as long as a reply takes: one that comes several times is the same.
    """
    try:
        request = next(program)
        while True:
            reply = yield request
            if reply.outcome in (Outcome.TIMEOUT, Outcome.GARBLED):
                yield listen(DRAIN_NS)
            elif request.awaited:
                for _ in range(MOST_LISTENS):
                    after = yield listen(request.due_ns + QUIET_NS)
                    if not after.strays:
                        break
            request = program.send(reply)
    except StopIteration as end:
        result: Result = end.value
        return result


def extend_timeouts(
    program: Program[Result], most_ns: int = LONGER_NS, extra_ns: list[int] | None = None
) -> Program[Result]:
    """Run a program of one bus with longer timeouts, as long as few replies are lost.

    A servo that answers late costs what it takes; a bus without any servo is reported within about two
    seconds. `extra_ns` collects how much later than due by the wire each reply came.
    """
    left_ns = MOST_SILENCE_NS
    try:
        request = next(program)
        while True:
            longer_ns = min(most_ns, left_ns) if request.awaited else 0
            reply = (
                yield replace(request, timeout_ns=request.timeout_ns + longer_ns) if longer_ns else request
            )
            if extra_ns is not None and request.awaited and reply.answered:
                extra_ns.append(reply.last_ns - reply.sent_ns - request.due_ns)
            if reply.outcome in (Outcome.TIMEOUT, Outcome.GARBLED):
                left_ns -= longer_ns
            request = program.send(reply)
    except StopIteration as end:
        result: Result = end.value
        return result
