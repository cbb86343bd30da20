"""MX servos with old firmware: one bulk read for two or more of them, beside AX on the same line."""

import math

import pytest
from tests.kit.rigs import make_plan, make_rig, start_rig

from dxlrun.channels.event_records import EventCode
from dxlwire.wire import protocol1

MIXED = ("AX-12A", "MX-64", "MX-28", "AX-12A", "MX-64")


@pytest.fixture
def started():
    plan = make_plan((1, 2, 3, 4, 5), models=MIXED, reference=math.radians(150), lower=-2.0, upper=2.0)
    return start_rig(plan)


def test_mx_are_read_together_and_ax_one_by_one(started):
    count = len(started.into_bus())
    started.cycle()
    *reads, goals = started.into_bus()[count:]
    assert reads == [
        protocol1.read_range(1, 36, 6),
        protocol1.bulk_read([(2, 36, 6), (3, 36, 6), (5, 36, 6)]),
        protocol1.read_range(4, 36, 6),
    ]
    assert goals[4:7] == bytes((0x83, 30, 4))
    assert started.states.valid.all()


def test_one_mx_alone_is_read_plainly():
    plan = make_plan((1, 2), models=("AX-12A", "MX-64"))
    assert [read.packet for read in plan.reads] == [
        protocol1.read_range(1, 36, 6),
        protocol1.read_range(2, 36, 6),
    ]


def test_an_absent_servo_breaks_the_chain_for_one_cycle(started):
    started.cycle()
    started.servo(3).silence()
    started.cycle()
    assert started.states.valid.tolist() == [True, True, False, True, False]
    for _ in range(3):
        started.cycle()
        assert started.states.valid.tolist() == [True, True, False, True, True]
    started.servo(3).silence(False)
    started.cycles(20)  # it was lost, and is looked at as at the start
    assert started.states.valid.all()


def test_a_servo_that_follows_a_torque_is_brought_into_position_mode():
    rig = make_rig(make_plan((1, 2), models=("AX-12A", "MX-64")))
    rig.servo(2).poke("torque_ctrl_mode_enable", 1)
    rig.hardware.start()
    assert rig.servo(2).registers["torque_ctrl_mode_enable"] == 0
    ((joint, text),) = rig.events.of(EventCode.MODE)
    assert joint == "main_2_joint"
    assert "Torque Ctrl Mode Enable (70) was 1" in text


def test_the_budget_counts_one_latency_a_request():
    budget = make_plan((1, 2, 3, 4, 5), models=MIXED, latency_ns=1_000_000).budget
    assert budget.latency_ns == 3_000_000
    assert budget.reply_bytes == 5 * 12
    assert budget.request_bytes == 2 * 8 + (7 + 3 * 3) + (8 + 5 * 5)
