"""Pump: the one wait that serves the transaction machines of all buses."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from dxlrun.clock import Clock
from dxlrun.dynamixel.bus import NEVER, Bus
from dxlrun.dynamixel.port import Ports
from dxlrun.dynamixel.reply_polling import ReplyPolling
from dxlrun.dynamixel.transaction import Program, ProgramJob, Result

LOST_LINE_STEP_NS = 200_000
"""How often the other lines are looked at while one is gone."""


def _look(
    buses: Sequence[Bus], ports: Ports, clock: Clock, polling: ReplyPolling, deadline_ns: int
) -> Sequence[int]:
    """Sleep until shortly before replies are due and look for them again and again; return who has bytes."""
    now_ns = clock.now_ns()
    dues = [bus.due_ns for bus in buses if bus.busy]
    # those that should be there since long wait for theirs
    due_ns = min((due for due in dues if due > now_ns), default=max(dues, default=0))
    until_ns = polling.await_until(due_ns, now_ns, deadline_ns)
    if not until_ns:
        return ()
    since_ns, looks = clock.now_ns(), 0
    ready: Sequence[int] = ()
    while not ready and now_ns < until_ns:
        ready = ports.wait(0)
        now_ns = clock.now_ns()
        looks += 1
    polling.spent(now_ns - since_ns, looks)
    return ready


def pump(
    buses: Sequence[Bus], ports: Ports, clock: Clock, beat: Callable[[], None], until_ns: int = NEVER
) -> None:
    """Execute the jobs of all buses side by side: one wait over all ports, until every job is finished.

    Ends at `until_ns` in any case, and a job that is not finished then goes on in the next call. `beat` is
    called at least once a transaction. Raises nothing: a line that is gone has its `failure`, and the others
    go on.
    """
    clock_ns, polling = clock.now_ns, ports.polling
    if len(buses) == 1 and until_ns == NEVER:
        buses[0].straight(ports, beat)
        if not (buses[0].busy or buses[0].failure):
            return
    now_ns = clock_ns()
    deadlines = [bus.step(now_ns) for bus in buses]
    while (deadline := min(deadlines)) != NEVER and now_ns < until_ns:
        beat()
        deadline = min(deadline, until_ns)
        ready = _look(buses, ports, clock, polling, deadline) if polling else ()
        ready = ready or ports.wait(deadline)
        heard = not ready
        for index in ready:
            bus = buses[index]
            if bus.failure is None:
                heard = True
                bus.receive()
                now_ns = clock_ns()
                if polling and bus.complete:
                    polling.came(bus.due_ns, now_ns)
                deadlines[index] = bus.step(now_ns)
        if not heard:
            # a line that is gone is ready for ever: look at the others now and then instead of waiting
            clock.wait_until(min(deadline, clock_ns() + LOST_LINE_STEP_NS))
            for bus in buses:
                bus.receive()
        now_ns = clock_ns()
        if now_ns >= deadline or not heard:
            deadlines = [bus.step(now_ns) for bus in buses]
    beat()


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
    pump(buses, ports, clock, beat)
    return [job.result for job in jobs]
