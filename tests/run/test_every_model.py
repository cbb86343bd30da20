"""One simulated servo of every model that a robot file can name, on virtual time."""

import math

import pytest

from dxlrun.testing import simulated_robot
from dxlwire.control_table import find_table, model_names

pytestmark = pytest.mark.long

ROBOT = """\
name: one
buses:
  main: {{port: sim, protocol: {protocol}, baud_rate: 1_000_000, adapter: {{latency: 0 ms}}}}
loop: {{rate: 50}}
joints:
  elbow:
    bus: main
    id: 1
    model: "{model}"
    reference: {reference:.12f} rad
    direction: 1
    limits: {{position: [{lower:.12f} rad, {upper:.12f} rad]}}
controllers:
  states: {{type: joint_state_broadcaster}}
"""


@pytest.mark.parametrize(
    ("model", "protocol"), [(name, protocol) for protocol in (1.0, 2.0) for name in model_names(protocol)]
)
def test_a_servo_of_every_model_runs(tmp_path, model, protocol):
    table = find_table(model, protocol)
    ends = [table.min_tick, table.max_tick]
    # some come with position limits that are narrower than their travel, which the robot file has to follow
    for index, (name, tighter) in enumerate((("min_position_limit", max), ("max_position_limit", min))):
        item = table.items.get(name)
        if item is not None and item.initial is not None:
            ends[index] = tighter(ends[index], item.initial)
    lower, upper = (end * table.rad_per_tick for end in ends)
    middle = (lower + upper) / 2
    path = tmp_path / "one.yaml"
    path.write_text(
        ROBOT.format(
            protocol=protocol, model=model, reference=middle, lower=lower - middle, upper=upper - middle
        )
    )
    robot = simulated_robot(path, duration_s=0.1)
    result = robot.run()
    assert (result.reason, result.detail) == ("ended", "")
    states = robot.record.states
    assert states.valid.all()
    assert math.isfinite(states.position[0])
