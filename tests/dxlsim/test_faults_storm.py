"""Storms of faults: the same again from their seed; and faults of scripts that could never happen."""

from __future__ import annotations

import re
from collections import Counter
from typing import Any

import pytest

from dxlsim.bus.ledger import Ledger
from dxlsim.bus.simulated_bus import SimulatedBus
from dxlsim.faults.fault import parse_fault
from dxlsim.faults.kinds import PASSING
from dxlsim.faults.script import FaultScript
from dxlsim.simulation_plan import BusConfig, ServoConfig
from dxlsim.virtual_ports import VirtualPorts
from dxlwire.clock import VirtualClock
from dxlwire.exceptions import InputError

READ = 0x02
MS = 1_000_000


def three_buses() -> tuple[SimulatedBus, ...]:
    ledger = Ledger()
    servos = {"left": (1, 2), "right": (3,), "bare": ()}
    return tuple(
        SimulatedBus(
            BusConfig(name, 1_000_000, tuple(ServoConfig(each, "AX-12A", 2.0) for each in ids)), ledger, 0
        )
        for name, ids in servos.items()
    )


def test_all_that_could_never_happen_is_reported_at_once_and_nothing_is_planned():
    buses = three_buses()
    script = FaultScript(
        [
            parse_fault(text)
            for text in (
                "silence bus=left servo=1",
                "lose servo=1",
                "lose bus=middle servo=1",
                "lose bus=left servo=3",
                "storm bus=bare faults=3 within=1s",
                "unplug bus=right at=1s",
            )
        ]
    )
    with pytest.raises(InputError) as refused:
        script.attach(buses, now_ns=2_000 * MS)
    assert refused.value.sentences == (
        "lose servo=1: bus= is missing with 3 buses; write bus=left or bus=right or bus=bare",
        "lose bus=middle servo=1: unknown bus 'middle'; write bus=left or bus=right or bus=bare",
        "lose bus=left servo=3: bus left has no servo 3; its servos are 1, 2",
        "storm bus=bare faults=3 within=1s: bus bare has no servos; name another bus with bus=",
        "unplug bus=right at=1s: at= is in the past, 2.000 s after the start; omit at= to start it now",
    )
    assert all(bus.next_due_ns() is None for bus in buses)
    assert script.waiting == ()


def stormy(text: str, *, seed: int = 0, model: str = "AX-12A", ids: tuple[int, ...] = (1, 2, 3)) -> Any:
    """Return the ledger of 3 s in which a host reads all servos in turn while a storm blows."""
    clock, ledger = VirtualClock(0), Ledger()
    bus = SimulatedBus(
        BusConfig("main", 1_000_000, tuple(ServoConfig(each, model, 2.0) for each in ids)), ledger, 0
    )
    port = VirtualPorts(clock, (bus,)).ports[0]
    FaultScript([parse_fault(each) for each in text.splitlines()], seed).attach((bus,))
    buffer = memoryview(bytearray(4096))
    while clock.now_ns() < 3_000 * MS:
        for servo_id in ids:
            body = bytes((servo_id, 4, READ, 36, 2))
            port.write_packet(b"\xff\xff" + body + bytes((~sum(body) & 0xFF,)))
            clock.wait_until(clock.now_ns() + 5 * MS)
            port.read_into(buffer)
    return ledger.entries


def faults_of(entries: Any) -> list[str]:
    return [entry.note.removeprefix("fault: ") for entry in entries if entry.note.startswith("fault: ")]


def test_a_storm_is_the_same_again_from_its_seed():
    storm = "storm seed=7 faults=40 within=2s"
    entries = stormy(storm)
    assert entries == stormy(storm)
    assert faults_of(entries) != faults_of(stormy("storm seed=8 faults=40 within=2s"))


def test_a_storm_without_a_seed_takes_that_of_the_script():
    storm = "storm faults=10 within=2s"
    assert stormy(storm, seed=1) == stormy(storm, seed=1)
    assert faults_of(stormy(storm, seed=1)) != faults_of(stormy(storm, seed=2))


def test_a_storm_has_every_kind_that_passes_and_each_fault_is_in_the_ledger_once():
    noted = faults_of(stormy("storm seed=7 faults=100 within=2s"))
    assert {text.split()[0] for text in noted} == set(PASSING)
    assert max(Counter(noted).values()) == 1
    assert len(noted) == 100
    assert all(str(parse_fault(text)) == text for text in noted)
    assert all(0 <= (parse_fault(text).at_ns or 0) <= 2_000 * MS for text in noted)


def test_the_lines_of_a_storm_in_the_ledger_make_the_same_storm_again():
    entries = stormy("storm seed=3 faults=30 within=2s kinds=lose,corrupt,truncate,delay,silence,reboot")
    lines = sorted(faults_of(entries), key=lambda text: parse_fault(text).at_ns or 0)
    assert stormy("\n".join(lines)) == entries


def test_a_storm_has_only_the_kinds_that_it_names():
    noted = faults_of(stormy("storm seed=1 faults=12 within=1s kinds=lose,overheat at=1s"))
    assert {text.split()[0] for text in noted} == {"lose", "overheat"}
    assert all(1_000 * MS <= (parse_fault(text).at_ns or 0) <= 2_000 * MS for text in noted)


def test_a_storm_over_several_buses_names_the_bus_of_each_fault():
    left, right, _ = three_buses()
    script = FaultScript([parse_fault("storm seed=2 faults=20 within=1s")])
    script.attach((left, right))
    assert {match[1] for fault in script.waiting if (match := re.search(r"bus=(\w+)", str(fault)))} == {
        "left",
        "right",
    }
    assert all(fault.servo in (None, 3) for fault in script.waiting if fault.bus == "right")


def test_a_storm_stays_on_the_bus_that_it_names():
    script = FaultScript([parse_fault("storm bus=right seed=2 faults=20 within=1s")])
    script.attach(three_buses())
    assert {(fault.bus, fault.servo or 3) for fault in script.waiting} == {("right", 3)}
