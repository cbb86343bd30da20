"""Limits of velocity, and of joints that follow efforts or velocities, judged by simulated shafts."""

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from tests.kit.clients import Ask, steered
from tests.kit.line_faults import turn_by_hand

from dxlrun.run.virtual_run import VirtualRobot
from dxlsim.faults.fault import parse_fault
from dxlsim.faults.script import FaultScript

SPEED = 0.5
LIMIT = math.radians(60)
SERVOS = {1.0: "model: AX-12A, reference: 150 deg", 2.0: "model: XM430-W350, reference: 180 deg"}
LOOK_NS = 5_000_000
COMMANDS = {"positions": {"positions": [0.6]}, "posvel": {"positions": [0.6], "velocities": [5.0]}}
POSITION = "type: joint_group_position_controller"
SLOW = f"limits: {{velocity: {SPEED} rad/s}}"


def robot_file(  # noqa: PLR0917  in the order of the file
    directory: Path,
    rate: float,
    joint: str,
    controller: str,
    protocol: float = 2.0,
    servo: str = "",
    policies: str = "",
) -> Path:
    """Write a robot of one joint, `arm`, with one controller, `mover`."""
    path = directory / "one.yaml"
    path.write_text(
        f"name: one\nbuses:\n  main: {{port: sim, protocol: {protocol}, baud_rate: 1_000_000,\n"
        f"    return_delay_time: 20 us, adapter: {{latency: 0 ms}}}}\nloop: {{rate: {rate}}}\njoints:\n"
        f"  arm: {{bus: main, id: 1, {servo or SERVOS[protocol]}, direction: 1, {joint}}}\n"
        f"controllers:\n  mover: {{{controller}, joints: [arm]}}\n"
        f"policies: {{exit_timeout: 20 s{policies}}}\n"
    )
    return path


def driven(directory: Path, inertia: float, rate: float, controller: str, policies: str = "") -> Path:
    """Write a robot whose joint has an inertia and follows what its controller drives it with."""
    limits = "limits: {position: [-60 deg, 60 deg], effort: 1.2 A}"
    joint = f"simulation: {{inertia: {inertia} kg m^2}}, {limits}"
    return robot_file(directory, rate, joint, controller, policies=policies)


class Shaft:
    """Notes where the shaft is, every 5 ms, rad from the middle of an XM430."""

    def __init__(self) -> None:
        self.angles: list[float] = []

    def watch(self, robot: VirtualRobot, seconds: float = 9.0) -> None:
        self._servo = robot.buses[0].servo(1)
        for t_ns in range(0, round(seconds * 1e9), LOOK_NS):
            robot.buses[0].at(t_ns, partial(self.look, t_ns))

    def watching(self, *faults: str) -> Callable[[VirtualRobot], None]:
        """Return a function that watches the shaft, and injects faults."""

        def begin(robot: VirtualRobot) -> None:
            self.watch(robot)
            FaultScript([parse_fault(fault) for fault in faults]).attach(robot.buses)

        return begin

    def look(self, t_ns: int) -> None:
        self._servo.advance_to(t_ns)
        self.angles.append(self._servo.shaft_angle - math.pi)

    def too_far(self, limit: float) -> float:
        """Return by how much more than the limit's way, rad, the shaft went in any 10 ms to 1 s.

        A servo that begins to move is behind its own trajectory for some 50 ms, and then catches up.
        """
        way = np.array(self.angles)
        looks = (2, 5, 10, 20, 50, 100, 200)
        return max(float(np.abs(way[n:] - way[:-n]).max()) - limit * n * LOOK_NS * 1e-9 for n in looks)

    @property
    def way(self) -> float:
        return self.angles[-1] - self.angles[0]


@pytest.fixture
def shaft():
    return Shaft()


# Velocity

MOVE = Ask(1.0, "mover", "positions", COMMANDS["positions"])


@pytest.mark.parametrize(
    ("rate", "kind"),
    [(1, "positions"), (10, "positions"), (50, "posvel"), (500, "positions")],
)
@pytest.mark.parametrize("protocol", [1.0, 2.0])
def test_the_shaft_is_never_faster_than_the_limit(tmp_path, shaft, protocol, rate, kind):
    controller = f"type: joint_group_{kind.removesuffix('s')}_controller"
    file = robot_file(tmp_path, rate, SLOW, controller, protocol)
    steered(tmp_path, file, 4.5, [Ask(1.0, "mover", kind, COMMANDS[kind])], before=shaft.watch)
    assert shaft.way == pytest.approx(0.6, abs=0.02), "it arrives"
    assert shaft.too_far(SPEED) <= 0.01


@pytest.mark.parametrize("protocol", [1.0, 2.0])
def test_after_a_gear_the_joint_is_never_faster_than_its_limit(tmp_path, shaft, protocol):
    joint = f"gear_ratio: 3, limits: {{position: [-40 deg, 40 deg], velocity: {SPEED} rad/s}}"
    file = robot_file(tmp_path, 1, joint, POSITION, protocol)
    steered(tmp_path, file, 4.5, [MOVE], before=shaft.watch)
    assert shaft.way == pytest.approx(3 * 0.6, abs=0.05), "it arrives"
    assert shaft.too_far(3 * SPEED) <= 0.03


def test_a_servo_that_lost_its_profile_by_a_reset_is_not_faster_either(tmp_path, shaft):
    """Profile Velocity is RAM: 0, no limit, after a reset. A joint that returned waits for a command."""
    file = robot_file(tmp_path, 10, SLOW, POSITION, policies=", on_returned_servo: hold")
    asks = [MOVE, Ask(4.0, "mover", "positions", {"positions": [-0.6]})]
    steered(tmp_path, file, 7.0, asks, before=shaft.watching("brownout servo=1 at=1.5s for=200ms"))
    returned, asked = (shaft.angles[round(seconds * 1e9) // LOOK_NS] for seconds in (1.7, 4.0))
    assert 0.1 < returned < 0.4, "on its way"
    assert asked == pytest.approx(returned, abs=0.01), "it waits"
    assert shaft.way == pytest.approx(-0.6, abs=0.02), "it has torque again, and moves"
    assert shaft.too_far(SPEED) <= 0.01


# Position, of joints that are driven


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize(
    ("law", "kind", "most", "beyond"),
    [("effort", "efforts", 1.2, 0.07), ("pwm", "pwm", 1.0, 0.07), ("velocity", "velocities", 4.0, 0.01)],
)
@pytest.mark.parametrize(("inertia", "rate"), [(0.0005, 50), (0.06, 100)])
def test_a_joint_that_is_driven_outward_stops_at_its_limit(  # noqa: PLR0917  its cases
    tmp_path, shaft, inertia, rate, law, kind, most, beyond, side
):
    file = driven(tmp_path, inertia, rate, f"type: joint_group_{law}_controller")
    asks = [Ask(0.2, "mover", kind, {kind: [side * most]})]
    steered(tmp_path, file, 2.5, asks, before=shaft.watch)
    ways = [side * angle for angle in shaft.angles]
    assert max(ways) > LIMIT - 0.15, "it comes near its limit"
    assert max(ways) < LIMIT + beyond
    assert np.ptp(ways[-100:]) < 0.03, "it rests there"


@pytest.mark.parametrize("side", [1, -1])
def test_a_trajectory_by_velocities_does_not_pass_a_limit(tmp_path, shaft, side):
    law = "type: joint_trajectory_controller, command_interface: velocity, gains: {p: 5.0}"
    points = {"points": [{"time": 0.4, "positions": [side * LIMIT]}]}
    asks = [Ask(1.2, "mover", "trajectory", points)]
    steered(tmp_path, driven(tmp_path, 0.02, 50, law), 2.5, asks, before=shaft.watch)
    assert max(side * angle for angle in shaft.angles) == pytest.approx(LIMIT, abs=0.01)


def test_a_joint_beyond_its_limit_is_driven_back_slowly_by_its_effort_and_by_hold(tmp_path, shaft):
    """A push sends it beyond; the servo goes on by itself when the run is over."""

    def push(robot: VirtualRobot) -> None:
        shaft.watch(robot, 0.6)
        servo = robot.buses[0].servo(1)
        robot.buses[0].at(300_000_000, lambda: turn_by_hand(servo, math.pi + LIMIT + 0.5))

    file = driven(tmp_path, 0.02, 100, "type: joint_group_effort_controller", ", on_exit: hold")
    run = steered(tmp_path, file, 0.5, before=push)
    end_ns = run.robot.clock.now_ns()
    for t_ns in range(end_ns, end_ns + 2_000_000_000, LOOK_NS):
        shaft.look(t_ns)
    beyond = shaft.angles[shaft.angles.index(max(shaft.angles)) :]
    assert run.robot.buses[0].servo(1).torque_on
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
def test_a_lost_wheel_does_not_go_on(tmp_path, shaft, protocol, model, faults):
    joint = "continuous: true, simulation: {inertia: 0.002 kg m^2}, limits: {velocity: 6 rad/s}"
    servo = f"model: {model}, reference: 180 deg"
    file = robot_file(tmp_path, 50, joint, "type: joint_group_velocity_controller", protocol, servo)
    steered(
        tmp_path,
        file,
        2.0,
        [Ask(0.2, "mover", "velocities", {"velocities": [3.0]})],
        before=shaft.watching(*faults),
    )
    at = {second: shaft.angles[round(second * 1e9) // LOOK_NS] for second in (0.5, 0.9, 1.35, 1.95)}
    assert at[0.9] - at[0.5] > 0.3, "it turns"
    assert at[1.95] - at[1.35] == pytest.approx(0.0, abs=0.01)
