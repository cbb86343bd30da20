"""The simulated servos that hosts are measured against: real wire times, and a ledger of their lateness."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType

import msgspec

from dxlrun.errors import ProcessFault
from dxlrun.run.channels import process
from dxlrun.run.channels.child import Child
from dxlrun.simulation import BusConfig, encode_config

_PRIORITY = 33
"""As in a run: a servo's electronics do not wait for the host's processor."""


class SimulatedServos:
    """The process of the simulated buses, one a host; its ledger is whole when it was left."""

    def __init__(self, buses: Sequence[BusConfig], core: int, ledger: Path) -> None:
        self._errors = process.memory_file("dxlrun-bench-stderr")
        config = process.memory_file("dxlrun-bench", encode_config(buses))
        words = ["--config-fd", str(config), "--core", str(core), "--priority", str(_PRIORITY)]
        try:
            self._child = Child(
                "simulated bus",
                "dxlrun.simulation",
                [*words, "--ledger", str(ledger)],
                [config],
                self._errors,
            )
        finally:
            os.close(config)
        ports = msgspec.convert(self._child.ready()["ports"], type=dict[str, str])
        self.ports = tuple(ports[bus.name] for bus in buses)
        """The devices, in the order of the buses."""

    def __enter__(self) -> SimulatedServos:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._child.end()
        told = process.whole(self._errors).decode(errors="replace").strip()
        os.close(self._errors)
        if error is None and self._child.process.returncode:
            raise ProcessFault(f"the simulated bus ended: {told.splitlines()[-1] if told else 'no word'}")
