"""Faults: their lines of text, those of chance, storms of them; dialogues/faults.txt has the others."""

from collections import Counter
from pathlib import Path

import pytest
from tests.kit.cases import read_lines
from tests.kit.simulated_line import Line

from dxlsim.bus.ledger import Ledger, LedgerEntry
from dxlsim.bus.simulated_bus import SimulatedBus
from dxlsim.faults.fault import fault_help, parse_fault
from dxlsim.faults.kinds import KINDS, PASSING
from dxlsim.faults.script import FaultScript
from dxlsim.faults.values import READERS
from dxlsim.simulation_plan import BusConfig, ServoConfig
from dxlwire.exceptions import InputError, PortError

MS = 1_000_000


def ping(line: Line, servo_id: int = 1) -> bool:
    """Return whether a servo answers."""
    return line.request(servo_id, 0x01) == (servo_id, 0, b"")


def test_random_noise_is_that_of_the_seed():
    received = []
    for seed in (1, 1, 2):
        line = Line()
        line.inject("noise size=20", seed=seed)
        received.append(line.receive())
    assert {len(each) for each in received} == {20}
    assert received[0] == received[1] != received[2]


def test_an_unplugged_adapter_is_gone_and_comes_back():
    line = Line()
    line.inject("unplug at=1s for=2s")
    assert ping(line)
    line.clock.wait_until(1_000 * MS)
    line.bus.advance_to(1_000 * MS)
    with pytest.raises(PortError):
        line.instruct(1, 0x01)
    line.bus.advance_to(2_999 * MS)
    assert not line.bus.plugged
    line.bus.advance_to(3_000 * MS)
    assert line.bus.plugged
    assert line.faults == ["unplug at=1s for=2s"]


def test_times_count_from_the_start_of_the_simulation():
    line = Line(start_ns=7_000 * MS)
    script = FaultScript([parse_fault("silence servo=1 at=500ms")])
    script.attach((line.bus,), start_ns=7_000 * MS)
    line.clock.wait_until(7_400 * MS)
    script.add(parse_fault("silence servo=2 at=800ms"), line.clock.now_ns())
    assert [fault.servo for fault in script.waiting] == [1, 2]
    for servo_id, at_ms in ((1, 7_500), (2, 7_800)):
        line.clock.wait_until((at_ms - 1) * MS)
        assert ping(line, servo_id)
        line.clock.wait_until((at_ms + 1) * MS)
        assert not ping(line, servo_id)
    assert script.waiting == ()


def test_faults_by_hand_overlap_with_those_of_the_script():
    line = Line()
    script = line.inject("silence servo=1 for=50ms")
    line.receive()
    script.add(parse_fault("silence servo=1 for=10ms"), line.clock.now_ns())
    line.receive(20 * MS)
    assert not ping(line)
    line.receive(20 * MS)
    assert ping(line)
    with pytest.raises(InputError, match="bus main has no servo 9; its servos are 1, 2"):
        script.add(parse_fault("silence servo=9"), line.clock.now_ns())


def test_a_loose_cable_may_have_contact_now_and_then_until_it_is_fixed():
    line = Line()
    line.inject("loose servo=1 low=-360deg high=360deg share=0.5 for=2s", seed=3)
    assert 30 < sum(ping(line) for _ in range(100)) < 70
    line.clock.wait_until(3_000 * MS)
    assert all(ping(line) for _ in range(30))


def test_a_lossy_line_loses_a_share_of_the_packets_of_every_servo():
    line = Line()
    line.inject("lossy share=0.2", seed=1)
    for servo_id in (1, 2):
        assert 140 < sum(ping(line, servo_id) for _ in range(200)) < 180


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


LINES = [line.text for line in read_lines(Path(__file__).with_name("fault_lines.txt")) if line.text]
RIGHT = [line for line in LINES if " = " not in line and "=> " not in line]


@pytest.mark.parametrize("line", LINES)
def test_a_line_is_written_back_or_refused_with_a_sentence_that_corrects_it(line):
    text, refused, message = line.rpartition("=> ")
    if refused:
        with pytest.raises(InputError) as error:
            parse_fault(text.strip())
        assert message in str(error.value)
        assert len(error.value.sentences) == 1
        return
    given, _, canonical = line.partition(" = ")
    fault = parse_fault(given)
    assert str(fault) == (canonical or given)
    assert parse_fault(str(fault)) == fault


def test_text_has_every_kind_and_every_key_and_the_help_has_a_line_for_each_kind():
    assert {line.split(maxsplit=1)[0] for line in RIGHT} == set(KINDS)
    assert {word.partition("=")[0] for line in RIGHT for word in line.split()[1:]} == set(READERS)
    assert [line.split(maxsplit=1)[0].rstrip(":") for line in fault_help()] == list(KINDS)
    delay = "delay servo=ID by=TIME [count=NUMBER] [bus=NAME] [at=TIME] [packet=NUMBER]: the next reply"
    assert fault_help()[3].startswith(delay)


def test_an_angle_in_radians_is_the_same_in_degrees():
    radians = parse_fault("turn servo=2 by=1rad")
    assert radians.given["by"] == pytest.approx(57.29578)
    assert parse_fault(str(radians)) == radians
