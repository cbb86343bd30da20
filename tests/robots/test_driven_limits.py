"""Joints that follow efforts or velocities stop at their limits; judged by simulated shafts with inertia."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from dxlrun.run.virtual_run import VirtualRobot
from dxlrun.simulation.faults.fault import parse_fault
from dxlrun.simulation.faults.script import FaultScript

LIMIT = math.radians(60)
LOOK_NS = 5_000_000


def robot_file(directory: Path, inertia: float, rate: float, law: str, policies: str = "") -> Path:
    path = directory / "one.yaml"
    path.write_text(
        "name: one\nbuses:\n  main: {port: sim, protocol: 2.0, baud_rate: 3_000_000,\n"
        f"    return_delay_time: 20 us, adapter: {{latency: 0 ms}}}}\nloop: {{rate: {rate}}}\njoints:\n"
        "  arm: {bus: main, id: 1, model: XM430-W350, reference: 180 deg, direction: 1,\n"
        f"    simulation: {{inertia: {inertia} kg m^2}},\n"
        "    limits: {position: [-60 deg, 60 deg], effort: 1.2 A}}\n"
        f"controllers:\n  mover: {{type: joint_group_{law}_controller, joints: [arm]}}\n"
        f"policies: {{exit_timeout: 3 s{policies}}}\n"
    )
    return path


def watch(robot: VirtualRobot, seconds: float, angles: list[float]) -> None:
    """Note where the shaft is, every 5 ms, counted from the middle."""
    servo = robot.buses[0].servo(1)

    def look(t_ns: int) -> None:
        servo.advance(t_ns)
        angles.append(servo.position - math.pi)

    for t_ns in range(0, round(seconds * 1e9), LOOK_NS):
        robot.buses[0].at(t_ns, partial(look, t_ns))


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize(
    ("law", "kind", "most", "beyond"),
    [("effort", "efforts", 1.2, 0.07), ("pwm", "pwm", 1.0, 0.07), ("velocity", "velocities", 4.0, 0.01)],
)
@pytest.mark.parametrize(("inertia", "rate"), [(0.0005, 50), (0.002, 100), (0.02, 50), (0.06, 100)])
def test_a_joint_that_is_driven_outward_stops_at_its_limit(  # noqa: PLR0917  fixtures
    tmp_path: Path,
    steered: Callable[..., Any],
    asking: Any,
    inertia: float,
    rate: float,
    law: str,
    kind: str,
    most: float,
    beyond: float,
    side: int,
) -> None:
    angles: list[float] = []
    asks = [asking(0.2, "mover", kind, {kind: [side * most]})]
    steered(
        robot_file(tmp_path, inertia, rate, law), 2.5, asks, before=lambda robot: watch(robot, 2.5, angles)
    )
    ways = [side * angle for angle in angles]
    assert max(ways) > LIMIT - 0.15, "it comes near its limit"
    assert max(ways) < LIMIT + beyond
    assert max(ways[-100:]) - min(ways[-100:]) < 0.03, "it rests there"


@pytest.mark.parametrize("side", [1, -1])
def test_a_trajectory_by_velocities_does_not_pass_a_limit(tmp_path, steered, asking, side):
    angles: list[float] = []
    file = robot_file(tmp_path, 0.02, 50, "velocity")
    law = "{type: joint_trajectory_controller, joints: [arm], command_interface: velocity, gains: {p: 5.0}}"
    group = "{type: joint_group_velocity_controller, joints: [arm]}"
    file.write_text(file.read_text().replace(group, law))
    points = {"points": [{"time": 0.4, "positions": [side * LIMIT]}]}
    asks = [asking(1.2, "mover", "trajectory", points)]
    steered(file, 2.5, asks, before=lambda robot: watch(robot, 2.5, angles))
    assert max(side * angle for angle in angles) == pytest.approx(LIMIT, abs=0.01)


def test_a_joint_beyond_its_limit_is_driven_back_slowly_by_its_effort_and_by_hold(tmp_path, steered, asking):
    """A push sends it beyond; the servo goes on by itself when the run is over."""
    angles: list[float] = []

    def push(robot: VirtualRobot) -> None:
        watch(robot, 0.6, angles)
        servo = robot.buses[0].servo(1)
        robot.buses[0].at(300_000_000, lambda: servo.turn_by_hand(math.pi + LIMIT + 0.5))

    run = steered(robot_file(tmp_path, 0.02, 100, "effort", ", on_exit: hold"), 0.5, before=push)
    servo, end_ns = run.robot.buses[0].servo(1), run.robot.clock.now_ns()
    for t_ns in range(end_ns, end_ns + 2_000_000_000, LOOK_NS):
        servo.advance(t_ns)
        angles.append(servo.position - math.pi)
    beyond = angles[angles.index(max(angles)) :]
    assert servo.torque_on
    assert beyond[0] == pytest.approx(LIMIT + 0.5, abs=0.01)
    assert beyond[-1] == pytest.approx(LIMIT, abs=0.01)
    back = max(before - after for before, after in zip(beyond, beyond[10:], strict=False))
    assert back < 0.6 * 10 * LOOK_NS * 1e-9


@pytest.mark.parametrize(
    ("protocol", "model", "faults"),
    [
        # it hears, but its replies are lost; Protocol 1.0 has no Bus Watchdog
        (1.0, "MX-28", ["lose servo=1 at=1s count=8"]),
        # its Bus Watchdog stops it; it answers again, but is not taken back
        (2.0, "XM430-W350", ["silence servo=1 at=1s for=230ms", "other_model servo=1 number=1060 at=1s"]),
    ],
)
def test_a_lost_wheel_does_not_go_on(  # noqa: PLR0917  fixtures
    tmp_path: Path, steered: Callable[..., Any], asking: Any, protocol: float, model: str, faults: list[str]
) -> None:
    angles: list[float] = []

    def before(robot: VirtualRobot) -> None:
        watch(robot, 2.1, angles)
        FaultScript([parse_fault(fault) for fault in faults]).attach(robot.buses)

    file, arm = robot_file(tmp_path, 0.002, 50, "velocity"), "XM430-W350, reference: 180 deg, direction: 1,\n"
    file.write_text(
        file.read_text()
        .replace("protocol: 2.0", f"protocol: {protocol}")
        .replace(arm, f"{model}, reference: 180 deg, direction: 1, continuous: true,\n")
        .replace("position: [-60 deg, 60 deg], effort: 1.2 A", "velocity: 6 rad/s")
    )
    steered(file, 2.0, [asking(0.2, "mover", "velocities", {"velocities": [3.0]})], before=before)
    at = {second: angles[round(second * 1e9) // LOOK_NS] for second in (0.5, 0.9, 1.35, 1.95)}
    assert at[0.9] - at[0.5] > 0.3, "it turns"
    assert at[1.95] - at[1.35] == pytest.approx(0.0, abs=0.01)
