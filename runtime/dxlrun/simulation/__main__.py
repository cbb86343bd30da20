"""`python -m dxlrun.simulation`: the process of the simulated buses, one pseudo-terminal each, in real time.

It runs until the other end of the control socket is closed. It sends the ports when it is ready, or an error
and ends; then it answers requests, and reports each fault as it happens and the ports when they changed:
`dxlrun.simulation.messages`.
"""

from __future__ import annotations

import argparse
import os
import signal
import socket
import sys
from collections.abc import Sequence
from pathlib import Path

from dxlrun.channels import slot
from dxlrun.channels.slot import SlotWriter
from dxlrun.dynamixel.control_table import add_control_table
from dxlrun.errors import DxlrunError
from dxlrun.plan.simulation_plan import decode_config
from dxlrun.simulation import realtime
from dxlrun.simulation.bus.ledger import Ledger
from dxlrun.simulation.messages import SimulationMessage
from dxlrun.simulation.server import ControlLine, Server


def main(arguments: Sequence[str] | None = None) -> int:
    """Serve the buses of a configuration until the control socket ends or SIGTERM comes.

    Return 0, 1 when the ledger could not be written, 2 when the configuration cannot be served.
    """
    options = _options(arguments)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # only the front process takes it
    with os.fdopen(options.config_fd, "rb") as file:
        config = decode_config(file.read())
    for text in dict.fromkeys(text for bus in config.buses for text in bus.control_tables):
        add_control_table(text)
    with socket.socket(fileno=options.control_fd) as control, Ledger(options.ledger, keep=False) as ledger:
        line = ControlLine(control)
        try:
            shafts = None if options.shafts_fd < 0 else SlotWriter(slot.shared(options.shafts_fd))
            server = Server(config, ledger, line, shafts)
        except (DxlrunError, OSError, LookupError, ValueError) as error:
            line.send(SimulationMessage(error=str(error)))
            return 2
        granted = realtime.prepare(options.priority, options.core)
        if options.priority or options.core >= 0:
            ledger.add(server.start_ns, "", "note", note=f"real time: {granted}")
        server.run(granted)
    if ledger.error is None:
        return 0
    print(ledger.error, file=sys.stderr)
    return 1


def _options(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="dxlrun.simulation", description="Simulated buses on pseudo-terminals."
    )
    parser.add_argument("--config-fd", type=int, required=True, help="a JSON configuration; read to its end")
    parser.add_argument(
        "--control-fd", type=int, required=True, help="socket: receives the ports; its end ends the run"
    )
    parser.add_argument(
        "--ledger", type=Path, default=None, help="JSON-lines file of every byte on the buses"
    )
    parser.add_argument("--priority", type=int, default=0, help="real-time priority, 1 to 99; 0: none")
    parser.add_argument("--shafts-fd", type=int, default=-1, help="slot for how the shafts move; -1: none")
    parser.add_argument("--core", type=int, default=-1, help="core to stay on; -1: any")
    return parser.parse_args(arguments)


if __name__ == "__main__":
    sys.exit(main())
