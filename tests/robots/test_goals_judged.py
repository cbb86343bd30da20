"""A servo that shuts itself down where its goal is judged; other goals are told in `stories`."""

import re

import pytest
from tests.kit.stories import Clients, prepared

from dxlrun.channels.event_records import EventCode
from dxlrun.testing import read_log, simulated_robot

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
    file = tmp_path / "robot.yaml"
    file.write_text(f"name: arm{text}loop: {{rate: 50}}\njoints: {{a: {{id: 1}}}}\ncontrollers:\n"
                   "  arm: {type: joint_trajectory_controller, joints: [a]}\n")  # fmt: skip

    def run(overloads_ms: float | None) -> tuple[str, float]:
        log = tmp_path / "log.mcap"
        log.unlink(missing_ok=True)
        robot = simulated_robot(file, duration_s=2.8, log=log)
        points = [{"positions": [0.5], "time": 1.0}]
        Clients(robot, {50: [prepared(robot, "arm", "trajectory", points=points)]})
        if overloads_ms is not None:
            robot.buses[0].at(round(overloads_ms * 1e6), robot.buses[0].servo(1).trigger_overload)
        robot.run()
        (end,) = [event for event in read_log(log).events if event.code == EventCode.GOAL_ENDED]
        return end.text, end.t_ns / 1e6

    text, ended_ms = run(None)
    assert "reached" in text
    text, _ = run(ended_ms - before_ms)
    assert re.match(r"goal 1 aborted: after .* s, joint a \(ID 1 on bus main\) is limp", text)
