"""Start of the hardware: times, order and lost replies; `cases/startup.txt` has what refuses it."""

import itertools
from contextlib import suppress
from functools import partial

import pytest
from msgspec.structs import replace
from tests.kit.line_faults import truncate_next
from tests.kit.plans import distinct_tables
from tests.kit.rigs import make_plan, make_rig, make_x, start_rig

from dxlrun.channels.event_records import EventCode
from dxlrun.compile.joints.register_values import UnfitRegister
from dxlrun.dynamixel.findings import Findings
from dxlrun.dynamixel.servo.item_access import first_reach
from dxlrun.dynamixel.servo.registers import write_registers
from dxlrun.errors import PortError, StartUpError
from dxlrun.features.registers.settings import declarable, register_value
from dxlwire.control_table import find_table
from dxlwire.wire import protocol1


@pytest.mark.parametrize(
    ("lacks", "for_replies"),
    [(lambda servo: servo.silence(), True), (lambda servo: servo.poke("model_number", 29), False)],
)
def test_refusal_is_for_replies_only_when_one_is_missing(lacks, for_replies):
    rig = make_rig()
    lacks(rig.servo(6))
    with pytest.raises(StartUpError) as caught:
        rig.hardware.start()
    assert caught.value.for_replies is for_replies
    assert {packet[4] for packet in rig.into_bus()} <= {1, 2}


def test_the_end_of_the_set_up_without_torque_is_reported_before_the_first_torque():
    rig, seen = make_rig(), []
    rig.hardware.start(lambda: seen.append((rig.torque(), len(rig.into_bus()))))
    ((torque, packets),) = seen
    assert torque == [False] * 8
    assert packets > 8  # all were inspected


def test_servos_that_are_all_silent_are_one_sentence_within_two_seconds():
    rig = make_rig()
    for servo in rig.buses[0].servos:
        servo.silence()
    before = rig.clock.now_ns()
    (problem,) = rig.refused()
    assert rig.clock.now_ns() - before < 2_000_000_000
    assert problem.startswith("none of the 8 servos on bus main answers: main_1_joint (ID 1), main_3")
    assert " and IDs " in problem


def test_first_states_that_a_standing_host_did_not_hear_are_read_again(monkeypatch):
    rig = make_rig()
    read, reads = rig.hardware.read_states, []

    def late():
        """Let no servo hear anything for 70 ms when the first states are read."""
        if not reads:
            for servo in rig.buses[0].servos:
                servo.silence()
                rig.buses[0].at(rig.clock.now_ns() + 70_000_000, partial(servo.silence, False))
        reads.append(rig.clock.now_ns())
        read()

    monkeypatch.setattr(type(rig.hardware), "read_states", lambda _: late())
    rig.hardware.start()
    assert rig.torque() == [True] * 8
    assert len(reads) > 1
    assert rig.states.valid.all()


def test_no_port_no_start():
    rig = make_rig()
    rig.ports.ports[0].unplug()
    with pytest.raises(PortError, match="bus main on sim"):
        rig.hardware.start()


def test_torque_comes_in_groups():
    rig = start_rig()
    times = [e.t_ns for e in rig.ledger.entries if e.direction == "in" and e.data[4:7] == b"\x03\x18\x01"]
    pauses = [b - a > 20_000_000 for a, b in itertools.pairwise(times)]
    assert pauses == [False, False, True, False, False, True, False]


def test_a_servo_whose_state_cannot_be_read_once_it_has_torque_ends_the_start():
    """It may answer all other questions: goals without states would be blind."""
    rig = make_rig()
    plan = rig.plans[0].servos[2]
    block = protocol1.read_range(plan.servo_id, plan.state.address, plan.state.length)[:6]
    rig.when(
        lambda data: data[:6] == block and rig.torque()[7],
        lambda: truncate_next(rig.buses[0], plan.servo_id, 0),
    )
    assert "ID 5 on bus main) did not answer after torque was switched on: " in rig.refused()[0]


@pytest.mark.parametrize(
    ("item", "refused"),
    [("position_p_gain", False), ("bus_watchdog", True), ("drive_mode", True), ("operating_mode", True)],
)
def test_refused_read_is_fatal_only_for_an_item_that_decides(item, refused):
    rig = make_rig(make_x((1,)))
    rig.servo(1).poke("temperature_limit", 70)
    rig.servo(1).refuse_reads(find_table("XM430-W350").items[item].address)
    if refused:
        assert " rejects reads: " in rig.refused()[0]
        return
    rig.hardware.start()
    (text,) = rig.events.texts(EventCode.REGISTER_DIFFERS)
    assert "Temperature Limit (31) = 70" in text


def test_firmware_before_an_item_may_refuse_reads_of_it():
    items = find_table("XM430-W350").items.values()
    newer = [item.name for item in items if item.firmware > 44 and not item.name.startswith("indirect")]
    assert "startup_configuration" in newer
    rig = make_rig(make_x((1,)), firmware=44)
    rig.servo(1).poke("drive_mode", 4)
    rig.servo(1).refuse_reads(*(each.address for each in items if each.name in newer))
    (problem,) = rig.refused()
    assert "Drive Mode (10) = 4" in problem
    starts = {int.from_bytes(packet[8:10], "little") for packet in rig.into_bus() if packet[7] == 0x02}
    assert 60 not in starts


def others(table):
    """Return for each declarable item of a model a value that it has not at first, where there is one."""
    for name in declarable(table):
        item = table.items[name]
        for value in (item.maximum, item.minimum, (item.minimum + item.maximum) // 2):
            with suppress(UnfitRegister):
                if value != item.initial:
                    yield register_value(table, name, value)
                    break


@pytest.mark.parametrize("protocol", [1.0, 2.0])
def test_whatever_may_be_declared_of_any_model_is_written_once_and_then_there(protocol):
    tables = [table for table in distinct_tables() if table.protocol == protocol]
    assert tables
    for table in tables:
        plan = make_plan((5,), protocol=protocol, model=table.model, reference=1.5, lower=-0.1, upper=0.1)
        wanted = tuple(sorted(others(table), key=lambda one: not one.eeprom))
        plan = replace(plan, servos=(replace(plan.servos[0], settings=wanted),))
        rig, counts = make_rig(plan, position=1.5), []
        for _ in range(2):
            found = Findings()
            rig.lines.run_programs([write_registers(first_reach(plan, plan.servos[0]), wanted, found)])
            assert found.problems == []
            counts.append(len(found.texts(EventCode.REGISTER_WRITTEN)))
        assert counts == [len(rig.writes()), 0]
        assert counts[0] > 5, table.model
        memory = rig.buses[0].servos[0].registers
        assert all(bytes(memory.image)[one.address : one.address + one.size] == one.data for one in wanted)
