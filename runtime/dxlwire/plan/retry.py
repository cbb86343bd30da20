"""Retries: repeats transactions and extends timeouts for programs that no cycle waits for: start-up,
recovery, tools."""

from __future__ import annotations

import msgspec
from msgspec.structs import replace

from dxlwire.bus_plan import BusPlan
from dxlwire.plan.line import LONGEST_RETURN_DELAY_NS, Line, listen_transaction
from dxlwire.transaction import Program, Reply, Result, Transaction, TransactionOutcome
from dxlwire.wire.dialect import dialect_of

ATTEMPTS = 3
LONGER_NS = 240_000_000
"""Longest extension of an ordinary timeout, ns [i]: hosts, virtual machines and USB adapters stall for
tens of ms."""
MOST_SILENCE_NS = 960_000_000
"""Total extension of timeouts for all lost replies of a program, ns: after four losses a servo is not
merely late."""


class ReplyLateness(msgspec.Struct):
    """Lateness of the replies on one bus, collected by `extend_timeouts`."""

    late_ns: list[int] = []
    """Delay of each unambiguous reply after its due time, ns, without the stalls of simulated servos."""
    missing: int = 0
    """Number of requests that got no reply before their extended timeout."""


def setup_line(plan: BusPlan) -> Line:
    """Return the timing of a bus for use before the servos' return delays are known: it assumes the
    longest delay."""
    delay_ns = max(plan.return_delay_ns, LONGEST_RETURN_DELAY_NS)
    return Line(plan.baud_rate, plan.latency_ns, delay_ns, dialect_of(plan.protocol))


def retry(transaction: Transaction) -> Program[Reply]:
    """Repeat a transaction until it is answered, at most ATTEMPTS times in total; return the last reply."""
    reply = yield transaction
    for _ in range(ATTEMPTS - 1):
        if reply.answered:
            break
        reply = yield transaction
    return reply


def pause(duration_ns: int) -> Program[None]:
    """Send nothing for `duration_ns`; bytes that still arrive are received and logged."""
    yield listen_transaction(duration_ns)


def limit_patience(
    program: Program[Result], patience_ns: int = 0, *, any_age: bool = False
) -> Program[Result]:
    """Run a program whose transactions are held back for late replies for at most `patience_ns`.

    This serves torque off and servos with a running Bus Watchdog, which cannot wait. An ambiguous reply is
    then charged to the older request, because replies come in the order of their requests.

    Args:
        program: The program.
        patience_ns: Longest wait for late replies to older requests, ns.
        any_age: Accept the reply to an older read of the same registers. Otherwise servos with an armed
            watchdog would stop during the timeout of a reply that was charged to an older request.

    Returns:
        The result of the program.
    """
    try:
        request = next(program)
        while True:
            reply = yield replace(
                request, patience_ns=min(request.patience_ns, patience_ns), any_age=any_age or request.any_age
            )
            request = program.send(reply)
    except StopIteration as end:
        result: Result = end.value
        return result


def extend_timeouts(
    program: Program[Result], most_ns: int = LONGER_NS, times: ReplyLateness | None = None
) -> Program[Result]:
    """Run a program of one bus with longer timeouts, until MOST_SILENCE_NS has been spent on lost replies.

    A late servo costs only its own delay. A bus without any servo is reported within about two seconds.

    Args:
        program: The program.
        most_ns: Longest extension of one timeout, ns.
        times: Collects the lateness of replies.

    Returns:
        The result of the program.
    """
    left_ns = MOST_SILENCE_NS
    try:
        request = next(program)
        while True:
            longer_ns = min(most_ns, left_ns) if request.awaited else 0
            reply = (
                yield replace(request, timeout_ns=request.timeout_ns + longer_ns) if longer_ns else request
            )
            # Only a reply that cannot belong to an older repetition measures the lateness.
            certain = reply.answered and reply.asked_ns == reply.sent_ns
            if times is not None and request.awaited and certain:
                times.late_ns.append(reply.last_ns - reply.sent_ns - request.due_ns - reply.stalled_ns)
            if times is not None and reply.outcome == TransactionOutcome.TIMEOUT:
                times.missing += 1
            if reply.outcome in (TransactionOutcome.TIMEOUT, TransactionOutcome.GARBLED):
                left_ns -= longer_ns
            request = program.send(reply)
    except StopIteration as end:
        result: Result = end.value
        return result
