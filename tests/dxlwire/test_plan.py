"""Plans of buses: bytes, budgets and times of their reads, limits in ticks."""

import msgspec
import pytest
from tests.kit.plans import make_plan

from dxlwire.bus_plan import BusPlan
from dxlwire.control_table import find_table, model_names
from dxlwire.plan.line import LONGEST_RETURN_DELAY_NS, TIMEOUT_MARGIN_NS
from dxlwire.plan.planning import torque_off_ns


@pytest.mark.parametrize(("latency_ms", "total_ms", "rate_hz"), [(1, 14.1, 71), (16, 134, 7)])
def test_the_budget_of_protocol_md_by_the_latency_timer(latency_ms, total_ms, rate_hz):
    budget = make_plan(latency_ns=latency_ms * 1_000_000).budget
    assert (budget.wire_ns, budget.return_delay_ns) == (1_600_000 + 480_000, 4_000_000)
    assert budget.latency_ns == 8_000_000 * latency_ms
    assert budget.total_ns / 1e6 == pytest.approx(total_ms, abs=0.1)
    assert round(budget.highest_rate_hz) == rate_hz


def test_the_budget_of_protocol_md_for_eight_x_servos():
    budget = make_plan(protocol=2.0, model="XM430-W350", latency_ns=1_000_000).budget
    goals = 14 + 8 * 9
    assert budget.request_bytes == 22 + goals
    # fast sync read: 0.22 + 1.2 ms, and one return delay
    assert budget.wire_ns == 220_000 + 1_200_000 + goals * 10_000
    assert (budget.return_delay_ns, budget.latency_ns) == (500_000, 1_000_000)


@pytest.mark.parametrize("protocol", [1.0, 2.0])
def test_every_model_has_a_plan_that_survives_json(protocol):
    for model in model_names(protocol):
        plan = make_plan((1, 2), model=model, protocol=protocol, reference=0.0, lower=-9.0, upper=9.0)
        layout, table = plan.servos[0].state, find_table(model, protocol)
        assert layout.address + layout.position.offset == table.items["present_position"].address
        assert len(plan.groups) == (1 if "bulk_read" in table.capabilities else 2)
        assert len(plan.limp) == 1
        assert msgspec.json.decode(msgspec.json.encode(plan), type=BusPlan) == plan


def test_reads_are_six_bytes_from_present_position_on_with_their_times():
    plan = make_plan()
    assert [read.packet[4:7].hex() for read in plan.reads] == ["022406"] * 8
    assert [read.servo_id for read in plan.reads] == [1, 3, 5, 6, 2, 4, 20, 21]
    assert {one.length for read in plan.reads for one in read.awaited} == {6}
    assert {read.due_ns for read in plan.reads} == {200_000 + 500_000}
    patient = make_plan(latency_ns=16_000_000, return_delay_ns=LONGEST_RETURN_DELAY_NS)
    assert {one.timeout_ns for one in patient.reads} == {200_000 + 508_000 + 16_000_000 + TIMEOUT_MARGIN_NS}


def test_torque_off_takes_a_broadcast_and_two_requests_of_each_servo():
    plan = make_plan((1, 7), latency_ns=1_000_000, return_delay_ns=500_000)
    (limp,) = plan.limp
    assert (limp.packet.hex(" "), limp.awaited) == ("ff ff fe 04 03 18 00 e2", ())
    broadcast_ns, write_ns, read_ns = 8 * 10_000, (8 + 6) * 10_000, (8 + 7) * 10_000
    each_ns = write_ns + read_ns + 2 * (500_000 + 1_000_000)
    assert torque_off_ns(plan) == broadcast_ns + 2 * each_ns


def test_limits_become_ticks_inside_them():
    plan = make_plan((1, 2), lower=-1.0, upper=0.5)
    for servo in plan.servos:
        ends = sorted((servo.joint_position(servo.lower_tick), servo.joint_position(servo.upper_tick)))
        assert ends[0] >= -1.0
        assert ends[1] <= 0.5
        assert ends[1] - ends[0] > 1.5 - 2 * servo.rad_per_tick
    assert plan.servos[0].joint_position(1023) == pytest.approx(-2.6179938779914944)


@pytest.mark.parametrize(("model", "protocol", "most"), [("AX-12A", 1.0, 50), ("XM430-W350", 2.0, 113)])
def test_goals_beyond_one_sync_write_are_counted_as_two(model, protocol, most):
    def goal_bytes(count):
        return make_plan(tuple(range(count)), model=model, protocol=protocol).budget.goal_bytes

    per_servo = goal_bytes(most) - goal_bytes(most - 1)
    assert goal_bytes(most + 1) == goal_bytes(most) + goal_bytes(1)
    assert goal_bytes(2) == goal_bytes(1) + per_servo
