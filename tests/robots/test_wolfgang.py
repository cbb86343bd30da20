"""Wolfgang of the Bit-Bots: the team's own configuration as a robot file."""

from __future__ import annotations

from pathlib import Path

from dxlrun.testing import simulated_robot

WOLFGANG = Path(__file__).parents[2] / "robots" / "wolfgang.yaml"
MX_64, MX_106, XH540 = 311, 321, 1100
"""ID, model number, bus and P gain, as the team's wolfgang.yaml and wolfgang_core.rst have them."""


def test_the_buses_allow_the_teams_rate_at_two_megabits():
    fast = simulated_robot(WOLFGANG, arguments={"rate": "500", "baud": "2_000_000"})
    assert min(bus.budget.highest_rate_hz for bus in fast.plan.buses) > 500
    slow = simulated_robot(WOLFGANG)
    rates = {bus.name: bus.budget.highest_rate_hz for bus in slow.plan.buses}
    assert {name for name, rate in rates.items() if rate < 500} == {"right_leg", "left_leg", "arms"}
