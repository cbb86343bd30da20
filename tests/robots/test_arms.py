"""Arms of XM430 led by the standard controllers, alone and in chains: how they follow, and their limits."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.kit.clients import Ask, steered

from dxlrun.channels.event_records import EventCode

pytestmark = pytest.mark.long

RATE, ACCELERATION, UPPER = 200, 12.0, np.radians(60)
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
    "position": f"{TRAJECTORY} position}}",
    "posvel": f"{TRAJECTORY} posvel}}",
    # the velocity that the servo reaches is 0.15 s later than the one that it gets
    "velocity": f"{TRAJECTORY} velocity, gains: {{p: 5.0, acceleration: 0.15}}}}",
    "effort": f"{TRAJECTORY} effort, {GAINS}}}",
    "chain": f"""{TRAJECTORY} posvel, into: arm_pid}}
  arm_pid:
    {{type: pid_controller, joints: [shoulder, elbow], command_interface: velocity, gains: {{p: 8.0}}}}""",
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


def joint(name: str, to: float, time: float = 0.8) -> dict[str, object]:
    return {"joints": [name], "points": [{"time": time, "positions": [to]}]}


def desired(t: float, begun: float) -> np.ndarray:
    """The quintic pieces between its points at rest: 10 x^3 - 15 x^4 + 6 x^5 of the way."""
    times = [begun + time for time, _ in LIFTED]
    index = int(np.clip(np.searchsorted(times, t) - 1, 0, len(times) - 2))
    x = np.clip((t - times[index]) / (times[index + 1] - times[index]), 0, 1)
    start, end = (np.array(LIFTED[place][1], dtype=float) for place in (index, index + 1))
    return start + (end - start) * (10 * x**3 - 15 * x**4 + 6 * x**5)


def ran(
    directory: Path, controllers: str, seconds: float, asks: list[Ask], robot: str = ARM
) -> tuple[Any, list[str]]:
    """Return the run of an arm, and how its goals ended."""
    path = directory / "arm.yaml"
    path.write_text(robot + controllers)
    run = steered(directory, path, seconds, asks)
    ended = [json.loads(event.data) for event in run.log.events if event.code == EventCode.GOAL_ENDED]
    assert [report["goal"] for report in ended] == [*range(1, len(ended) + 1)]
    return run, [report["status"] for report in ended]


@pytest.mark.parametrize(
    ("controllers", "commands", "moving", "at_rest"),
    [
        (CHAIN, "effort", 0.05, 0.01),
        (WAYS["effort"], "effort", 0.06, 0.012),
        (WAYS["velocity"], "velocity", 0.06, 0.012),
    ],
    ids=["chain", "effort", "velocity"],
)
def test_a_trajectory_without_positions_is_followed(tmp_path, controllers, commands, moving, at_rest):
    run, ends = ran(tmp_path, controllers, 4.5, [Ask(0.5, "arm", "trajectory", points(*LIFTED))])
    assert ends == ["reached"]
    cycles = run.log.cycles
    assert np.isnan(cycles["command_position"]).all()
    assert np.isfinite(cycles[f"command_{commands}"][10:]).all()
    t = np.arange(len(cycles["position"])) / RATE
    error = np.abs(cycles["position"] - np.array([desired(time, 0.5) for time in t]))
    assert error[(t > 0.5) & (t < 4.0)].max() < moving
    assert error[t > 4.3].max() < at_rest


def test_a_goal_in_a_chain_is_cancelled_preempted_and_slowed_down(tmp_path):
    lift = points(*LIFTED)
    run, ends = ran(
        tmp_path,
        CHAIN,
        8.0,
        [
            Ask(0.5, "arm", "trajectory", lift),
            Ask(1.5, "", "cancel", {"controller": "arm"}),
            Ask(2.5, "arm", "trajectory", lift),
            Ask(3.5, "arm", "trajectory", joint("elbow", 0.3, 0.5)),
            Ask(4.5, "", "parameters", {"controller": "arm", "values": {"speed": 2.0}}),
            Ask(4.5, "", "parameters", {"controller": "arm_pid", "values": {"gains.p": 8.0}}),
            Ask(5.5, "arm", "trajectory", lift),
        ],
    )
    assert ends == ["cancelled", "preempted", "reached", "reached"]
    t = np.arange(len(run.log.cycles["position"])) / RATE
    names = run.log.header.references
    rows = [names.index(f"arm_pid/{name}/position") for name in ("shoulder", "elbow")]
    positions = run.log.cycles["reference"][:, rows]
    assert np.ptp(positions[(t > 2.2) & (t < 2.4)], axis=0) == pytest.approx([0, 0], abs=1e-12)
    assert np.abs(np.diff(positions[t > 0.6], n=2, axis=0) * RATE**2).max() < 60
    stopping = (t > 1.5) & (t < 1.95)
    assert np.abs(np.diff(positions[stopping], n=2, axis=0) * RATE**2).max() <= 10 * 1.01 + 1.5 * 4
    assert positions[-1] == pytest.approx([0.0, 0.0])


def check_limits(speeds: np.ndarray, fastest: float, acceleration: float) -> None:
    assert np.abs(speeds).max() <= fastest * (1 + 1e-9)
    assert np.abs(np.diff(speeds, axis=0)).max() * RATE <= acceleration * (1 + 1e-6)


@pytest.mark.parametrize("way", sorted(WAYS))
def test_preempted_cancelled_and_waiting_it_stays_within_its_limits(tmp_path, way):
    tight = ARM.replace("100 deg", "60 deg").replace("1.2 A", "1.2 A, acceleration: 12 rad/s^2")
    run, ends = ran(
        tmp_path,
        WAYS[way],
        9.0,
        [
            Ask(0.5, "arm", "trajectory", points((0.8, [0.9, -0.9]))),
            Ask(0.9, "arm", "trajectory", points((0.9, [-0.6, 0.8]))),  # to the other side, in mid-motion
            Ask(3.0, "arm", "trajectory", points((0.9, [UPPER, -UPPER]))),
            Ask(3.45, "", "cancel", {"controller": "arm"}),  # fast, and toward the limit
            Ask(4.0, "arm", "trajectory", points((1.0, [0.0, 0.0]))),
            Ask(4.4, "", "parameters", {"controller": "arm", "values": {"speed": 0.0}}),
            Ask(5.4, "", "parameters", {"controller": "arm", "values": {"speed": 1.0}}),
            Ask(6.5, "arm", "trajectory", joint("elbow", 0.5)),
            Ask(6.9, "arm", "trajectory", joint("shoulder", 0.4)),
        ],
        tight,
    )
    assert ends == ["preempted", "reached", "cancelled", "reached", "preempted", "reached"]
    cycles = run.log.cycles
    t = np.arange(len(cycles["position"])) / RATE
    position, goals = cycles["position"], cycles["goal_position"]
    assert (np.nanmax(np.abs(goals), axis=0, initial=0.0) <= UPPER + 1e-12).all()
    # what is sent keeps the limits, whatever the goals ask for
    if way in ("position", "posvel"):
        check_limits(np.diff(goals[5:], axis=0) * RATE, 4.0, ACCELERATION)
    elif way == "velocity":
        check_limits(cycles["goal_velocity"][5:], 4.0, ACCELERATION)
    assert np.abs(position).max() <= UPPER + (0.15 if way in ("velocity", "chain") else 0.02)
    waiting = position[(t > 5.3) & (t < 5.4)]
    assert np.ptp(waiting, axis=0).max() < 0.03
    assert np.abs(waiting).min() > 0.1, "it waits in the middle of its way"
    # the elbow continues where the shoulder's trajectory does not name it
    assert position[-1] == pytest.approx([0.4, 0.5], abs=0.01)
