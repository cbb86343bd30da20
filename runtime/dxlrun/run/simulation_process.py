"""Simulation process: the simulated buses in real time, each on a socket of its host or on a
pseudo-terminal.

It runs until the other end of the control socket is closed. It first sends the ports, or sends an error and
exits. Then it answers requests, and reports each fault and each change of the ports: `dxlsim.messages`.
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path

from msgspec.json import Decoder

from dxlrun.channels import child_processes
from dxlrun.channels.heartbeat import SimulationProgress
from dxlrun.channels.shared_memory import mapped
from dxlrun.channels.slot import SlotWriter
from dxlrun.errors import DxlrunError
from dxlrun.log.ledger_file import open_ledger
from dxlsim.bus.recording import RecordedPackets
from dxlsim.messages import SimulationJob, SimulationMessage, SimulationRequest
from dxlsim.serving import realtime_serving
from dxlsim.serving.simulation_server import Server, wake_on_signals
from dxlsim.simulation_plan import BusConfig
from dxlwire.control_table import add_control_table


def main() -> int:
    """Serve the buses of a job until the control socket closes or SIGTERM comes: `--job-fd N --control-fd M`.

    Return 0, 1 when the ledger could not be written, 2 when the configuration cannot be served.
    """
    job, starter = child_processes.begun(SimulationJob, Decoder(SimulationRequest))
    for text in dict.fromkeys(text for bus in job.config.buses for text in bus.control_tables):
        add_control_table(text)
    with (
        wake_on_signals(signal.SIGTERM) as wake,  # until the ledger is written
        open_ledger(Path(job.ledger) if job.ledger else None) as ledger,
    ):
        try:
            shafts = None if job.shafts < 0 else SlotWriter(mapped(job.shafts))
            progress = None if job.progress < 0 else SimulationProgress(job.progress)
            recordings = read_recordings(job.config.buses)
            server = Server(
                job.config,
                ledger,
                starter,
                shafts=shafts,
                progress=progress,
                recordings=recordings,
                sockets=job.sockets,
            )
        except (DxlrunError, OSError, LookupError, ValueError) as error:
            starter.send_message(SimulationMessage(error=str(error)))
            return 2
        granted = realtime_serving.prepare_process(job.priority, job.core)
        if job.priority or job.core >= 0:
            ledger.add(server.start_ns, "", "note", note=f"real time: {granted}")
        server.serve_ports(granted, wake.fileno())
    if ledger.error is None:
        return 0
    print(ledger.error, file=sys.stderr)
    return 1


def read_recordings(buses: Iterable[BusConfig]) -> Mapping[str, RecordedPackets]:
    """Return the recorded packets of buses that replay a log. Raises LogError."""
    recorded = [bus for bus in buses if bus.recorded]
    if not recorded:
        return {}
    from dxlrun.log.recorded_packets import (
        # Imported here because no other simulation reads a log.
        read_recorded_packets,
    )

    return {bus.name: read_recorded_packets(Path(bus.recorded), bus.name) for bus in recorded}


if __name__ == "__main__":
    sys.exit(main())
