"""A servo that shuts itself down where its goal is judged; other goals are told in `stories`."""

import re

import pytest
from tests.kit.virtual_run import VirtualRun

from dxlrun.channels.event_records import EventCode

BUSES = """
buses:
  main: {port: sim, protocol: 2.0, baud_rate: 1_000_000, adapter: {kind: direct}, return_delay_time: 0 us}
joint_defaults: {bus: main, model: XM430-W350, reference: 180 deg, direction: 1}
"""


@pytest.mark.parametrize(("protocol", "model"), [(1.0, "MX-64"), (2.0, "XM430-W350")])
@pytest.mark.parametrize("before_ms", [3, 12])
def test_a_joint_that_shuts_itself_down_before_its_goal_is_judged_has_not_reached_it(
    tmp_path, protocol, model, before_ms
):
    """Its reply reports the error, so its torque is in doubt, although it still stands at the goal."""
    text = BUSES.replace("2.0", str(protocol)).replace("XM430-W350", model).replace("{kind: direct}", "{}")
    text = f"name: arm{text}loop: {{rate: 50}}\njoints: {{a: {{id: 1}}}}\ncontrollers:\n"
    text += "  arm: {type: joint_trajectory_controller, joints: [a]}\n"

    def run(overloads_ms: float | None) -> tuple[str, float]:
        one = VirtualRun.of_text(tmp_path, text, 2.8)
        one.command(1000, "arm", "trajectory", {"points": [{"positions": [0.5], "time": 1.0}]})
        if overloads_ms is not None:
            one.at(overloads_ms, one.servos["a"].trigger_overload)
        (end,) = [event for event in one.finish().events if event.code == EventCode.GOAL_ENDED]
        return end.text, end.t_ns / 1e6

    reached, ended_ms = run(None)
    assert "reached" in reached
    aborted, _ = run(ended_ms - before_ms)
    assert re.match(r"goal 1 aborted: after .* s, joint a \(ID 1 on bus main\) is limp", aborted)
