"""How punctual simulated servos are in real time, and how many of them one core can serve.

    python tests/bench/simulated_bus.py [--transactions 1000] [--seconds 10] [--priority N --core N]

First: reads of 10 bytes at 57600, 1 M, 2 M and 4 Mbit/s; by how much later than wire time and return delay
the host has the last byte, as the host sees it. Then: 20 servos on 4 buses at 4 Mbit/s, each bus read 1,000
times a second with a sync write of goals and a sync read of 10 bytes.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import select
import socket
import statistics
import subprocess
import sys
import time
import tty
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from dxlrun.simulation import BusConfig, ServoConfig, encode_config
from dxlrun.simulation.wire.protocol2 import crc16

RATES = (57_600, 1_000_000, 2_000_000, 4_000_000)
RETURN_DELAY_NS = 500_000
MODEL = "XM430-W350"
GOAL_POSITION, PRESENT, PRESENT_BYTES = 116, 126, 10
BUSES, SERVOS_A_BUS, PERIOD_NS = 4, 5, 1_000_000
STATUS_BYTES = 11 + PRESENT_BYTES


@dataclass
class Running:
    """The process of simulated buses."""

    child: subprocess.Popen[bytes]
    ports: dict[str, str]
    real_time: str

    def processor_s(self) -> float:
        """Return how long it has been on a processor so far."""
        with open(f"/proc/{self.child.pid}/stat", encoding="ascii") as file:
            fields = file.read().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


@contextlib.contextmanager
def serving(buses: Sequence[BusConfig], options: Sequence[str]) -> Iterator[Running]:
    """Start the process, and end it."""
    ours, theirs = socket.socketpair()
    reader, writer = os.pipe()
    os.write(writer, encode_config(buses))
    os.close(writer)
    with ours, theirs:
        command = [sys.executable, "-m", "dxlrun.simulation", "--config-fd", str(reader)]
        command += ["--control-fd", str(theirs.fileno()), *options]
        with subprocess.Popen(command, pass_fds=(reader, theirs.fileno()), start_new_session=True) as child:
            theirs.close()
            os.close(reader)
            try:
                with ours.makefile("rb") as output:
                    first = json.loads(output.readline())
                yield Running(child, first["ports"], first["real_time"])
            finally:
                ours.close()


@contextlib.contextmanager
def opened(path: str) -> Iterator[int]:
    """Open a port raw."""
    port = os.open(path, os.O_RDWR | os.O_NOCTTY)
    try:
        tty.setraw(port)
        yield port
    finally:
        os.close(port)


def packet(servo_id: int, instruction: int, parameters: bytes) -> bytes:
    """Return an instruction packet of Protocol 2.0."""
    body = bytes((instruction,)) + parameters
    head = b"\xff\xff\xfd\x00" + bytes((servo_id,)) + (len(body) + 2).to_bytes(2, "little")
    return head + body + crc16(head + body).to_bytes(2, "little")


def words(*numbers: int) -> bytes:
    """Return numbers of two bytes."""
    return b"".join(number.to_bytes(2, "little") for number in numbers)


def lateness_us(port: int, rate: int, transactions: int) -> list[float]:
    """Read one servo again and again; return by how much later than possible each reply was there, us."""
    request = packet(1, 0x02, words(PRESENT, PRESENT_BYTES))
    bound_ns = (len(request) + STATUS_BYTES) * 10_000_000_000 // rate + RETURN_DELAY_NS
    late = []
    for _ in range(transactions):
        start_ns = time.monotonic_ns()
        os.write(port, request)
        left = STATUS_BYTES
        while left:
            select.select([port], [], [])
            left -= len(os.read(port, left))
        late.append((time.monotonic_ns() - start_ns - bound_ns) / 1000)
    return late


def show_lateness(transactions: int, options: Sequence[str]) -> None:
    """Print by how much later the replies came at each rate; end with an error when one was too early."""
    servo = ServoConfig(1, MODEL, 3.0, RETURN_DELAY_NS)
    buses = tuple(BusConfig(str(rate), rate, (servo,), 2.0) for rate in RATES)
    with serving(buses, options) as running:
        print(f"real time: {running.real_time}")
        for rate in RATES:
            with opened(running.ports[str(rate)]) as port:
                late = sorted(lateness_us(port, rate, transactions))
            print(
                f"{rate:>8} bit/s, {transactions} reads of {PRESENT_BYTES} bytes: later than wire time + "
                f"return delay by: least {late[0]:.0f} us, median {statistics.median(late):.0f} us, "
                f"p99 {late[len(late) * 99 // 100]:.0f} us, most {late[-1]:.0f} us"
            )
            if late[0] < 0:
                raise SystemExit("a reply came earlier than it could have")


@dataclass
class Host:
    """One bus, as its host sees it: it reads again when it has everything, or after 5 ms."""

    port: int
    sent_ns: int = 0
    missing: int = 0
    answered: int = 0
    given_up: int = 0

    def serve(self, request: bytes, now_ns: int) -> None:
        """Take what has come; read again."""
        with contextlib.suppress(BlockingIOError):
            self.missing -= len(os.read(self.port, 4096))
        if self.missing > 0 and now_ns - self.sent_ns < 5_000_000:
            return
        self.answered += self.sent_ns > 0 and self.missing == 0
        self.given_up += self.missing > 0
        self.missing = SERVOS_A_BUS * STATUS_BYTES
        self.sent_ns = now_ns
        os.write(self.port, request)


def show_load(seconds: float, options: Sequence[str]) -> None:
    """Print the kept rate and the processor share with 20 servos on 4 buses."""
    ids = bytes(range(1, SERVOS_A_BUS + 1))
    servos = tuple(ServoConfig(each, MODEL, 3.0, 0) for each in ids)
    buses = tuple(BusConfig(str(index), 4_000_000, servos, 2.0) for index in range(BUSES))
    read = packet(0xFE, 0x82, words(PRESENT, PRESENT_BYTES) + ids)
    with serving(buses, options) as running, contextlib.ExitStack() as stack:
        hosts = [Host(stack.enter_context(opened(path))) for path in running.ports.values()]
        for host in hosts:
            os.write(host.port, packet(0xFE, 0x83, words(64, 1) + b"".join(bytes((each, 1)) for each in ids)))
            os.set_blocking(host.port, False)
        began_ns, before_s, host_s = time.monotonic_ns(), running.processor_s(), time.process_time()
        late = turn = 0
        while (now_ns := time.monotonic_ns()) - began_ns < seconds * 1e9:
            goal = 2048 + turn % 400
            data = b"".join(bytes((each,)) + goal.to_bytes(4, "little") for each in ids)
            request = packet(0xFE, 0x83, words(GOAL_POSITION, 4) + data) + read
            for host in hosts:
                host.serve(request, now_ns)
            turn += 1
            wait_ns = began_ns + turn * PERIOD_NS - time.monotonic_ns()
            late += wait_ns <= 0
            if wait_ns > 0:
                time.sleep(wait_ns * 1e-9)
            elif wait_ns < -PERIOD_NS:
                turn -= wait_ns // PERIOD_NS  # what the host itself missed is not made up for
        elapsed_s = (time.monotonic_ns() - began_ns) * 1e-9
        spent_s = running.processor_s() - before_s
        host_s = time.process_time() - host_s
        answered = sum(host.answered for host in hosts)
        print(
            f"{BUSES * SERVOS_A_BUS} servos on {BUSES} buses at 4 Mbit/s, {elapsed_s:.1f} s, read 1000 "
            f"times a second: each bus answered {answered / BUSES / elapsed_s:.0f} times a second whole "
            f"({sum(host.given_up for host in hosts)} answers had not come in 5 ms, the host was late "
            f"{late} times); the simulator used {spent_s / elapsed_s:.2f} of a core, "
            f"the host {host_s / elapsed_s:.2f}"
        )


def main() -> None:
    """Print both."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--transactions", type=int, default=1000)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--priority", type=int, default=0)
    parser.add_argument("--core", type=int, default=-1)
    options = parser.parse_args()
    settings = ("--priority", str(options.priority), "--core", str(options.core))
    if options.priority > 1:  # the host comes after the simulator and before everything else
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(options.priority - 1))
    if options.transactions:
        show_lateness(options.transactions, settings)
    if options.seconds:
        show_load(options.seconds, settings)


if __name__ == "__main__":
    main()
