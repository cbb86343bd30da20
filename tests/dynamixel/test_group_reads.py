"""Servos that are read together by the runtime, in each way: bytes, budgets, faults of one, lost forms."""

import pytest
from tests.kit.line_faults import corrupt_next
from tests.kit.rigs import X_IDS as IDS
from tests.kit.rigs import make_plan, make_rig, make_x, start_rig

from dxlrun.channels.event_records import EventCode, Severity
from dxlwire.packets import PacketKind
from dxlwire.wire import protocol1, protocol2

MIXED = ("AX-12A", "MX-64", "MX-28", "AX-12A", "MX-64")
FAST_SYNC_READ = protocol2.Protocol2Instruction.FAST_SYNC_READ
SYNC_READ = protocol2.Protocol2Instruction.SYNC_READ


@pytest.fixture
def fast():
    return start_rig(make_x(fast=True))


@pytest.fixture
def mixed():
    """MX servos with old firmware, which know a bulk read, beside AX on the same line."""
    return start_rig(make_plan((1, 2, 3, 4, 5), models=MIXED, lower=-2.0, upper=2.0))


def passed(rig, since, direction):
    """Return the packets that passed the line behind so many entries of the ledger."""
    return [entry.data for entry in rig.ledger.entries[since:] if entry.direction == direction]


def test_a_cycle_is_one_fast_sync_read_with_one_status_as_in_the_budget(fast):
    since, start = len(fast.ledger.entries), fast.clock.now_ns()
    fast.hardware.read_states()
    took_ns = fast.clock.now_ns() - start
    assert passed(fast, since, "in") == [protocol2.sync_read(126, 10, IDS, fast=True)]
    assert len(b"".join(passed(fast, since, "out"))) == 8 + 8 * 14
    assert took_ns == (22 + 120) * 10_000
    assert fast.states.valid.all()
    fast.hardware.write_goals()
    budget = fast.plans[0].budget
    since = len(fast.ledger.entries)
    fast.cycle()
    assert sum(map(len, passed(fast, since, "in"))) == budget.request_bytes
    assert sum(map(len, passed(fast, since, "out"))) == budget.reply_bytes


@pytest.mark.parametrize(
    ("absent", "fast_form", "first", "then"),
    [
        (14, True, "11100000", "11101111"),
        (14, False, "11100000", "11101111"),
        (3, None, "11010", "11011"),
    ],
    ids=["fast", "sync", "bulk"],
)
def test_who_comes_before_an_absent_servo_keeps_its_sample(mixed, absent, fast_form, first, then):
    rig = mixed if fast_form is None else start_rig(make_x(fast=fast_form))
    rig.cycle()
    rig.servo(absent).silence()
    rig.cycle()
    assert rig.states.valid.tolist() == [one == "1" for one in first]
    for _ in range(3):
        rig.cycle()
        assert rig.states.valid.tolist() == [one == "1" for one in then]
    rig.servo(absent).silence(False)
    rig.cycles(20)  # it was lost, and is looked at as at the start
    assert rig.states.valid.all()
    assert rig.packets.received() == rig.out_of_bus()


def test_a_spoilt_byte_costs_that_servo_and_those_behind_it(fast):
    fast.cycle()
    corrupt_next(fast.buses[0], 14)
    before = len(fast.packets.list)
    fast.cycle()
    assert fast.states.valid.tolist() == [True] * 3 + [False] * 5
    # the log has the three as replies, and says of the first bad one alone that it was garbled
    (status,) = [one for one in fast.packets.list[before:] if one.kind is PacketKind.STATUS]
    assert (status.servo_id, len(status.data)) == (0xFE, 8 + 3 * 14)
    assert [one.servo_id for one in protocol2.fast_answers(status.data, [10] * 8)] == [11, 12, 13]
    lost = fast.events.of(EventCode.READ_LOST)
    assert [text.rpartition(": ")[2].endswith("garbled reply") for _, text in lost] == [True] + [False] * 4
    assert fast.packets.received() == fast.out_of_bus()
    fast.cycles(2)
    assert fast.states.valid.all()


def test_servos_of_old_firmware_are_read_plainly_and_it_is_reported():
    rig = make_rig(make_x(fast=True))
    for servo_id in (13, 17):
        rig.servo(servo_id).poke("firmware_version", 44)
    rig.hardware.start()
    since = len(rig.ledger.entries)
    rig.cycle()
    assert rig.ledger.entries[since].data == protocol2.sync_read(126, 10, IDS)
    assert rig.states.valid.all()
    (text,) = [text for _, severity, _, text in rig.events.list if severity is Severity.WARNING]
    assert "they need firmware 45" in text
    assert "arm_13_joint (ID 13 on bus arm) has 44" in text
    assert "arm_17_joint (ID 17 on bus arm) has 44" in text
    assert "2.76 ms instead of 2.28 ms (at most 362 Hz)" in text


def test_who_has_no_fast_form_is_read_beside_those_who_have_one():
    models = ["XM430-W350"] * 4 + ["2XL430-W250"] * 2
    plan = make_x((1, 2, 3, 4, 5, 6), models=models, return_delay_ns=100_000, fast=True)
    assert (plan.groups, plan.fast) == (((0, 1, 2, 3), (4, 5)), (True, False))


def test_replies_are_due_by_the_return_delays_that_the_servos_have():
    rig = make_rig(plan := make_plan((1, 2), return_delay_ns=100_000))
    rig.servo(2).poke("return_delay_time", 250)
    rig.hardware.start()
    (reads,) = [servos.reads for servos in rig.hardware._servos]
    assert plan.reads[0].due_ns == 300_000
    assert [request.patient[0].due_ns for request in reads.plan().queue] == [300_000, 700_000]


@pytest.mark.parametrize(
    ("protocol", "models", "latency_ns", "read_by"),
    [
        (1.0, ["AX-12A"] * 3, 0, "read"),
        (1.0, ["AX-12A", "MX-64"], 0, "read"),  # one MX alone
        (1.0, ["MX-28", "MX-64", "AX-12A"], 0, "bulk read + read"),
        (2.0, ["2XL430-W250"] * 3, 0, "sync read"),
        (2.0, ["XM430-W350"], 0, "read"),
        (2.0, ["XM430-W350"] * 8, 0, "fast sync read"),
        (2.0, ["XM430-W350"] * 3 + ["PM42-010-S260"] * 3, 0, "fast bulk read"),
        (2.0, ["2XL430-W250"] * 8 + ["XL-320"], 0, "sync read + read"),
        (2.0, ["2XL430-W250"] * 8 + ["XL-320"], 1_000_000, "bulk read"),
    ],
)
def test_the_cheapest_way_to_read_is_taken(protocol, models, latency_ns, read_by):
    ids, limits = range(1, len(models) + 1), {"lower": -0.1, "upper": 0.1}
    plan = make_plan(ids, protocol=protocol, models=models, latency_ns=latency_ns, fast=True, **limits)
    assert plan.read_by == read_by


def test_a_servo_that_forgets_the_fast_form_makes_its_group_be_read_plainly(fast):
    fast.servo(15).poke("firmware_version", 44)  # as after another one took its place
    fast.cycles(20)
    ((_, _, source, text),) = [e for e in fast.events.list if "fast reads in a row" in e[3]]
    assert source == "arm"
    assert "arm_15_joint" in text
    since = len(fast.ledger.entries)
    for _ in range(5):
        fast.cycle()
        assert fast.states.valid.all()
    asked = [data[7] for data in passed(fast, since, "in")]
    assert (asked.count(SYNC_READ), asked.count(FAST_SYNC_READ)) == (5, 0)


def test_a_servo_that_is_silent_now_and_then_leaves_its_group_the_fast_form(fast):
    for _ in range(8):
        fast.servo(15).silence()
        fast.cycle()
        fast.servo(15).silence(False)
        fast.cycles(3)
    since = len(fast.ledger.entries)
    fast.cycle()
    assert fast.ledger.entries[since].data[7] == FAST_SYNC_READ
    assert [e for e in fast.events.list if "fast reads in a row" in e[3]] == []


def test_mx_are_read_together_and_ax_one_by_one_with_a_latency_for_each_request(mixed):
    count = len(mixed.into_bus())
    mixed.cycle()
    *reads, goals = mixed.into_bus()[count:]
    assert reads == [
        protocol1.read_range(1, 36, 6),
        protocol1.bulk_read([(2, 36, 6), (3, 36, 6), (5, 36, 6)]),
        protocol1.read_range(4, 36, 6),
    ]
    assert goals[4:7] == bytes((0x83, 30, 4))
    assert mixed.states.valid.all()
    budget = make_plan((1, 2, 3, 4, 5), models=MIXED, latency_ns=1_000_000).budget
    assert (budget.latency_ns, budget.reply_bytes) == (3_000_000, 5 * 12)
    assert budget.request_bytes == 2 * 8 + (7 + 3 * 3) + (8 + 5 * 5)
