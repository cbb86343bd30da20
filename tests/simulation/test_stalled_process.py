"""A process of simulated servos that is stopped for a while, or answers late on purpose, and its host."""

import math
import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from tests.kit.rigs import make_plan

from dxlrun.channels import child_processes
from dxlrun.channels.heartbeat import SimulationProgress, create_progress
from dxlrun.run.simulation_front import first_message, start_simulation
from dxlsim.messages import SimulationJob
from dxlsim.simulation_plan import BusConfig, ServoConfig, SimulationConfig
from dxlwire.clock import MonotonicClock
from dxlwire.exchange.bus_engine import Lines
from dxlwire.packets import PacketSink
from dxlwire.plan.planning import plan_line
from dxlwire.plan.retry import ReplyLateness, extend_timeouts
from dxlwire.port.ports import SerialPorts, SimulatedPort, StallCounter
from dxlwire.port.serial_open import open_serial
from dxlwire.transaction import Program, Reply, TransactionOutcome

PLAN = make_plan((1, 2))
OK, TIMEOUT = TransactionOutcome.OK, TransactionOutcome.TIMEOUT


def ping() -> Program[Reply]:
    return (yield plan_line(PLAN).ping(1))


class Stalls(StallCounter):
    """Lets a stopped process continue when it has been awaited for long enough."""

    def __init__(self, pid: int) -> None:
        super().__init__()
        self.pid, self.longest_ns = pid, math.inf

    def count(self, begin_ns: int, end_ns: int) -> None:
        super().count(begin_ns, end_ns)
        if self.waited_ns > self.longest_ns:
            os.kill(self.pid, signal.SIGCONT)


class Host:
    """A host of two servos in another process."""

    def __init__(self, lines: Lines, stalls: Stalls) -> None:
        self.lines, self.stalls = lines, stalls

    def ask(self) -> Reply:
        (reply,) = self.lines.run_programs([ping()])
        assert reply is not None
        return reply

    @contextmanager
    def stopped(self, longest_s: float = math.inf) -> Iterator[None]:
        """Stop the process of the servos until it has been awaited for so long, or the end of the context."""
        self.stalls.longest_ns = self.stalls.waited_ns + longest_s * 1e9
        os.kill(self.stalls.pid, signal.SIGSTOP)
        try:
            yield
        finally:
            os.kill(self.stalls.pid, signal.SIGCONT)


@contextmanager
def simulated(*faults: str) -> Iterator[Host]:
    progress, errors = create_progress(1), child_processes.memory_file("errors")
    bus = BusConfig("main", PLAN.baud_rate, tuple(ServoConfig(each, "AX-12A", 2.0) for each in (1, 2)))
    child = start_simulation(
        SimulationJob(SimulationConfig((bus,), faults=faults), progress=progress), errors
    )
    try:
        path = (first_message(child).ports or {})["main"]
        with open_serial(path, PLAN.baud_rate) as line:
            stalls = Stalls(child.process.pid)
            port = SimulatedPort(line.fileno(), "sim", SimulationProgress(progress).line(0), stalls)
            lines = Lines([PLAN], SerialPorts([port]), MonotonicClock(), PacketSink())
            yield Host(lines, stalls)
    finally:
        child.kill()
        os.close(progress)
        os.close(errors)


def test_reply_is_awaited_while_the_process_is_stopped_but_not_for_ever() -> None:
    with simulated() as host:
        assert host.ask().outcome is OK
        with host.stopped(0.005):
            reply = host.ask()
        assert reply.outcome is OK
        assert host.stalls.waited_ns > 5_000_000
        assert reply.stalled_ns > 5_000_000
        before_ns = host.stalls.waited_ns
        with host.stopped():
            assert [host.ask().outcome for _ in range(3)] == [TIMEOUT] * 3
            # it is given up once: three times the bound would be 1.5 s
            assert 0 < host.stalls.waited_ns - before_ns < 1_400_000_000


@pytest.mark.parametrize(
    "fault", ["silence servo=1 for=60s", "wedge for=60s", "timer by=200ms", "slow servo=1 by=200ms"]
)
def test_servo_that_is_silent_or_late_on_purpose_is_lost(fault: str) -> None:
    with simulated(fault) as host:
        # what an adapter's timer held back of the first reply brings a later one in time
        assert host.ask().outcome is TIMEOUT
        assert TIMEOUT in [host.ask().outcome for _ in range(4)]
        assert host.stalls.waited_ns < 500_000_000  # on a busy machine; it would be 2.5 s


def test_lateness_of_the_process_is_told_apart_from_that_of_the_servo() -> None:
    with simulated("slow servo=1 by=30ms") as host:
        times = ReplyLateness()
        with host.stopped(0.0):
            host.lines.run_programs([extend_timeouts(ping(), times=times)])
        (late,) = times.late_ns
        assert 29_000_000 < late < 60_000_000  # of more than 240 ms, by which the timeout is longer
