"""How the plan says that the servos are read, and at which rate that ends."""

from pathlib import Path

import pytest

from dxlrun.compile.robot_compiler import compile_files
from dxlrun.errors import InputError

HUMANOID = Path(__file__).parents[2] / "robots" / "humanoid_20.yaml"
BUSES = ["right_arm", "left_arm", "right_leg", "left_leg"]


def test_twenty_servos_on_four_buses_leave_half_of_a_millisecond_to_controllers():
    plan = compile_files(HUMANOID, {}, []).plan
    assert plan.loop.period_ns == 1_000_000
    assert [(bus.name, len(bus.servos), bus.latency_ns) for bus in plan.buses] == [
        (name, 5, 0) for name in BUSES
    ]
    assert all(bus.budget.total_ns < 500_000 for bus in plan.buses)


def test_a_latency_timer_ends_1_khz_and_the_highest_rate_is_named():
    with pytest.raises(InputError) as caught:
        compile_files(HUMANOID, {"adapter": "ftdi"}, [])
    problems = [one for one in caught.value.problems if one.severity == "error"]
    assert [one.what.split()[4] for one in problems] == BUSES
    for one in problems:
        assert "1000 Hz (argument rate:=1000) is 1 ms" in one.what
        assert "lower the rate to at most 719 Hz" in one.fix
        assert "an adapter without a latency timer would allow 2564 Hz" in one.fix


@pytest.mark.parametrize(("rate", "too_fast"), [("700", []), ("719", []), ("720", BUSES)])
def test_the_highest_rate_that_is_named_is_possible_and_the_next_one_is_not(rate, too_fast):
    try:
        compile_files(HUMANOID, {"adapter": "ftdi", "rate": rate}, [])
        problems = ()
    except InputError as error:
        problems = error.problems  # 50 Hz of the broadcaster do not divide these rates
    refused = [one.what for one in problems if one.severity == "error" and "one cycle on bus" in one.what]
    assert [what.split()[4] for what in refused] == too_fast


def test_the_cheapest_way_to_read_is_taken_and_named():
    (leg,) = [bus for bus in compile_files(HUMANOID, {}, []).plan.buses if bus.name == "left_leg"]
    assert leg.read_by == "fast sync read"
    assert (leg.budget.request_bytes, leg.budget.reply_bytes) == (19 + 14 + 5 * 9, 8 + 5 * 14)


def test_a_simulated_bus_has_the_latency_timer_of_its_kind_of_adapter():
    plan = compile_files(HUMANOID, {"adapter": "ftdi", "rate": "500"}, []).plan
    assert {bus.latency_ns for bus in plan.buses} == {1_000_000}
    assert {one.latency_timer_ns for one in plan.simulation.adapters.values()} == {1_000_000}
    assert compile_files(HUMANOID, {}, []).plan.simulation.adapters == {}
