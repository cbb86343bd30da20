"""Guardian: the last hand on the ports.

A small process, one priority above the loop. It opens, locks and keeps the ports' descriptors, executes the
loop's process on them as its child, and watches that child: by its pidfd, which tells at once that it ended,
and by its heartbeat, which tells that it hangs. A loop that is gone before it reported DONE, or that stands
still, is killed and reaped, and then every servo is made limp with the packets that the plan prepared.
"""

from __future__ import annotations

import os
import select
import signal
import socket
import subprocess
import sys
from dataclasses import dataclass
from typing import Literal

import msgspec

from dxlrun import process
from dxlrun.clock import MonotonicClock
from dxlrun.control.realtime import set_policy
from dxlrun.dynamixel.bus_plan import BusPlan
from dxlrun.dynamixel.limp import limp
from dxlrun.dynamixel.port import SerialPort, SerialPorts
from dxlrun.dynamixel.serial_open import open_serial
from dxlrun.errors import PortError
from dxlrun.events import EventCode, EventRing, Severity
from dxlrun.heartbeat import Heartbeat, Phase
from dxlrun.packets import PacketBatch, salvage
from dxlrun.ring import RingWriter

SILENT_PERIODS = 5
"""A running loop whose counter stands still this long hangs."""
LEAST_PATIENCE_NS = 50_000_000
"""At high rates a few periods are less than a stock kernel's worst wake-up (thesis: 17 ms)."""
SETUP_PATIENCE_NS = 1_000_000_000
"""Set-up and shutdown beat once a transaction; a transaction ends within milliseconds."""

Ending = Literal["done", "died", "hung", "cut"]


@dataclass(frozen=True, slots=True)
class GuardianJob:
    """What the guardian is given: buses, patience, and the descriptors that it and the loop inherit."""

    buses: tuple[BusPlan, ...]
    ports: tuple[str, ...]
    """Device paths, in the order of `buses`; a simulated bus has its pseudo-terminal here."""
    period_ns: int
    priority: int
    """Real-time priority of the guardian; 0: none."""
    heartbeat: int
    packets: int
    desk: int
    """The loop's unfinished batch of packets."""
    events: int
    stderr: int
    loop: dict[str, object]
    """The loop's job, but for its port descriptors."""
    loop_descriptors: tuple[int, ...]


class Guardian:
    """Watches one loop process from its start to its end."""

    def __init__(self, job: GuardianJob, control: process.Line) -> None:
        self._job = job
        self._control = control
        self._clock = MonotonicClock()
        self._heartbeat = Heartbeat(job.heartbeat)
        self._ring = RingWriter(job.packets)
        self._packets = PacketBatch(self._ring)
        self._events = EventRing(RingWriter(job.events), self._clock)
        self._patience_ns = max(SILENT_PERIODS * job.period_ns, LEAST_PATIENCE_NS)

    def run(self) -> None:
        """Open the ports, execute the loop, watch it, and see that the robot is limp when it is gone."""
        opened = [
            open_serial(path, bus.baud_rate)
            for path, bus in zip(self._job.ports, self._job.buses, strict=True)
        ]
        descriptors = [port.fileno() for port in opened]
        job = self._job.loop | {"ports": descriptors}
        loop = process.start(
            "dxlrun.loop_process",
            ["--job", msgspec.json.encode(job).decode()],
            [*self._job.loop_descriptors, *descriptors],
            self._job.stderr,
        )
        self._control.send({"loop": loop.pid})
        if self._job.priority:
            set_policy("round_robin", self._job.priority)
        ending = self._watch(loop)
        if ending == "done":
            self._control.send({"ended": ending, "outcome": []})
            return
        ports = SerialPorts(
            [
                SerialPort(descriptor, path)
                for descriptor, path in zip(descriptors, self._job.ports, strict=True)
            ]
        )
        self._make_limp(loop, ending, ports)

    def _watch(self, loop: subprocess.Popen[bytes]) -> Ending:
        """Return how the loop ended; it is dead and reaped then."""
        watched = os.pidfd_open(loop.pid)
        nap = min(self._job.period_ns, 10_000_000) * 1e-9
        beats, since = self._heartbeat.beats, self._clock.now_ns()
        ending: Ending = "died"
        while True:
            ready, _, _ = select.select(self._watched(watched), [], [], nap)
            if watched in ready:
                code = loop.wait()
                return "done" if self._heartbeat.phase is Phase.DONE and code in (0, 1) else ending
            if self._control.fileno() in ready and self._obey(loop):
                ending = "cut"
            now = self._clock.now_ns()
            if self._heartbeat.beats != beats:
                beats, since = self._heartbeat.beats, now
            elif now - since > self._patience(self._heartbeat.phase) and ending == "died":
                ending = "hung"
                loop.kill()

    def _watched(self, pidfd: int) -> list[int]:
        """Return what can wake the guardian; a terminal that is gone would wake it for ever."""
        return [pidfd] if self._control.closed else [pidfd, self._control.fileno()]

    def _patience(self, phase: Phase) -> float:
        """Return how long the counter may stand still, ns."""
        if phase is Phase.RUNNING:
            return self._patience_ns
        return SETUP_PATIENCE_NS if phase in (Phase.SETUP, Phase.STOPPING) else float("inf")

    def _obey(self, loop: subprocess.Popen[bytes]) -> bool:
        """Carry out what the terminal asks; return True when torque is to be cut at once."""
        messages = self._control.receive()
        if any("cut" in message for message in messages):
            loop.kill()
            return True
        if messages or self._control.closed:  # a terminal that is gone cannot ask any more: stop in order
            loop.send_signal(signal.SIGTERM)
        return False

    def _make_limp(self, loop: subprocess.Popen[bytes], ending: Ending, ports: SerialPorts) -> None:
        """Send torque off to every servo, and tell the log and the terminal what came of it."""
        salvage(process.shared_memory(self._job.desk), self._ring)
        outcome = limp(self._job.buses, ports, self._clock, self._packets)
        self._packets.commit()
        how = {
            "died": f"the loop's process ended by itself ({_manner(loop.returncode)})",
            "hung": f"the loop stood still for more than {self._patience_ns / 1e6:.0f} ms and was killed",
            "cut": "torque was cut on request",
            "done": "",
        }[ending]
        silent = [str(one) for one in outcome if not one.confirmed]
        result = (
            f"torque off was confirmed by all {len(outcome)} servos"
            if not silent
            else f"torque off was sent, but not confirmed by {', '.join(silent)}"
        )
        severity = Severity.ERROR if silent or ending != "cut" else Severity.WARNING
        self._events.emit(EventCode.GUARDIAN, severity, "guardian", f"{how}; {result}")
        self._control.send({"ended": ending, "outcome": [how, result]})


def _manner(code: int | None) -> str:
    """Say how a process ended."""
    if code is not None and code < 0:
        return f"signal {signal.Signals(-code).name}"
    return f"exit code {code}"


def main() -> None:
    """Run the guardian's process: `--job-fd N --control-fd M`."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    job_descriptor, control_descriptor = int(sys.argv[2]), int(sys.argv[4])
    job = msgspec.json.decode(process.whole(job_descriptor), type=GuardianJob)
    control = process.Line(socket.socket(fileno=control_descriptor))
    try:
        Guardian(job, control).run()
    except PortError as error:
        control.send({"error": str(error)})
        sys.exit(error.exit_code)


if __name__ == "__main__":
    main()
