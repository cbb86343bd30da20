"""Fast sync and bulk reads: all servos in one status, fewer bytes, and no value is another servo's."""

from functools import partial

import pytest
from tests.kit import rigs
from tests.kit.line_faults import corrupt_next
from tests.kit.rigs import make_plan, make_rig, start_rig

from dxlrun.channels.event_records import EventCode, Severity
from dxlwire.control_table import find_table, model_names
from dxlwire.packets import PacketKind
from dxlwire.wire import protocol2

IDS = rigs.X_IDS
make_x = partial(rigs.make_x, fast=True)


@pytest.fixture
def started():
    return start_rig(make_x())


def read_bytes(rig, cycles=20):
    """Return how many bytes of reads and of replies the ledger has of some cycles."""
    since = len(rig.ledger.entries)
    rig.cycles(cycles)
    entries = rig.ledger.entries[since:]
    return sum(len(e.data) for e in entries if not (e.direction == "in" and e.data[7] == 0x83))


def test_a_cycle_is_one_fast_sync_read_with_one_status(started):
    since, start = len(started.ledger.entries), started.clock.now_ns()
    started.hardware.read_states()
    took_ns = started.clock.now_ns() - start
    asked = [e.data for e in started.ledger.entries[since:] if e.direction == "in"]
    told = b"".join(e.data for e in started.ledger.entries[since:] if e.direction == "out")
    assert asked == [protocol2.sync_read(126, 10, IDS, fast=True)]
    assert len(told) == 8 + 8 * 14
    assert took_ns == (22 + 120) * 10_000
    assert started.states.valid.all()


def test_a_fast_sync_read_saves_a_fifth_of_the_bytes_at_least():
    fast, plain = make_rig(make_x()), make_rig(make_x(fast=False))
    for rig in (fast, plain):
        rig.hardware.start()
    assert read_bytes(fast) <= 0.8 * read_bytes(plain)
    assert fast.states.position == pytest.approx(plain.states.position, abs=0.002)


def test_the_budget_is_what_the_ledger_has(started):
    since = len(started.ledger.entries)
    started.cycle()
    entries = started.ledger.entries[since:]
    budget = started.plans[0].budget
    assert sum(len(e.data) for e in entries if e.direction == "in") == budget.request_bytes
    assert sum(len(e.data) for e in entries if e.direction == "out") == budget.reply_bytes


def test_who_comes_before_an_absent_servo_keeps_its_sample(started):
    started.cycle()
    started.servo(14).silence()
    started.cycle()
    assert started.states.valid.tolist() == [True] * 3 + [False] * 5
    started.cycles(3)
    assert started.states.valid.tolist() == [True] * 3 + [False] + [True] * 4
    started.servo(14).silence(False)
    started.cycles(20)  # it was lost, and is looked at as at the start
    assert started.states.valid.all()
    assert started.packets.received() == started.out_of_bus()


@pytest.mark.parametrize("index", range(14))
def test_a_spoilt_byte_costs_that_servo_and_those_behind_it(started, index):
    started.cycle()
    corrupt_next(started.buses[0], 14, index=index)
    before = len(started.packets.list)
    started.cycle()
    assert started.states.valid.tolist() == [True] * 3 + [False] * 5
    # the log has the three as replies, and says of the first bad one alone that it was garbled
    (status,) = [one for one in started.packets.list[before:] if one.kind is PacketKind.STATUS]
    assert (status.servo_id, len(status.data)) == (0xFE, 8 + 3 * 14)
    assert [one.servo_id for one in protocol2.fast_answers(status.data, [10] * 8)] == [11, 12, 13]
    lost = started.events.of(EventCode.READ_LOST)
    assert [text.rpartition(": ")[2].endswith("garbled reply") for _, text in lost] == [True] + [False] * 4
    assert started.packets.received() == started.out_of_bus()
    started.cycles(2)
    assert started.states.valid.all()


@pytest.mark.parametrize("index", range(22))
def test_a_spoilt_byte_of_the_first_part_is_never_taken(started, index):
    started.cycle()
    corrupt_next(started.buses[0], 11, index=index)
    started.cycle()
    assert not started.states.valid.any()
    started.cycles(2)
    assert started.states.valid.all()


def test_servos_of_old_firmware_are_read_plainly_and_it_is_told():
    rig = make_rig(make_x())
    for servo_id in (13, 17):
        rig.servo(servo_id).poke("firmware_version", 44)
    rig.hardware.start()
    since = len(rig.ledger.entries)
    rig.cycle()
    assert rig.ledger.entries[since].data == protocol2.sync_read(126, 10, IDS)
    assert rig.states.valid.all()
    ((_, severity, _, text),) = [e for e in rig.events.list if e[1] is Severity.WARNING]
    assert severity is Severity.WARNING
    assert "they need firmware 45" in text
    assert "arm_13_joint (ID 13 on bus arm) has 44" in text
    assert "arm_17_joint (ID 17 on bus arm) has 44" in text
    assert "2.76 ms instead of 2.28 ms (at most 362 Hz)" in text


def test_models_of_two_layouts_are_read_by_one_fast_bulk_read():
    models = ["XM430-W350"] * 3 + ["PM42-010-S260"] * 3
    rig = start_rig(make_x((11, 12, 13, 21, 22, 23), models=models, reference=0.0, lower=-3.1, upper=3.1))
    since = len(rig.ledger.entries)
    rig.cycle()
    requests = [(one, 126, 10) for one in (11, 12, 13)] + [(one, 574, 10) for one in (21, 22, 23)]
    assert rig.ledger.entries[since].data == protocol2.bulk_read(requests, fast=True)
    assert rig.states.valid.all()


def test_who_has_no_fast_form_is_read_beside_those_who_have_one():
    plan = make_x(
        (1, 2, 3, 4, 5, 6), models=["XM430-W350"] * 4 + ["2XL430-W250"] * 2, return_delay_ns=100_000
    )
    assert plan.groups == ((0, 1, 2, 3), (4, 5))
    assert plan.fast == (True, False)


def test_replies_are_due_by_the_return_delays_that_the_servos_have():
    plan = make_plan((1, 2), return_delay_ns=100_000)
    rig = make_rig(plan)
    rig.servo(2).poke("return_delay_time", 250)
    rig.hardware.start()
    (reads,) = [servos.reads for servos in rig.hardware._servos]
    assert plan.reads[0].due_ns == 300_000
    assert [request.patient[0].due_ns for request in reads.plan().queue] == [300_000, 700_000]


@pytest.mark.parametrize(
    ("protocol", "models", "latency_ns", "read_by"),
    [
        (1.0, ["AX-12A"] * 3, 0, "read"),
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
    plan = make_plan(
        range(1, len(models) + 1),
        protocol=protocol,
        models=models,
        latency_ns=latency_ns,
        fast=True,
        lower=-0.1,
        upper=0.1,
    )
    assert plan.read_by == read_by


def test_a_servo_that_forgets_the_fast_form_makes_its_group_be_read_plainly(started):
    started.servo(15).poke("firmware_version", 44)  # as after another one took its place
    started.cycles(20)
    ((_, _, source, text),) = [e for e in started.events.list if "fast reads in a row" in e[3]]
    assert source == "arm"
    assert "arm_15_joint" in text
    since = len(started.ledger.entries)
    for _ in range(5):
        started.cycle()
        assert started.states.valid.all()
    asked = [entry.data[7] for entry in started.ledger.entries[since:] if entry.direction == "in"]
    assert asked.count(protocol2.Protocol2Instruction.SYNC_READ) == 5
    assert protocol2.Protocol2Instruction.FAST_SYNC_READ not in asked


def test_a_servo_that_is_silent_now_and_then_leaves_its_group_the_fast_form(started):
    for _ in range(8):
        started.servo(15).silence()
        started.cycle()
        started.servo(15).silence(False)
        started.cycles(3)
    since = len(started.ledger.entries)
    started.cycle()
    assert started.ledger.entries[since].data[7] == protocol2.Protocol2Instruction.FAST_SYNC_READ
    assert [e for e in started.events.list if "fast reads in a row" in e[3]] == []


@pytest.mark.parametrize("protocol", [1.0, 2.0])
def test_no_model_has_a_state_that_indirect_addresses_would_shorten(protocol):
    for model in model_names(protocol):
        plan = make_plan((1,), model=model, protocol=protocol, reference=0.0, lower=-9.0, upper=9.0)
        layout = plan.servos[0].state
        between = find_table(model, protocol).items.get("reserved_619")
        spared = 0 if between is None else between.size  # PRO before (A): not worth addresses in the EEPROM
        assert layout.length == layout.position.size + layout.velocity.size + layout.effort.size + spared, (
            model
        )
