"""Arms of XM430 led by the standard controllers, alone and in chains: how they follow, and their limits."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.kit.clients import Ask, steered

from dxlrun.channels.event_records import EventCode

pytestmark = pytest.mark.long

ARM = """
name: chained_arm
buses:
  main: {port: sim, protocol: 2.0, baud_rate: 3_000_000, adapter: {latency: 0 ms}, return_delay_time: 0 us}
loop: {rate: 200}
joints:
  shoulder:
    {bus: main, id: 1, model: XM430-W350, reference: 180 deg, direction: 1,
     simulation: {inertia: 0.01 kg m^2},
     limits: {position: [-100 deg, 100 deg], velocity: 4 rad/s, effort: 1.2 A}}
  elbow:
    {bus: main, id: 2, model: XM430-W350, reference: 180 deg, direction: -1,
     simulation: {inertia: 0.004 kg m^2},
     limits: {position: [-100 deg, 100 deg], velocity: 4 rad/s, effort: 1.2 A}}
controllers:
"""
GAINS = "gains: {p: 6.0, i: 8.0, d: 0.2}, derivative_filter: 5 ms"
CHAIN = f"""
  arm: {{type: joint_trajectory_controller, joints: [shoulder, elbow], command_interface: posvel,
        into: arm_pid, deceleration: 10 rad/s^2}}
  arm_pid: {{type: pid_controller, joints: [shoulder, elbow], {GAINS}}}
"""
LIMITED = ARM.replace("velocity: 4 rad/s", "velocity: 1.5 rad/s, acceleration: 6 rad/s^2")
POSES = "  poses: {type: joint_group_position_controller, joints: [elbow, shoulder]}"
TRAJECTORY = "  arm: {type: joint_trajectory_controller, joints: [shoulder, elbow], command_interface: "
ALONE = {
    "effort": f"{TRAJECTORY} effort, {GAINS}}}",
    # the velocity that the servo reaches is 0.15 s behind the one that it gets
    "velocity": f"{TRAJECTORY} velocity, gains: {{p: 5.0, acceleration: 0.15}}}}",
}
LIFT = {
    "points": [
        {"time": time, "positions": positions, "velocities": [0, 0], "accelerations": [0, 0]}
        for time, positions in ((0.5, [0, 0]), (1.5, [0.9, -0.6]), (2.5, [-0.4, 0.5]), (3.5, [0.0, 0.0]))
    ]
}


def desired(t: float, begun: float) -> np.ndarray:
    """The quintic pieces of LIFT, between its points at rest: 10 x^3 - 15 x^4 + 6 x^5 of the way."""
    points = LIFT["points"]
    times = [begun + point["time"] for point in points]
    index = int(np.clip(np.searchsorted(times, t) - 1, 0, len(points) - 2))
    x = np.clip((t - times[index]) / (times[index + 1] - times[index]), 0, 1)
    start, end = (np.array(points[place]["positions"], dtype=float) for place in (index, index + 1))
    return start + (end - start) * (10 * x**3 - 15 * x**4 + 6 * x**5)


def results(run: Any) -> list[tuple[int, str]]:
    ended = [json.loads(event.data) for event in run.log.events if event.code == EventCode.GOAL_ENDED]
    return [(report["goal"], report["status"]) for report in ended]


def arm(directory: Path, controllers: str, robot: str = ARM) -> Path:
    path = directory / "arm.yaml"
    path.write_text(robot + controllers)
    return path


def test_a_trajectory_above_a_pid_on_currents_is_followed(tmp_path):
    run = steered(tmp_path, arm(tmp_path, CHAIN), 4.5, [Ask(0.5, "arm", "trajectory", LIFT)])
    assert results(run) == [(1, "reached")]
    cycles = run.log.cycles
    assert np.isnan(cycles["command_position"]).all()
    t = np.arange(len(cycles["position"])) / 200
    error = cycles["position"] - np.array([desired(time, 0.5) for time in t])
    assert np.abs(error[(t > 0.5) & (t < 4.0)]).max() < 0.05
    assert np.abs(error[t > 4.3]).max() < 0.01


@pytest.mark.parametrize("interface", sorted(ALONE))
def test_a_trajectory_on_efforts_or_velocities_is_followed(tmp_path, interface):
    run = steered(tmp_path, arm(tmp_path, ALONE[interface]), 4.5, [Ask(0.5, "arm", "trajectory", LIFT)])
    assert results(run) == [(1, "reached")]
    cycles = run.log.cycles
    assert np.isfinite(cycles[f"command_{interface}"][10:]).all()
    t = np.arange(len(cycles["position"])) / 200
    error = cycles["position"] - np.array([desired(time, 0.5) for time in t])
    assert np.abs(error[(t > 0.5) & (t < 4.0)]).max() < 0.06
    assert np.abs(error[t > 4.3]).max() < 0.012


def test_a_goal_in_a_chain_is_cancelled_preempted_and_slowed_down(tmp_path):
    one = {"joints": ["elbow"], "points": [{"time": 0.5, "positions": [0.3]}]}
    run = steered(
        tmp_path,
        arm(tmp_path, CHAIN),
        8.0,
        [
            Ask(0.5, "arm", "trajectory", LIFT),
            Ask(1.5, "", "cancel", {"controller": "arm"}),
            Ask(2.5, "arm", "trajectory", LIFT),
            Ask(3.5, "arm", "trajectory", one),
            Ask(4.5, "", "parameters", {"controller": "arm", "values": {"speed": 2.0}}),
            Ask(4.5, "", "parameters", {"controller": "arm_pid", "values": {"gains.p": 8.0}}),
            Ask(5.5, "arm", "trajectory", LIFT),
        ],
    )
    assert results(run) == [(1, "cancelled"), (2, "preempted"), (3, "reached"), (4, "reached")]
    t = np.arange(len(run.log.cycles["position"])) / 200
    references = run.log.cycles["reference"]
    rows = [run.log.header.references.index(f"arm_pid/{joint}/position") for joint in ("shoulder", "elbow")]
    positions = references[:, rows]
    stop = positions[(t > 2.2) & (t < 2.4)]
    assert np.ptp(stop, axis=0) == pytest.approx([0, 0], abs=1e-12)
    accelerations = np.diff(positions[t > 0.6], n=2, axis=0) * 200**2
    assert np.abs(accelerations).max() < 60
    stopping = (t > 1.5) & (t < 1.95)
    assert np.abs(np.diff(positions[stopping], n=2, axis=0) * 200**2).max() <= 10 * 1.01 + 1.5 * 4
    assert positions[-1] == pytest.approx([0.0, 0.0])


def test_commands_that_jump_become_ramps_within_the_limits_of_the_joints(tmp_path):
    jumps = [
        Ask(1.5, "poses", "positions", {"positions": [-1.0, 1.2]}),
        Ask(1.9, "poses", "positions", {"positions": [0.5, 0.0]}),
    ]
    run = steered(tmp_path, arm(tmp_path, POSES, LIMITED), 4.0, jumps)
    goals = run.log.cycles["goal_position"]
    velocity = np.diff(goals, axis=0) * 200
    assert np.abs(velocity).max() <= 1.5 * (1 + 1e-9)
    assert np.abs(velocity).max(axis=0) == pytest.approx([1.5, 1.5], rel=0.02)
    assert np.abs(np.diff(velocity, axis=0)).max() * 200 <= 6 * (1 + 1e-6)
    assert goals[-1].tolist() == [0.0, 0.5]


# In each of its ways to command, within its limits

RATE = 200
ACCELERATION = 12.0
UPPER = np.radians(60)
TIGHT = ARM.replace("100 deg", "60 deg").replace("1.2 A", "1.2 A, acceleration: 12 rad/s^2")
WAYS = {
    "position": f"{TRAJECTORY} position}}",
    "posvel": f"{TRAJECTORY} posvel}}",
    "velocity": f"{TRAJECTORY} velocity, gains: {{p: 5.0, acceleration: 0.15}}}}",
    "effort": f"{TRAJECTORY} effort, {GAINS}}}",
    "chain": f"""{TRAJECTORY} posvel, into: arm_pid}}
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


@pytest.mark.parametrize("way", sorted(WAYS))
def test_preempted_cancelled_and_waiting_it_stays_within_its_limits(tmp_path, way):
    faster = {"controller": "arm", "values": {"speed": 1.0}}
    run = steered(
        tmp_path,
        arm(tmp_path, WAYS[way], TIGHT),
        9.0,
        [
            Ask(0.5, "arm", "trajectory", points((0.8, 0.9, -0.9))),
            Ask(0.9, "arm", "trajectory", points((0.9, -0.6, 0.8))),  # to the other side, in mid-motion
            Ask(3.0, "arm", "trajectory", points((0.9, UPPER, -UPPER))),
            Ask(3.45, "", "cancel", {"controller": "arm"}),  # fast, and toward the limit
            Ask(4.0, "arm", "trajectory", points((1.0, 0.0, 0.0))),
            Ask(4.4, "", "parameters", {"controller": "arm", "values": {"speed": 0.0}}),
            Ask(5.4, "", "parameters", faster),
            Ask(
                6.5, "arm", "trajectory", {"joints": ["elbow"], "points": [{"time": 0.8, "positions": [0.5]}]}
            ),
            Ask(
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
    # the elbow goes on where the shoulder's trajectory does not name it
    assert position[-1] == pytest.approx([0.4, 0.5], abs=0.01)
