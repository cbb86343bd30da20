"""Patience: how long a servo that should be there is awaited where nothing else waits for the line.

The start is in no hurry, and an answer that is given up too early is worse than a slow start: it comes later,
and looks like the answer to what was asked next (a status packet does not say what it answers).
"""

from __future__ import annotations

from dataclasses import replace

from dxlrun.dynamixel.wire.transaction import Outcome, Program, Result

LONGER_NS = 240_000_000
"""Beyond the ordinary timeout [i]: hosts, virtual machines and USB adapters stand still for tens of ms."""
MOST_SILENCE_NS = 960_000_000
"""So much longer all silence together is awaited: who says nothing four times is not merely late."""


def patient(
    program: Program[Result], most_ns: int = LONGER_NS, extra_ns: list[int] | None = None
) -> Program[Result]:
    """Execute a program of one bus, and give each reply longer, as long as few of them do not come.

    A servo that answers in the end costs what it takes; a bus without any is told within about two seconds.
    `extra_ns` gets how much later than it was due by the wire each reply came.
    """
    left_ns = MOST_SILENCE_NS
    try:
        wanted = next(program)
        while True:
            longer_ns = min(most_ns, left_ns) if wanted.awaited else 0
            reply = yield replace(wanted, timeout_ns=wanted.timeout_ns + longer_ns) if longer_ns else wanted
            if extra_ns is not None and wanted.awaited and reply.answered:
                extra_ns.append(reply.last_ns - reply.sent_ns - wanted.due_ns)
            if reply.outcome in (Outcome.TIMEOUT, Outcome.GARBLED):
                left_ns -= longer_ns
            wanted = program.send(reply)
    except StopIteration as end:
        result: Result = end.value
        return result
