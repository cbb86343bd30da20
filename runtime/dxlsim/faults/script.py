"""Fault script: plans faults on simulated buses and enters them in the ledger when they happen."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from keyword import iskeyword
from random import Random

from dxlsim.bus.simulated_bus import SimulatedBus
from dxlsim.faults.fault import Fault
from dxlsim.faults.kinds import DEVICE, KINDS, SERVO, WHEN, Happening, Holds
from dxlsim.faults.values import Value
from dxlwire.exceptions import InputError


class FaultScript:
    """Faults to inject into simulated buses at their times; values that a fault leaves open are drawn from
    `seed`.

    A fault that happens adds exactly one note to the ledger, `fault: ` and its text: a fault of a packet
    when that packet passes, any other fault at its time. Each fault of a storm has a note of its own."""

    def __init__(self, faults: Sequence[Fault], seed: int = 0) -> None:
        self._faults = tuple(faults)
        self._seed = seed
        self._buses: Sequence[SimulatedBus] = ()
        self._start_ns = 0
        self._lines = 0
        self._planned: list[tuple[Fault, Happening]] = []
        self._holds: Holds = {}

    def attach(self, buses: Sequence[SimulatedBus], *, start_ns: int = 0, now_ns: int | None = None) -> None:
        """Plan every fault of the script on its bus.

        Args:
            buses: The buses.
            start_ns: Start of the simulation, on the clock of the buses.
            now_ns: Time of the faults without a time; None: `start_ns`.

        Raises:
            InputError: A fault can never happen. The message has one sentence per fault, and no fault is
                planned.
        """
        self._buses, self._start_ns = tuple(buses), start_ns
        self._plan(self._faults, start_ns if now_ns is None else now_ns)

    def add(self, fault: Fault, now_ns: int) -> None:
        """Plan one more fault on the attached buses, during the simulation.

        Args:
            fault: The fault.
            now_ns: Time of a fault without a time.

        Raises:
            InputError: The fault can never happen; the message is one sentence.
        """
        self._plan((fault,), now_ns)

    def _plan(self, faults: Sequence[Fault], now_ns: int) -> None:
        planned: list[tuple[Fault, Happening]] = []
        wrong: list[str] = []
        for index, fault in enumerate(faults, start=self._lines):
            try:
                planned += self._placed(fault, index, now_ns - self._start_ns)
            except InputError as error:
                wrong.append(f"{fault}: {error}")
        if wrong:
            raise InputError("\n".join(wrong))
        self._lines += len(faults)
        for fault, happening in planned:
            begin = _action(fault, happening)
            if (packet := fault.number("packet")) is not None:
                happening.bus.after(packet, begin)
            else:
                at_ns = fault.at_ns
                happening.bus.at(now_ns if at_ns is None else self._start_ns + at_ns, begin)
        self._planned += planned

    @property
    def waiting(self) -> tuple[Fault, ...]:
        """Faults that have not happened yet, and possibly never will: a servo that is not read loses no
        reply."""
        return tuple(fault for fault, happening in self._planned if not happening.happened)

    def _placed(self, fault: Fault, index: int, since_ns: int) -> list[tuple[Fault, Happening]]:
        """Return a fault with the object that does it on its bus, or all faults of a storm in the order of
        their times.

        Each fault of a storm names its bus (if there are several), its servo and its time, so that its
        text alone reproduces it. Without `at=` a storm starts at `since_ns`."""
        buses = _chosen(fault, self._buses)
        if fault.at_ns is not None and fault.at_ns < since_ns:
            raise InputError(
                f"at= is in the past, {since_ns / 1e9:.3f} s after the start; omit at= to start it now"
            )
        random = self._random(fault, index)
        if fault.kind != "storm":
            return [(fault, Happening(fault.kind, str(fault), buses[0], random, self._holds))]
        drawn: list[tuple[SimulatedBus, Fault]] = []

        def strike(bus: SimulatedBus, kind: str, given: dict[str, Value]) -> None:
            name = bus.name if len(buses) > 1 else fault.bus
            drawn.append((bus, Fault(kind, given if name is None else {**given, "bus": name})))

        begin_ns = since_ns if fault.at_ns is None else fault.at_ns
        _action(fault, strike, random=random, buses=buses, begin_ns=begin_ns)()
        drawn.sort(key=lambda one: one[1].at_ns or 0)
        return [
            (each, Happening(each.kind, str(each), bus, self._random(each, number), self._holds))
            for number, (bus, each) in enumerate(drawn)
        ]

    def _random(self, fault: Fault, index: int) -> Random:
        seed = fault.number("seed")
        return Random(f"{self._seed if seed is None else seed} {index} {fault}")


def _action(fault: Fault, first: object, **others: object) -> Callable[[], None]:
    """Return a function that does a fault: it calls the function of the kind with the values of the line."""
    named = {f"{key}_" if iskeyword(key) else key: value for key, value in fault.given.items()}
    return partial(
        KINDS[fault.kind].act, first, **{key: named[key] for key in named if key not in WHEN}, **others
    )


def _chosen(fault: Fault, buses: Sequence[SimulatedBus]) -> Sequence[SimulatedBus]:
    """Return the bus on which a fault happens, or all buses for a storm that names none.

    Raises:
        InputError: The bus or the servo does not exist, the fault cannot happen to that device, or it names
            no bus although there are several.
    """
    names = " or ".join(f"bus={bus.name}" for bus in buses)
    chosen = [bus for bus in buses if fault.bus in (None, bus.name)]
    if not chosen:
        raise InputError(f"unknown bus {fault.bus!r}; write {names}")
    if len(chosen) > 1 and fault.kind != "storm":
        raise InputError(f"bus= is missing with {len(chosen)} buses; write {names}")
    of = KINDS[fault.kind].of
    for bus in chosen:
        ids = sorted({servo.servo_id for servo in bus.servos})
        others = sorted({device.servo_id for device in bus.devices} - set(ids))
        if (fault.servo in others and of == SERVO) or (fault.servo in ids and of == DEVICE):
            what = "not a servo" if of == SERVO else "a servo"
            raise InputError(
                f"{fault.kind} is not possible: {fault.servo} on bus {bus.name} is {what}; choose another ID"
            )
        if fault.servo is not None and fault.servo not in (*ids, *others):
            known = f"its servos are {', '.join(map(str, ids))}" if ids else "the bus has no servos"
            known += f", its other devices {', '.join(map(str, others))}" if others else ""
            raise InputError(f"bus {bus.name} has no servo {fault.servo}; {known}")
        if fault.kind == "storm" and not ids:
            raise InputError(f"bus {bus.name} has no servos; name another bus with bus=")
    return chosen
