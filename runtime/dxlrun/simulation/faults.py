"""Faults of simulated buses: planned from lines of text, and entered in the ledger as they happen."""

from __future__ import annotations

from collections.abc import Sequence

from dxlrun.simulation.bus import SimulatedBus
from dxlrun.simulation.fault_text import Fault, fault_help, parse_fault

__all__ = ["Fault", "FaultScript", "fault_help", "parse_fault"]


class FaultScript:
    """Faults that happen to buses at their times; the random ones among them are drawn from `seed`."""

    def __init__(self, faults: Sequence[Fault], seed: int = 0) -> None:
        self._faults = tuple(faults)
        self._seed = seed

    def attach(self, buses: Sequence[SimulatedBus], *, start_ns: int = 0, now_ns: int | None = None) -> None:
        """Plan every fault on its bus; those without a time happen at `now_ns`, at `start_ns` when None.

        `start_ns` is when the simulation started, on the clock of the buses. Raises InputError with one
        sentence for each fault that could never happen; then none is planned.
        """
