"""Storms of faults: the same again from their seed; and faults of scripts that could never happen."""

from __future__ import annotations

from collections import Counter

import pytest
from tests.kit.simulated_line import Line

from dxlsim.bus.ledger import Ledger, LedgerEntry
from dxlsim.bus.simulated_bus import SimulatedBus
from dxlsim.faults.fault import parse_fault
from dxlsim.faults.kinds import PASSING
from dxlsim.faults.script import FaultScript
from dxlsim.simulation_plan import BusConfig, ServoConfig
from dxlwire.exceptions import InputError

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
    refusals = {
        "silence bus=left servo=1": "",
        "lose servo=1": "bus= is missing with 3 buses; write bus=left or bus=right or bus=bare",
        "lose bus=middle servo=1": "unknown bus 'middle'; write bus=left or bus=right or bus=bare",
        "lose bus=left servo=3": "bus left has no servo 3; its servos are 1, 2",
        "storm bus=bare faults=3 within=1s": "bus bare has no servos; name another bus with bus=",
        "unplug bus=right at=1s": "at= is in the past, 2.000 s after the start; omit at= to start it now",
    }
    script = FaultScript([parse_fault(text) for text in refusals])
    with pytest.raises(InputError) as refused:
        script.attach(buses, now_ns=2_000 * MS)
    assert refused.value.sentences == tuple(f"{text}: {why}" for text, why in refusals.items() if why)
    assert all(bus.next_due_ns() is None for bus in buses)
    assert script.waiting == ()


def stormy(text: str, *, seed: int = 0) -> tuple[list[LedgerEntry], list[str]]:
    """Return ledger and faults of 3 s in which a host reads all servos in turn while a storm blows."""
    line = Line("AX-12A", 1, 2, 3)
    line.inject(*text.splitlines(), seed=seed)
    port, buffer = line.ports.ports[0], memoryview(bytearray(4096))
    while line.clock.now_ns() < 3_000 * MS:
        for servo_id in (1, 2, 3):
            line.instruct(servo_id, 0x02, bytes((36, 2)))
            line.clock.wait_until(line.clock.now_ns() + 5 * MS)
            port.read_into(buffer)
    return line.ledger.entries, line.faults


def test_a_storm_is_the_same_again_from_its_seed_or_that_of_the_script():
    storm = "storm seed=7 faults=40 within=2s"
    assert stormy(storm) == stormy(storm)
    assert stormy(storm)[1] != stormy("storm seed=8 faults=40 within=2s")[1]
    storm = "storm faults=10 within=2s"
    assert stormy(storm, seed=1) == stormy(storm, seed=1)
    assert stormy(storm, seed=1)[1] != stormy(storm, seed=2)[1]


def test_a_storm_has_every_kind_that_passes_and_each_fault_is_in_the_ledger_once():
    _, noted = stormy("storm seed=7 faults=100 within=2s")
    assert {text.split(maxsplit=1)[0] for text in noted} == set(PASSING)
    assert max(Counter(noted).values()) == 1
    assert len(noted) == 100
    assert all(str(parse_fault(text)) == text for text in noted)
    assert all(0 <= (parse_fault(text).at_ns or 0) <= 2_000 * MS for text in noted)


def test_the_lines_of_a_storm_in_the_ledger_make_the_same_storm_again():
    entries, noted = stormy(
        "storm seed=3 faults=30 within=2s kinds=lose,corrupt,truncate,delay,silence,reboot"
    )
    lines = sorted(noted, key=lambda text: parse_fault(text).at_ns or 0)
    assert stormy("\n".join(lines))[0] == entries


def test_a_storm_has_only_the_kinds_that_it_names():
    _, noted = stormy("storm seed=1 faults=12 within=1s kinds=lose,overheat at=1s")
    assert {text.split(maxsplit=1)[0] for text in noted} == {"lose", "overheat"}
    assert all(1_000 * MS <= (parse_fault(text).at_ns or 0) <= 2_000 * MS for text in noted)


@pytest.mark.parametrize(("bus", "struck"), [("", {"left", "right"}), ("bus=right ", {"right"})])
def test_a_storm_strikes_all_buses_or_the_one_that_it_names(bus, struck):
    script = FaultScript([parse_fault(f"storm {bus}seed=2 faults=20 within=1s")])
    script.attach(three_buses()[:2])
    assert {fault.bus for fault in script.waiting} == struck
    assert all(fault.servo in (None, 3) for fault in script.waiting if fault.bus == "right")
