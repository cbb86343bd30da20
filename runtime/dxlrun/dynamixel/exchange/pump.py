"""Pump: the one wait that serves the transaction machines of all buses."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from dxlrun.clock import Clock
from dxlrun.dynamixel.exchange.bus import NEVER, Bus
from dxlrun.dynamixel.port.ports import Ports
from dxlrun.dynamixel.wire.transaction import Program, ProgramJob, Result

LOST_LINE_STEP_NS = 200_000
"""How often the other lines are looked at while one is gone."""
BEAT_NS = 1_000_000
"""So long, and one wait more, nobody sees a sign of life."""


def clear(buses: Sequence[Bus], ports: Ports, asked: Sequence[bool] = ()) -> None:
    """Take what lines have that were not asked yet in this cycle; without `asked`: what all have.

    What came before a request must not be taken for its reply, and replies come in the order of requests: one
    that is too many would shift all that follow.
    """
    for index in ports.wait(0):
        if buses[index].failure is None and not (asked and asked[index]):
            buses[index].hear()


def pump(
    buses: Sequence[Bus], ports: Ports, clock: Clock, beat: Callable[[], None], until_ns: int = NEVER
) -> None:
    """Execute the jobs of all buses side by side: one wait over all ports, until every job is finished.

    All that can be sent is sent before anything is awaited. Ends at `until_ns` in any case, and a job that is
    not finished then goes on in the next call. `beat` is called before a wait, if it was not within BEAT_NS.
    Raises nothing: a line that is gone has its `failure`, and the others go on.
    """
    clock_ns, wait = clock.now_ns, ports.wait
    now_ns, beat_ns = clock_ns(), 0
    deadlines = [bus.step(now_ns) for bus in buses]
    while (deadline := min(deadlines)) != NEVER and now_ns < until_ns:
        if now_ns >= beat_ns:
            beat()
            beat_ns = now_ns + BEAT_NS
        deadline = min(deadline, until_ns)
        ready = wait(deadline)
        heard = not ready
        for index in ready:
            bus = buses[index]
            if bus.failure is None:
                heard = True
                deadlines[index] = bus.hear()
        if not heard:
            # a line that is gone is ready for ever: look at the others now and then instead of waiting
            clock.wait_until(min(deadline, clock_ns() + LOST_LINE_STEP_NS))
            for bus in buses:
                bus.hear()
        now_ns = clock_ns()
        if now_ns >= deadline or not heard:
            deadlines = [bus.step(now_ns) for bus in buses]


def run(
    programs: Sequence[Program[Result]],
    buses: Sequence[Bus],
    ports: Ports,
    clock: Clock,
    beat: Callable[[], None] = lambda: None,
) -> list[Result | None]:
    """Run one program a bus to its end, blocking, side by side; for set-up and tools, never in the loop.

    Returns what each program returned; None where the line is gone, and the bus' `failure` says why.
    """
    jobs = [ProgramJob(program) for program in programs]
    for bus, job in zip(buses, jobs, strict=True):
        bus.load(job)
    clear(buses, ports)
    pump(buses, ports, clock, beat)
    return [job.result for job in jobs]
