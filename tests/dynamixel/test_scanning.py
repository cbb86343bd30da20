"""Scanning on virtual time, judged by the ledger."""

import pytest
from tests.kit.line_faults import delay_next
from tests.kit.rigs import VirtualLine

from dxlrun.dynamixel.tools import scanning
from dxlrun.dynamixel.tools.scanning import Search, find_servo, known_rates, scan
from dxlrun.dynamixel.tools.tool_line import ToolLine
from dxlrun.errors import PortError
from dxlsim.simulation_plan import AdapterConfig, ServoConfig
from dxlwire.control_table import all_tables

BOTH = pytest.mark.parametrize(("model", "protocol"), [("AX-12A", 1.0), ("XM430-W350", 2.0)])


def two(servo_id, model="XM430-W350"):
    return ServoConfig(servo_id, model, 2.0)


def line_of(*servos, rate=57_600, **more):
    """Return a line with servos of one protocol, which their models decide."""
    protocol = 1.0 if servos and servos[0].model[:2] in {"AX", "MX"} else 2.0
    return VirtualLine(*servos, protocol=protocol, rate=rate, **more)


def scanned(line, *ids, protocols=(2.0,), rates=(57_600,)):
    return scan(ToolLine(line), Search(protocols, rates, ids))


def names(found):
    return [(one.protocol, one.baud_rate, one.servo_id, one.model) for one in found.servos]


def test_a_rate_that_was_tried_is_left_again():
    line = line_of(two(1))
    tool = ToolLine(line)
    assert tool.speak(2.0, 57_600)
    assert tool.can_run_at(1_000_000)
    assert line.bus.baud_rate == 57_600


def test_one_broadcast_ping_finds_all_servos_of_protocol_2():
    line = line_of(two(1), two(7, "XL430-W250"), two(252, "XL-320"))
    found = scanned(line)
    models = {1: "XM430-W350", 7: "XL430-W250", 252: "XL-320"}
    assert names(found) == [(2.0, 57_600, servo_id, model) for servo_id, model in models.items()]
    assert [one.remarks for one in found.servos] == [(), (), ()]
    assert sum(data[4] == 0xFE for data in line.heard) == 1
    assert {data[7] for data in line.heard} == {1, 2}  # pings and reads: nothing is written


@pytest.mark.parametrize("protocol", [1.0, 2.0])
def test_every_model_is_known_by_its_number_and_can_be_drafted_from(protocol):
    tables = [table for table in all_tables() if table.protocol == protocol]
    servos = [ServoConfig(number, table.model, 0.5) for number, table in enumerate(tables, 1)]
    line = VirtualLine(*servos, protocol=protocol, rate=1_000_000)
    found = scanned(line, protocols=(protocol,), rates=(1_000_000,)).servos
    assert [one.model for one in found] == [table.model for table in tables]
    assert {one.return_delay for one in found} == {500_000}
    assert all(one.position is not None and one.lowest is not None for one in found)
    assert {one.remarks for one in found} == {()}


def test_a_servo_at_another_rate_is_found_at_its_own():
    line = line_of(two(3))
    line.bus.servo(3).poke("baud_rate", 3)  # 1 Mbit/s
    assert names(scanned(line, rates=())) == [(2.0, 1_000_000, 3, "XM430-W350")]


@BOTH
def test_a_servo_that_answers_late_is_found_and_not_taken_for_two(model, protocol):
    """A machine that stands still for 90 ms, at the first ping and in the middle of looking closer."""
    line = line_of(two(3, model), rate=1_000_000)
    for late_ns in (90_000_000, 0, 90_000_000, 0, 90_000_000):
        delay_next(line.bus, 3, late_ns)
    search = Search((protocol,), (1_000_000,), (1, 2, 3, 4))
    found = scan(ToolLine(line), search).servos
    assert [(one.servo_id, one.model, one.remarks) for one in found] == [(3, model, ())]
    delay_next(line.bus, 3, 90_000_000)
    (found,) = find_servo(ToolLine(line), 3, search)
    assert (found.model, found.remarks) == (model, ())


def test_protocol_1_is_asked_id_by_id_and_a_late_answer_is_noticed_and_asked_again():
    line = line_of(two(1, "AX-12A"), two(253, "MX-64"), rate=1_000_000)
    delay_next(line.bus, 1, 3_000_000)  # it comes while the next ID is asked
    found = scanned(line, protocols=(1.0,), rates=(1_000_000,))
    assert names(found) == [(1.0, 1_000_000, 1, "AX-12A"), (1.0, 1_000_000, 253, "MX-64")]
    assert (found.servos[0].lowest, found.servos[0].highest) == (0, 1023)
    assert {data[4] for data in line.heard} == {1, 2}


@BOTH
@pytest.mark.parametrize("ids", [(), (1, 2, 3, 4)])
def test_an_adapter_that_keeps_replies_back_for_longer_than_is_known_makes_no_twins(model, protocol, ids):
    adapter = AdapterConfig(latency_timer_ns=16_000_000)
    line = line_of(two(1, model), two(3, model), rate=1_000_000, adapter=adapter)
    found = scanned(line, *ids, protocols=(protocol,), rates=(1_000_000,)).servos
    assert [(one.servo_id, one.model, one.remarks) for one in found] == [(1, model, ()), (3, model, ())]


@pytest.mark.parametrize(
    ("other", "said"), [("XM430-W350", "do two servos have this ID?"), ("XL430-W250", "garbled")]
)
def test_two_servos_of_one_id_are_named_and_hide_no_other(other, said):
    found = scanned(line_of(two(2), ServoConfig(2, other, 1.0), two(3))).servos
    assert [one.servo_id for one in found] == [2, 3]
    assert said in found[0].remarks[0]


def test_a_servo_that_answers_no_reads_is_listed_with_the_reason():
    line = line_of(two(4, "AX-12A"), rate=1_000_000)
    line.bus.servo(4).poke("status_return_level", 0)
    (found,) = scanned(line, 4, protocols=(1.0,), rates=(1_000_000,)).servos
    assert (found.model, found.model_number) == ("", -1)
    assert found.remarks == (
        "answered a ping, but did not answer 3 reads of its model number: check its cable and power, and its "
        "Status Return Level (16)",
    )


def test_an_unknown_model_is_listed_with_its_number():
    line = line_of(two(4))
    line.bus.servo(4).poke("model_number", 999)
    (found,) = scanned(line, 4).servos
    assert found.model == ""
    assert "model number 999" in found.remarks[0]


def test_rates_that_the_adapter_cannot_are_left_out_and_reported():
    found = scanned(line_of(two(4), cannot=(10_500_000, 6_000_000)), 4, rates=())
    assert found.left_out == (10_500_000, 6_000_000)
    assert len(found.servos) == 1


@pytest.mark.parametrize("protocol", [1.0, 2.0])
@pytest.mark.parametrize("ids", [(), (1, 2)])
def test_an_adapter_that_echoes_is_refused(protocol, ids):
    line = VirtualLine(protocol=protocol, adapter=AdapterConfig(echo=True))
    with pytest.raises(PortError, match="echoes every instruction"):
        scanned(line, *ids, protocols=(protocol,))


def test_a_line_that_is_gone_ends_the_scan():
    line = line_of(two(4))
    line.ports.ports[0].unplug()
    with pytest.raises(PortError):
        scan(ToolLine(line))


def test_one_id_is_found_wherever_it_is():
    line = line_of(two(9), rate=4_000_000)
    (found,) = find_servo(ToolLine(line), 9)
    assert (found.protocol, found.baud_rate, found.model) == (2.0, 4_000_000, "XM430-W350")
    assert find_servo(ToolLine(line), 8) == ()


def test_the_rates_are_those_of_the_tables_and_the_usual_ones_come_first():
    assert known_rates(2.0)[:3] == (1_000_000, 115_200, 57_600)
    assert {9_600, 4_500_000, 10_500_000} <= set(known_rates(2.0))
    assert {9_600, 200_000, 2_250_000, 3_000_000} <= set(known_rates(1.0))


def test_progress_goes_from_nothing_to_everything():
    shares = []
    search = Search((1.0, 2.0), (57_600,), (1, 2))
    scan(ToolLine(VirtualLine()), search, lambda _, share: shares.append(share))
    assert (shares[0], shares[-1]) == (0.0, 1.0)
    assert shares == sorted(shares)


def test_few_ids_are_asked_one_by_one():
    line = line_of(two(3), two(11))
    found = scanned(line, *range(scanning.FEW))
    assert [one.servo_id for one in found.servos] == [3, 11]
    assert all(data[4] != 0xFE for data in line.heard)
