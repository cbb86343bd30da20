"""Arms that follow efforts and velocities, against the curve; goals and limits: stories/arms.txt."""

import json

import numpy as np
import pytest
from tests.kit.virtual_run import VirtualRun

from dxlrun.channels.event_records import EventCode

pytestmark = pytest.mark.long

RATE = 200
ARM = """
name: chained_arm
buses:
  main: {port: sim, protocol: 2.0, baud_rate: 3_000_000, adapter: {latency: 0 ms}, return_delay_time: 0 us}
loop: {rate: 200}
joint_defaults:
  {bus: main, model: XM430-W350, reference: 180 deg,
   limits: {position: [-100 deg, 100 deg], velocity: 4 rad/s, effort: 1.2 A}}
joints:
  shoulder: {id: 1, direction: 1, simulation: {inertia: 0.01 kg m^2}}
  elbow: {id: 2, direction: -1, simulation: {inertia: 0.004 kg m^2}}
controllers:
"""
GAINS = "gains: {p: 6.0, i: 8.0, d: 0.2}, derivative_filter: 5 ms"
TRAJECTORY = "  arm: {type: joint_trajectory_controller, joints: [shoulder, elbow], command_interface: "
CHAIN = f"""{TRAJECTORY} posvel, into: arm_pid, deceleration: 10 rad/s^2}}
  arm_pid: {{type: pid_controller, joints: [shoulder, elbow], {GAINS}}}
"""
WAYS = {
    "chain": CHAIN,
    # the velocity that the servo reaches is 0.15 s later than the one that it gets
    "velocity": f"{TRAJECTORY} velocity, gains: {{p: 5.0, acceleration: 0.15}}}}",
    "effort": f"{TRAJECTORY} effort, {GAINS}}}",
}
LIFTED = ((0.5, [0, 0]), (1.5, [0.9, -0.6]), (2.5, [-0.4, 0.5]), (3.5, [0.0, 0.0]))


def points(*rows: tuple[float, list[float]]) -> dict[str, object]:
    """Return a trajectory of quintics that rests at each of its points."""
    return {
        "points": [
            {"time": time, "positions": to, "velocities": [0, 0], "accelerations": [0, 0]}
            for time, to in rows
        ]
    }


def desired(t: float, begun: float) -> np.ndarray:
    """The quintic pieces between its points at rest: 10 x^3 - 15 x^4 + 6 x^5 of the way."""
    times = [begun + time for time, _ in LIFTED]
    index = int(np.clip(np.searchsorted(times, t) - 1, 0, len(times) - 2))
    x = np.clip((t - times[index]) / (times[index + 1] - times[index]), 0, 1)
    start, end = (np.array(LIFTED[place][1], dtype=float) for place in (index, index + 1))
    return start + (end - start) * (10 * x**3 - 15 * x**4 + 6 * x**5)


@pytest.mark.parametrize(
    ("way", "commands", "moving", "at_rest"),
    [
        ("chain", "effort", 0.05, 0.01),
        ("effort", "effort", 0.06, 0.012),
        ("velocity", "velocity", 0.06, 0.012),
    ],
)
def test_a_trajectory_without_positions_is_followed(tmp_path, way, commands, moving, at_rest):
    run = VirtualRun.of_text(tmp_path, ARM + WAYS[way], 4.5)
    run.command(500, "arm", "trajectory", points(*LIFTED))
    log = run.finish()
    run.require_done()
    (end,) = [json.loads(event.data) for event in log.events if event.code == EventCode.GOAL_ENDED]
    assert end["status"] == "reached"
    cycles = log.cycles
    assert np.isnan(cycles["command_position"]).all()
    assert np.isfinite(cycles[f"command_{commands}"][10:]).all()
    t = np.arange(len(cycles["position"])) / RATE
    error = np.abs(cycles["position"] - np.array([desired(time, 0.5) for time in t]))
    assert error[(t > 0.5) & (t < 4.0)].max() < moving
    assert error[t > 4.3].max() < at_rest
