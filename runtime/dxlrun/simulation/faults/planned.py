"""Faults of simulated buses: planned from lines of text, and entered in the ledger as they happen."""

from __future__ import annotations

from collections.abc import Sequence
from random import Random

from dxlrun.errors import InputError
from dxlrun.simulation.bus.simulated_bus import SimulatedBus
from dxlrun.simulation.faults.fault_kinds import Holds, Injection
from dxlrun.simulation.faults.fault_text import Fault, fault_help, parse_fault
from dxlrun.simulation.faults.storm import members

__all__ = ["Fault", "FaultScript", "fault_help", "parse_fault"]


class FaultScript:
    """Faults that happen to buses at their times; what they leave open is drawn from `seed`.

    A fault that happens stands in the ledger as a note, `fault: ` and its text, exactly once: one of a packet
    when that packet passes, any other at its time. A storm's faults stand there one by one.
    """

    def __init__(self, faults: Sequence[Fault], seed: int = 0) -> None:
        self._faults = tuple(faults)
        self._seed = seed
        self._buses: Sequence[SimulatedBus] = ()
        self._start_ns = 0
        self._lines = 0
        self._injections: list[Injection] = []
        self._holds: Holds = {}

    def attach(self, buses: Sequence[SimulatedBus], *, start_ns: int = 0, now_ns: int | None = None) -> None:
        """Plan every fault on its bus; those without a time happen at `now_ns`, at `start_ns` when None.

        `start_ns` is when the simulation started, on the clock of the buses. Raises InputError with one
        sentence for each fault that could never happen; then none is planned.
        """
        self._buses, self._start_ns = tuple(buses), start_ns
        self._plan(self._faults, start_ns if now_ns is None else now_ns)

    def add(self, fault: Fault, now_ns: int) -> None:
        """Plan one more fault on the attached buses, by hand; without a time it happens at `now_ns`.

        Raises InputError with one sentence when it could never happen.
        """
        self._plan((fault,), now_ns)

    def _plan(self, faults: Sequence[Fault], now_ns: int) -> None:
        injections: list[Injection] = []
        wrong: list[str] = []
        for index, fault in enumerate(faults, start=self._lines):
            try:
                injections += self._placed(fault, index, now_ns - self._start_ns)
            except InputError as error:
                wrong.append(f"{fault}: {error}")
        if wrong:
            raise InputError("\n".join(wrong))
        self._lines += len(faults)
        for injection in injections:
            _place(injection, self._start_ns, now_ns)
        self._injections += injections

    @property
    def waiting(self) -> tuple[Fault, ...]:
        """Faults that have not happened, so far or for ever: a servo that is not asked loses no reply."""
        return tuple(each.fault for each in self._injections if not each.happened)

    def _placed(self, fault: Fault, index: int, since_ns: int) -> list[Injection]:
        """Return what a line stands for; raises InputError when it could not happen."""
        chosen = _chosen(fault, self._buses)
        if fault.at_ns is not None and fault.at_ns < since_ns:
            raise InputError(f"it is {since_ns / 1e9:.3f} s after the start already; leave at= out for now")
        random = self._random(fault, index)
        if fault.kind != "storm":
            return [Injection(fault, chosen[0], random, self._holds)]
        drawn = members(fault, chosen, since_ns, random)
        return [
            Injection(each, _chosen(each, self._buses)[0], self._random(each, number), self._holds)
            for number, each in enumerate(drawn)
        ]

    def _random(self, fault: Fault, index: int) -> Random:
        seed = self._seed if fault.seed is None else fault.seed
        return Random(f"{seed} {index} {fault}")


def _chosen(fault: Fault, buses: Sequence[SimulatedBus]) -> Sequence[SimulatedBus]:
    """Return the bus that is meant, for a storm without one all; raises InputError when nothing is there."""
    names = " or ".join(f"bus={bus.name}" for bus in buses)
    chosen = [bus for bus in buses if fault.bus in (None, bus.name)]
    if not chosen:
        raise InputError(f"there is no bus {fault.bus!r}; write {names}")
    if len(chosen) > 1 and fault.kind != "storm":
        raise InputError(f"there are {len(chosen)} buses; say which one: {names}")
    for bus in chosen:
        ids = sorted({servo.servo_id for servo in bus.servos})
        if fault.servo is not None and fault.servo not in ids:
            known = f"its servos are {', '.join(map(str, ids))}" if ids else "it has none"
            raise InputError(f"bus {bus.name} has no servo {fault.servo}; {known}")
        if fault.kind == "storm" and not ids:
            raise InputError(f"bus {bus.name} has no servos; name another one with bus=")
    return chosen


def _place(injection: Injection, start_ns: int, now_ns: int) -> None:
    fault, bus = injection.fault, injection.bus
    if fault.packet is not None:
        bus.after(fault.packet, injection.begin)
    elif fault.at_ns is not None:
        bus.at(start_ns + fault.at_ns, injection.begin)
    else:
        bus.at(now_ns, injection.begin)
