"""A storm: many faults drawn from a seed, so that one line is a campaign that can be repeated."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from random import Random

from dxlrun.simulation.bus.simulated_bus import SimulatedBus
from dxlrun.simulation.faults.fault_text import Fault

PASSING: tuple[str, ...] = (
    "lose",
    "corrupt",
    "truncate",
    "delay",
    "duplicate",
    "noise",
    "silence",
    "babble",
)
"""Kinds after which everything is as it was: a storm has these when it names none."""

SHORTEST_BOOT_NS = 50_000_000
"""No servo is back sooner after it lost its power [i]."""
_HOST_SHARE = 0.25
"""So many of the packets that are lost or broken are the host's."""
_STEP_NS = 1000
_GIVEN: Mapping[str, Callable[[Random], Fault]] = {
    "lose": lambda random: Fault(kind="lose", count=random.randint(1, 5)),
    "corrupt": lambda random: Fault(
        kind="corrupt", byte=random.randint(0, 15), flip=1 << random.randrange(8)
    ),
    "truncate": lambda random: Fault(kind="truncate", keep=random.randint(1, 10)),
    "delay": lambda random: Fault(kind="delay", by_ns=_some_ns(random, 10_000, 50_000_000)),
    "duplicate": lambda random: Fault(kind="duplicate", copies=random.randint(2, 3)),
    "noise": lambda random: Fault(kind="noise", data=random.randbytes(random.randint(1, 32))),
    "silence": lambda random: Fault(kind="silence", for_ns=_some_ns(random, 1_000_000, 1_000_000_000)),
    "babble": lambda random: Fault(
        kind="babble", for_ns=_some_ns(random, 1_000_000, 200_000_000), size=random.randint(1, 16)
    ),
    "reboot": lambda random: Fault(kind="reboot", for_ns=_some_ns(random, SHORTEST_BOOT_NS, 500_000_000)),
    "brownout": lambda random: Fault(kind="brownout", for_ns=_some_ns(random, SHORTEST_BOOT_NS, 500_000_000)),
    "voltage": lambda random: Fault(
        kind="voltage", volts=round(random.uniform(5.0, 20.0), 1), for_ns=_some_ns(random, 10_000_000, 10**9)
    ),
    "overload": lambda random: Fault(kind="overload"),
    "overheat": lambda random: Fault(kind="overheat", for_ns=_some_ns(random, 10_000_000, 10**9)),
    "turn": lambda random: Fault(
        kind="turn", by_deg=float(random.randint(-90, 90) or 1), for_ns=_some_ns(random, 10_000_000, 10**9)
    ),
    "duplicate_id": lambda random: Fault(kind="duplicate_id"),
    "unplug": lambda random: Fault(kind="unplug", for_ns=_some_ns(random, 10_000_000, 10**9)),
    "wedge": lambda random: Fault(kind="wedge", for_ns=_some_ns(random, 1_000_000, 500_000_000)),
}
_OF_LINE: frozenset[str] = frozenset(("noise", "brownout", "unplug", "wedge"))
_OF_HOST: frozenset[str] = frozenset(("lose", "corrupt", "truncate"))


def members(storm: Fault, buses: Sequence[SimulatedBus], since_ns: int, random: Random) -> tuple[Fault, ...]:
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
        fault = _GIVEN[kind](random)
        if kind in _OF_HOST and random.random() < _HOST_SHARE:
            fault = replace(fault, host=True)
        elif kind not in _OF_LINE:
            fault = replace(fault, servo=random.choice(bus.servos).servo_id)
        at_ns = begin_ns + random.randint(0, steps) * _STEP_NS
        drawn.append(replace(fault, bus=bus.name if len(buses) > 1 else storm.bus, at_ns=at_ns))
    return tuple(sorted(drawn, key=_time))


def _some_ns(random: Random, shortest_ns: int, longest_ns: int) -> int:
    return random.randint(shortest_ns // _STEP_NS, longest_ns // _STEP_NS) * _STEP_NS


def _time(fault: Fault) -> int:
    return fault.at_ns or 0
