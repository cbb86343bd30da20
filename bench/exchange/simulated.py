"""The simulated servos that hosts are measured against: real wire times, and a ledger of their lateness."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType

from dxlrun.channels import child_processes
from dxlrun.errors import ProcessFault
from dxlrun.run.simulation_front import first_message, start_simulation
from dxlsim.messages import SimulationJob
from dxlsim.simulation_plan import BusConfig, SimulationConfig

_PRIORITY = 33
"""As in a run: a servo's electronics do not wait for the host's processor."""


class SimulatedServos:
    """The process of the simulated buses, one a host; its ledger is whole when it was left."""

    def __init__(self, buses: Sequence[BusConfig], core: int, ledger: Path) -> None:
        self._errors = child_processes.memory_file("dxlrun-bench-stderr")
        self._child = start_simulation(
            SimulationJob(SimulationConfig(tuple(buses)), str(ledger), _PRIORITY, core), self._errors
        )
        ports = first_message(self._child).ports or {}
        self.ports = tuple(ports[bus.name] for bus in buses)
        """The devices, in the order of the buses."""

    def __enter__(self) -> SimulatedServos:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._child.end_process()
        printed = child_processes.whole(self._errors).decode(errors="replace").strip()
        os.close(self._errors)
        if error is None and self._child.process.returncode:
            raise ProcessFault(
                f"the simulated bus ended: {printed.splitlines()[-1] if printed else 'no output'}"
            )
