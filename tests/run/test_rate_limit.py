"""A running loop becomes as fast as the robot file's buses allow, and no faster."""

from __future__ import annotations

import msgspec
import pytest

from dxlrun.channels.answers import Code, Completion, Refusal
from dxlrun.channels.commands import LOOP, CommandMessage
from dxlrun.testing import simulated_robot

ROBOT = """\
name: pair
buses:
  fast: {port: sim, protocol: 1.0, baud_rate: 1_000_000, return_delay_time: 100 us}
  slow: {port: sim, protocol: 1.0, baud_rate: 57_600, return_delay_time: 100 us}
loop: {rate: 50}
joints:
  pan: {bus: fast, id: 3, model: AX-12A, reference: 150 deg, direction: 1}
  tilt: {bus: slow, id: 7, model: AX-12A, reference: 150 deg, direction: 1}
"""


@pytest.mark.parametrize(("share", "refused"), [(0.9, False), (1.1, True)])
def test_the_slowest_bus_bounds_the_rate(tmp_path, share, refused):
    path = tmp_path / "pair.yaml"
    path.write_text(ROBOT)
    robot = simulated_robot(path, duration_s=0.2)
    highest = min(bus.budget.highest_rate_hz for bus in robot.plan.buses)
    request = msgspec.json.encode({"rate": share * highest})
    robot.inbox.waiting.append(CommandMessage(1, LOOP, "rate", request, "anna", 0))
    result = robot.run()
    answer = robot.inbox.answers[1]
    if refused:
        assert answer == Refusal(Code.RATE_OVER_BUSES, {"highest": pytest.approx(highest)})
    else:
        assert isinstance(answer, Completion)
    assert result.skipped == 0
    assert (result.cycles > 11) == (not refused)
