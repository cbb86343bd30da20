"""`limits.velocity` at every rate of the loop, judged by the simulated shafts alone."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dxlrun.run.virtual_run import VirtualRobot

LIMIT = 0.5
SERVOS = {1.0: "model: AX-12A, reference: 150 deg", 2.0: "model: XM430-W350, reference: 180 deg"}
LOOK_NS = 5_000_000
CONTROLLERS = {
    "positions": "{type: joint_group_position_controller, joints: [arm]}",
    "posvel": "{type: joint_group_posvel_controller, joints: [arm]}",
}
COMMANDS = {"positions": {"positions": [0.6]}, "posvel": {"positions": [0.6], "velocities": [5.0]}}


def robot_file(
    directory: Path,
    protocol: float,
    rate: float,
    kind: str,
    joint: str = f"limits: {{velocity: {LIMIT} rad/s}}",
) -> Path:
    path = directory / "one.yaml"
    path.write_text(
        f"name: one\nbuses:\n  main: {{port: sim, protocol: {protocol}, baud_rate: 1_000_000,\n"
        f"    return_delay_time: 20 us, adapter: {{latency: 0 ms}}}}\nloop: {{rate: {rate}}}\njoints:\n"
        f"  arm: {{bus: main, id: 1, {SERVOS[protocol]}, direction: 1, {joint}}}\n"
        f"controllers:\n  mover: {CONTROLLERS[kind]}\npolicies: {{exit_timeout: 20 s}}\n"
    )
    return path


def watch(robot: VirtualRobot, seconds: float) -> list[float]:
    """Note where the shaft is, every 5 ms, in the list that is returned."""
    bus, servo, angles = robot.buses[0], robot.buses[0].servo(1), []

    def look(t_ns: int) -> None:
        servo.advance(t_ns)
        angles.append(servo.position)

    for t_ns in range(0, round(seconds * 1e9), LOOK_NS):
        bus.at(t_ns, partial(look, t_ns))
    return angles


def too_far(angles: list[float], limit: float) -> float:
    """Return by how much more than the limit's way, rad, the shaft went in any 10 ms to 1 s.

    A servo that begins to move is behind its own trajectory for some 50 ms, and then catches up.
    """
    way = np.array(angles)
    looks = (2, 5, 10, 20, 50, 100, 200)
    return max(float(np.abs(way[n:] - way[:-n]).max()) - limit * n * LOOK_NS * 1e-9 for n in looks)


@pytest.mark.parametrize(
    ("rate", "kind"),
    [
        (1, "positions"),
        (1, "posvel"),
        (10, "positions"),
        (50, "positions"),
        (50, "posvel"),
        (500, "positions"),
    ],
)
@pytest.mark.parametrize("protocol", [1.0, 2.0])
def test_the_shaft_is_never_faster_than_the_limit(  # noqa: PLR0917  fixtures
    tmp_path: Path, steered: Callable[..., Any], asking: Any, protocol: float, rate: float, kind: str
) -> None:
    watched: list[list[float]] = []
    asks = [asking(1.0, "mover", kind, COMMANDS[kind])]
    file = robot_file(tmp_path, protocol, rate, kind)
    steered(file, 4.5, asks, before=lambda robot: watched.append(watch(robot, 4.5)))
    (angles,) = watched
    assert angles[-1] - angles[0] == pytest.approx(0.6, abs=0.02), "it arrives"
    assert too_far(angles, LIMIT) <= 0.01


def test_a_trajectory_of_one_point_at_time_0_does_not_move_the_shaft(tmp_path, steered, asking):
    """Also where the file has no limit: the servo's top speed is one."""
    watched: list[list[float]] = []
    file = robot_file(tmp_path, 2.0, 50, "positions", "limits: {position: [-2 rad, 2 rad]}")
    mover = "{type: joint_trajectory_controller, joints: [arm]}"
    file.write_text(file.read_text().replace(CONTROLLERS["positions"], mover))
    points = {"points": [{"time": 0, "positions": [1.0]}]}
    asks = [asking(1.5, "mover", "trajectory", points)]
    run = steered(file, 2.5, asks, before=lambda robot: watched.append(watch(robot, 2.5)))
    (angles,) = watched
    assert max(angles) - min(angles) < 0.01
    (ended,) = [event.text for event in run.log.events if event.name == "goal_ended"]
    assert "aborted: joint arm has 1 to go to the first point in 0.02 s" in ended


@pytest.mark.parametrize("protocol", [1.0, 2.0])
def test_behind_a_gear_the_joint_is_never_faster_than_its_limit(tmp_path, steered, asking, protocol):
    watched: list[list[float]] = []
    joint = f"gear_ratio: 3, limits: {{position: [-40 deg, 40 deg], velocity: {LIMIT} rad/s}}"
    asks = [asking(1.0, "mover", "positions", COMMANDS["positions"])]
    file = robot_file(tmp_path, protocol, 1, "positions", joint)
    steered(file, 4.5, asks, before=lambda robot: watched.append(watch(robot, 4.5)))
    (angles,) = watched
    assert angles[-1] - angles[0] == pytest.approx(3 * 0.6, abs=0.05), "it arrives"
    assert too_far(angles, 3 * LIMIT) <= 0.03


def test_a_servo_that_lost_its_profile_by_a_reset_is_not_faster_either(tmp_path, steered, asking):
    """Profile Velocity is RAM: 0, no limit, after a reset."""
    watched: list[list[float]] = []

    def begin(robot: VirtualRobot) -> None:
        watched.append(watch(robot, 6.0))
        servo = robot.buses[0].servo(1)
        robot.buses[0].at(1_500_000_000, lambda: servo.cut_power(1_700_000_000))

    file = robot_file(tmp_path, 2.0, 10, "positions")
    file.write_text(file.read_text().replace("exit_timeout", "on_returned_servo: hold, exit_timeout"))
    asks = [asking(1.0, "mover", "positions", COMMANDS["positions"])]
    steered(file, 6.0, [*asks, asking(4.0, "mover", "positions", {"positions": [0.0]})], before=begin)
    (angles,) = watched
    assert max(angles) - angles[0] > 0.2
    assert angles[-1] == pytest.approx(angles[0], abs=0.02), "it has torque again, and moves"
    assert too_far(angles, LIMIT) <= 0.01
