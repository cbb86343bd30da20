"""The table of checks before torque: each row fails on what it is for, and on nothing that is in order."""

from contextlib import suppress
from struct import unpack_from

import pytest
from msgspec.structs import replace
from tests.kit.rigs import make_plan

from dxlrun.channels.event_records import EventCode
from dxlrun.dynamixel.findings import Findings
from dxlrun.dynamixel.servo.checks import CHECKS, inspect_servo, survey
from dxlrun.dynamixel.servo.item_access import access_servo
from dxlwire.bus_plan import RegisterValue
from dxlwire.control_table import find_table
from dxlwire.plan.planning import plan_line
from dxlwire.transaction import Reply, TransactionOutcome

FAILS = (
    (1.0, {"error": 0x04}, "reports an error: overheating"),
    (1.0, {"model_number": 300}, "is model number 300, not a AX-12A (12): correct `model` or the ID"),
    (
        1.0,
        {"status_return_level": 1},
        "has Status Return Level (16) = 1, and this value leaves its writes without",
    ),
    (1.0, {"ccw_angle_limit": 1000}, "has angle limits 0..1000, narrower than the joint's 0..1023"),
    (1.0, {"torque_enable": 1}, "holds torque already"),
    (1.0, {"torque_limit": 0}, "has Torque Limit (34) = 0: it shut itself down"),
    (
        1.0,
        {"multi_turn_offset": 5},
        "has Multi Turn Offset (20) = 5, and this value shifts every position: write 0",
    ),
    (
        1.0,
        {"resolution_divider": 2},
        "has Resolution Divider (22) = 2, and this value changes what a tick is: write 1",
    ),
    (2.0, {"model_number": 30}, "is model number 30, not a XM430-W350 (1020)"),
    (2.0, {"firmware_version": 30, "declared": "backup_ready"}, "available from firmware"),
    (2.0, {"status_return_level": 0}, "this value leaves its writes without an answer: write 2"),
    (2.0, {"drive_mode": 5}, "this value turns it the other way round and makes profiles times: write 0"),
    (2.0, {"drive_mode": 64}, "this value has no known meaning: write 0"),
    (2.0, {"homing_offset": -3}, "has Homing Offset (20) = -3, and this value shifts every position"),
    (2.0, {"min_position_limit": 700}, "has position limits 700..4095, narrower than the joint's"),
    (
        2.0,
        {"min_position_limit": 2048, "max_position_limit": 2048},
        "has position limits 2048..2048, narrower than the joint's",
    ),
    (2.0, {"startup_configuration": 1}, "this value switches its torque on at power-up: write 0"),
    (2.0, {"hardware_error_status": 32}, "reports in Hardware Error Status (70): overload error"),
    (2.0, {"torque_enable": 1}, "holds torque already"),
    (1.0, {"cw_angle_limit": 100}, "has angle limits 100..1023, narrower than the joint's 0..1023"),
    (2.0, {"drive_mode": 4}, "this value makes profiles times: write 0"),
)
DIFFERS = (
    (
        1.0,
        {"return_delay_time": 100},
        "Return Delay Time (5) is 100, 200 us instead of the planned 500 us",
    ),
    (
        2.0,
        {"bus_watchdog": 5},
        "Bus Watchdog (98) is 5 and would stop the servo after 100 ms without an instruction",
    ),
    (
        2.0,
        {"bus_watchdog": 255},
        "Bus Watchdog (98) is 255 (tripped) and has stopped the servo; each start clears it",
    ),
)


def look(protocol, change, *, take_over=False, refused=()):
    """Inspect one servo whose registers are as given, and which refuses each read of some items."""
    multi_turn = {"multi_turn_offset", "resolution_divider"} & set(change)
    model = "MX-28" if multi_turn else "AX-12A" if protocol == 1.0 else "XM430-W350"
    plan = make_plan((1,), protocol=protocol, model=model)
    servo = plan.servos[0]
    table = find_table(model, protocol)
    if "declared" in change:
        item = table.items[change["declared"]]
        servo = replace(servo, settings=(RegisterValue(item.address, item.size, 0, item.name),))
    values = {name: item.initial or 0 for name, item in table.items.items()}
    values |= {"torque_limit": 1023, "goal_pwm": 885}
    values |= {"model_number": servo.model_number, "firmware_version": 52 if protocol == 2.0 else 24}
    values |= {"return_delay_time": plan.return_delay_ns // 2_000}
    values |= {name: value for name, value in change.items() if name in table.items}
    memory = bytearray(table.size)
    for item in table.items.values():
        if not item.name.startswith("indirect"):
            memory[item.address : item.address + item.size] = item.encode(values[item.name])
    found, one = Findings(), access_servo(plan, servo)
    program = inspect_servo(one, found, take_over=take_over)
    read = next(program)
    try:
        while True:
            start, length = read.packet[5:7] if protocol == 1.0 else unpack_from("<HH", read.packet, 8)
            data = bytes(memory[start : start + length])
            gaps = [table.items[name].address for name in refused]
            if any(start <= gap < start + length for gap in gaps):
                read = program.send(Reply(TransactionOutcome.REFUSED, 7, b"", 0, 0, False))
                continue
            read = program.send(Reply(TransactionOutcome.OK, change.get("error", 0), data, 0, 0, False))
    except StopIteration as end:
        mode = end.value
    assert (mode is None) == any(problem.startswith(f"{one} rejects reads") for problem in found.problems)
    return found


def test_firmware_before_an_item_may_refuse_reads_of_it():
    items = find_table("XM430-W350").items.values()
    newer = [item.name for item in items if item.firmware > 44 and not item.name.startswith("indirect")]
    assert "startup_configuration" in newer
    found = look(2.0, {"firmware_version": 44, "homing_offset": 5}, refused=newer)
    (problem,) = found.problems
    assert "Homing Offset (20) = 5" in problem


@pytest.mark.parametrize(
    ("item", "refused"),
    [("position_p_gain", False), ("bus_watchdog", True), ("drive_mode", True), ("operating_mode", True)],
)
def test_refused_read_is_fatal_only_for_an_item_that_decides(item, refused):
    found = look(2.0, {"temperature_limit": 70}, refused=[item])
    assert bool(found.problems) == refused
    if not refused:
        assert [each.item.name for _, _, each in found.deviations] == ["temperature_limit"]


@pytest.mark.parametrize("protocol", [1.0, 2.0])
def test_a_servo_that_fits_has_neither_problem_nor_difference(protocol):
    found = look(protocol, {})
    assert found.problems == []
    assert [event.code for _, event in found.events] == [EventCode.SETUP]
    assert found.deviations == []


@pytest.mark.parametrize(("protocol", "change", "sentence"), FAILS)
def test_a_servo_that_does_not_fit_is_refused_with_one_sentence(protocol, change, sentence):
    (problem,) = look(protocol, change).problems
    assert problem.startswith("main_1_joint (ID 1 on bus main) ")
    assert sentence in problem


@pytest.mark.parametrize(("protocol", "change", "sentence"), DIFFERS)
def test_what_refuses_nothing_is_reported(protocol, change, sentence):
    found = look(protocol, change)
    assert found.problems == []
    ((joint, text),) = found.texts(EventCode.REGISTER_DIFFERS)
    assert joint == "main_1_joint"
    assert sentence in text


@pytest.mark.parametrize(
    ("raw", "refused", "words"),
    [
        (1, True, "this value switches its torque on at power-up"),
        (2, False, "(loads its RAM from its backup at power-up"),
        (
            3,
            True,
            "this value switches its torque on at power-up and loads its RAM from its backup at power-up",
        ),
    ],
)
def test_each_bit_of_startup_configuration_counts_beside_the_other(raw, refused, words):
    found = look(2.0, {"startup_configuration": raw})
    texts = [text for _, text in found.describe_deviations()]
    assert [words in text for text in found.problems] == [True] * refused
    assert [words in text for text in texts] == [True] * (not refused)


@pytest.mark.parametrize("bit", range(8))
def test_any_bit_of_hardware_error_status_refuses_the_servo(bit):
    (problem,) = look(2.0, {"hardware_error_status": 1 << bit}).problems
    assert "Hardware Error Status (70): " in problem


def test_a_servo_with_torque_is_accepted_when_the_robot_is_taken_over():
    assert look(2.0, {"torque_enable": 1}, take_over=True).problems == []


def test_a_servo_that_answers_twice_is_read_no_further():
    plan, found = make_plan((1,), protocol=2.0, model="XM430-W350"), Findings()
    program, sent = survey(plan, False, found), []
    request = next(program)
    with suppress(StopIteration):
        while True:
            sent.append(request.packet)
            request = program.send(Reply(TransactionOutcome.OK, 0, b"\0\0\0", 0, 1, False))
    (problem,) = found.problems
    assert "answers 3 of 3 pings garbled or twice" in problem
    reads = [packet for packet in sent if packet and packet[7] == 2]
    assert reads == [plan_line(plan).read_range(1, 0, 3).packet], "the look for an echo alone"


def test_every_row_of_the_table_has_a_case_here():
    """A row that never fails guards nothing."""
    items = {name for _, change, _ in FAILS + DIFFERS for name in change}
    stand_in = {"error": "status_error", "ccw_angle_limit": "cw_angle_limit"}
    items |= {stand_in[name] for name in items & set(stand_in)}
    items.add("error_code")  # test_hardware_errors.py has the Y series
    assert {check.item for check in CHECKS} <= items
