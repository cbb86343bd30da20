"""The trajectory controller on simulated XM430, in each of its ways to command, within its limits."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from dxlrun.channels.events import EventCode

RATE = 200
ACCELERATION = 12.0
UPPER = np.radians(60)
LIMITS = "limits: {position: [-60 deg, 60 deg], velocity: 4 rad/s, effort: 1.2 A, acceleration: 12 rad/s^2}"
ARM = f"""
name: arm
buses:
  main:
    {{port: sim, protocol: 2.0, baud_rate: 3_000_000, adapter: {{latency: 0 ms}}, return_delay_time: 0 us}}
loop: {{rate: {RATE}}}
joints:
  shoulder:
    {{bus: main, id: 1, model: XM430-W350, reference: 180 deg, direction: 1,
     simulation: {{inertia: 0.01 kg m^2}}, {LIMITS}}}
  elbow:
    {{bus: main, id: 2, model: XM430-W350, reference: 180 deg, direction: -1,
     simulation: {{inertia: 0.004 kg m^2}}, {LIMITS}}}
controllers:
"""
EFFORT = "gains: {p: 6.0, i: 8.0, d: 0.2}, derivative_filter: 5 ms"
OWN = "  arm: {type: joint_trajectory_controller, joints: [shoulder, elbow], command_interface: "
WAYS = {
    "position": f"{OWN} position}}",
    "posvel": f"{OWN} posvel}}",
    "velocity": f"{OWN} velocity, gains: {{p: 5.0, acceleration: 0.15}}}}",
    "effort": f"{OWN} effort, {EFFORT}}}",
    "chain": f"""{OWN} posvel, into: arm_pid}}
  arm_pid:
    {{type: pid_controller, joints: [shoulder, elbow], command_interface: velocity, gains: {{p: 8.0}}}}""",
}


def points(*rows: tuple[float, float, float]) -> dict[str, object]:
    return {
        "points": [
            {"time": time, "positions": list(to), "velocities": [0, 0], "accelerations": [0, 0]}
            for time, *to in rows
        ]
    }


def results(run: Any) -> list[tuple[int, str]]:
    ended = [json.loads(event.data) for event in run.log.events if event.code == EventCode.GOAL_ENDED]
    return [(report["goal"], report["status"]) for report in ended]


@pytest.mark.parametrize("way", sorted(WAYS))
def test_preempted_cancelled_and_waiting_it_stays_within_its_limits(tmp_path, steered, asking, way):
    file = tmp_path / "arm.yaml"
    file.write_text(ARM + WAYS[way])
    faster = {"controller": "arm", "values": {"speed": 1.0}}
    run = steered(
        file,
        9.0,
        [
            asking(0.5, "arm", "trajectory", points((0.8, 0.9, -0.9))),
            asking(0.9, "arm", "trajectory", points((0.9, -0.6, 0.8))),  # to the other side, in mid-motion
            asking(2.5, "arm", "trajectory", points((0.8, UPPER, -UPPER))),
            asking(2.95, "", "cancel", {"controller": "arm"}),  # fast, and toward the limit
            asking(4.0, "arm", "trajectory", points((1.0, 0.0, 0.0))),
            asking(4.4, "", "parameters", {"controller": "arm", "values": {"speed": 0.0}}),
            asking(5.4, "", "parameters", faster),
            asking(
                6.5, "arm", "trajectory", {"joints": ["elbow"], "points": [{"time": 0.8, "positions": [0.5]}]}
            ),
            asking(
                6.9,
                "arm",
                "trajectory",
                {"joints": ["shoulder"], "points": [{"time": 0.8, "positions": [0.4]}]},
            ),
        ],
    )
    ends = ["preempted", "reached", "cancelled", "reached", "preempted", "reached"]
    assert results(run) == list(enumerate(ends, 1))
    cycles = run.log.cycles
    t = np.arange(len(cycles["position"])) / RATE
    position, goals = cycles["position"], cycles["goal_position"]
    assert (np.nanmax(np.abs(goals), axis=0, initial=0.0) <= UPPER + 1e-12).all()
    if way in ("position", "posvel"):  # what is sent keeps the limits, whatever the goals ask for
        speeds = np.diff(goals[5:], axis=0) * RATE
        assert np.abs(speeds).max() <= 4.0 * (1 + 1e-9)
        assert np.abs(np.diff(speeds, axis=0)).max() * RATE <= ACCELERATION * (1 + 1e-6)
    elif way == "velocity":
        speeds = cycles["goal_velocity"][5:]
        assert np.abs(speeds).max() <= 4.0 * (1 + 1e-9)
        assert np.abs(np.diff(speeds, axis=0)).max() * RATE <= ACCELERATION * (1 + 1e-6)
    # the velocity that a servo reaches is 0.15 s behind the one that it gets
    assert np.abs(position).max() <= UPPER + (0.15 if way in ("velocity", "chain") else 0.02)
    waiting = position[(t > 5.3) & (t < 5.4)]
    assert np.ptp(waiting, axis=0).max() < 0.03
    assert np.abs(waiting).min() > 0.1, "it waits in the middle of its way"
    stopped = 0.625 * 0.4 + 0.625**2 / (2 * ACCELERATION)
    assert position[-1] == pytest.approx([0.4, stopped], abs=0.01)
