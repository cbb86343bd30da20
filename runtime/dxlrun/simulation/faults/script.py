"""Faults of simulated buses: planned from lines of text, and entered in the ledger as they happen."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from random import Random

import msgspec

from dxlrun.errors import InputError
from dxlrun.simulation.bus.simulated_bus import SimulatedBus
from dxlrun.simulation.faults.fault import OF_DEVICES, OF_SERVOS, Fault
from dxlrun.simulation.faults.injection import Holds, Injection
from dxlrun.simulation.servo.node import SimulatedNode

PASSING = ("lose", "corrupt", "truncate", "delay", "duplicate", "noise", "silence", "babble")
"""Kinds after which everything is as it was: a storm has these when it names none."""

SHORTEST_BOOT_NS = 50_000_000  # no servo is back sooner after it lost its power [i]
_HOST_SHARE = 0.25  # so many of the packets that are lost or broken are the host's
_STEP_NS = 1000
_MS, _S = 1_000_000, 1_000_000_000


def _time_from(random: Random, shortest_ns: int, longest_ns: int) -> int:
    return random.randint(shortest_ns // _STEP_NS, longest_ns // _STEP_NS) * _STEP_NS


def _while(random: Random, shortest_ns: int = 10 * _MS, longest_ns: int = _S) -> dict[str, int]:
    return {"for_ns": _time_from(random, shortest_ns, longest_ns)}


_DRAWN: Mapping[str, Callable[[Random], Mapping[str, object]]] = {
    "lose": lambda random: {"count": random.randint(1, 5)},
    "corrupt": lambda random: {"byte": random.randint(0, 15), "flip": 1 << random.randrange(8)},
    "truncate": lambda random: {"keep": random.randint(1, 10)},
    "delay": lambda random: {"by_ns": _time_from(random, 10_000, 50 * _MS)},
    "duplicate": lambda random: {"copies": random.randint(2, 3)},
    "noise": lambda random: {"data": random.randbytes(random.randint(1, 32))},
    "silence": lambda random: _while(random, _MS),
    "babble": lambda random: _while(random, _MS, 200 * _MS) | {"size": random.randint(1, 16)},
    "reboot": lambda random: _while(random, SHORTEST_BOOT_NS, 500 * _MS),
    "brownout": lambda random: _while(random, SHORTEST_BOOT_NS, 500 * _MS),
    "voltage": lambda random: {"volts": round(random.uniform(5.0, 20.0), 1), **_while(random)},
    "other_model": lambda random: {"number": random.randint(0, 65_535), **_while(random)},
    "overload": lambda random: {},
    "overheat": _while,
    "turn": lambda random: {"by_deg": float(random.randint(-90, 90) or 1), **_while(random)},
    "duplicate_id": lambda random: {},
    "loose": lambda random: {
        "low_deg": float(low := random.randint(0, 300)),
        "high_deg": low + 30.0,
        **_while(random),
    },
    "lossy": lambda random: {"share": round(random.uniform(0.01, 0.5), 2), **_while(random)},
    "slow": lambda random: {"by_ns": _time_from(random, 10_000, 2 * _MS), **_while(random)},
    "jam": _while,
    "sag": lambda random: {"ohms": round(random.uniform(0.1, 2.0), 1), **_while(random)},
    "timer": lambda random: {"by_ns": _time_from(random, _MS, 16 * _MS), **_while(random)},
    "unplug": _while,
    "wedge": lambda random: _while(random, _MS, 500 * _MS),
}
"""What a storm draws of a kind: values by the names of a fault's fields."""
_OF_LINE = frozenset(("noise", "brownout", "sag", "timer", "unplug", "wedge"))
_OF_HOST = frozenset(("lose", "corrupt", "truncate"))


class FaultScript:
    """Faults that happen to buses at their times; what they leave open is drawn from `seed`.

    A fault that happens is a note in the ledger, `fault: ` and its text, exactly once: one of a packet
    when that packet passes, any other at its time. A storm's faults are there one by one.
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
        for one in injections:
            if one.fault.packet is not None:
                one.bus.after(one.fault.packet, one.begin)
            else:
                at_ns = one.fault.at_ns
                one.bus.at(now_ns if at_ns is None else self._start_ns + at_ns, one.begin)
        self._injections += injections

    @property
    def waiting(self) -> tuple[Fault, ...]:
        """Faults that have not happened, so far or for ever: a servo that is not read loses no reply."""
        return tuple(each.fault for each in self._injections if not each.happened)

    def _placed(self, fault: Fault, index: int, since_ns: int) -> list[Injection]:
        chosen = _chosen(fault, self._buses)
        if fault.at_ns is not None and fault.at_ns < since_ns:
            raise InputError(f"it is {since_ns / 1e9:.3f} s after the start already; leave at= out for now")
        random = self._random(fault, index)
        if fault.kind != "storm":
            return [Injection(fault, chosen[0], random, self._holds)]
        drawn = _storm(fault, chosen, since_ns, random)
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
        raise InputError(f"there are {len(chosen)} buses; choose one: {names}")
    for bus in chosen:
        ids = sorted({servo.servo_id for servo in bus.servos})
        others = sorted({device.servo_id for device in bus.devices} - set(ids))
        if fault.servo in others and fault.kind in OF_SERVOS:
            raise InputError(
                f"{fault.servo} on bus {bus.name} is no servo, so {fault.kind} cannot happen to it"
            )
        if fault.servo in ids and fault.kind in OF_DEVICES:
            raise InputError(
                f"{fault.servo} on bus {bus.name} is a servo, so {fault.kind} cannot happen to it"
            )
        if fault.servo is not None and fault.servo not in (*ids, *others):
            known = f"its servos are {', '.join(map(str, ids))}" if ids else "it has none"
            known += f", its other devices {', '.join(map(str, others))}" if others else ""
            raise InputError(f"bus {bus.name} has no servo {fault.servo}; {known}")
        if fault.kind == "storm" and not ids:
            raise InputError(f"bus {bus.name} has no servos; name another one with bus=")
    return chosen


def _storm(storm: Fault, buses: Sequence[SimulatedBus], since_ns: int, random: Random) -> tuple[Fault, ...]:
    """Return the faults of a storm in the order of their times; without `at=` it starts at `since_ns`.

    Each names its bus where there are several, its servo, and its time: its text alone repeats it.
    """
    kinds = storm.kinds or PASSING
    begin_ns = since_ns if storm.at_ns is None else storm.at_ns
    steps = (storm.within_ns or 0) // _STEP_NS
    drawn = []
    for _ in range(storm.faults or 0):
        kind = random.choice(kinds)
        bus = random.choice(buses)
        given = dict(_DRAWN[kind](random))
        if kind in _OF_HOST and random.random() < _HOST_SHARE:
            given["host"] = True
        elif kind not in _OF_LINE:
            victims: Sequence[SimulatedNode] = bus.servos if kind in OF_SERVOS else bus.nodes
            given["servo"] = random.choice(victims).servo_id
        given["at_ns"] = begin_ns + random.randint(0, steps) * _STEP_NS
        given["bus"] = bus.name if len(buses) > 1 else storm.bus
        drawn.append(msgspec.convert({"kind": kind, **given}, Fault))
    return tuple(sorted(drawn, key=lambda fault: fault.at_ns or 0))
