"""Goals of whole robots on virtual time: reached, missed and aborted, compared with the simulated shafts."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

import pytest
from tests.kit.clients import Ask, steered
from tests.kit.commands import Dxlrun
from tests.kit.stories import Clients, prepared

from dxlrun.channels.event_records import EventCode
from dxlrun.run.virtual_run import VirtualRobot
from dxlrun.testing import read_log, simulated_robot

BUSES = """
buses:
  main: {port: sim, protocol: 2.0, baud_rate: 1_000_000, adapter: {kind: direct}, return_delay_time: 0 us}
"""
FAR_GOAL = f"""
name: far_goal{BUSES}
loop: {{rate: 50}}
joints:
  reel:
    {{bus: main, id: 1, model: XM430-W350, reference: 180 deg, direction: 1, continuous: true,
     limits: {{velocity: 2 rad/s}}}}
  elbow:
    {{bus: main, id: 2, model: XM430-W350, reference: 180 deg, direction: 1,
     limits: {{position: [-90 deg, 90 deg], velocity: 1 rad/s}}}}
controllers:
  reel: {{type: joint_trajectory_controller, joints: [reel]}}
  elbow: {{type: joint_trajectory_controller, joints: [elbow]}}
"""
FAR = """
name: far
motions:
  - controller: reel
    points:
      - {time: 1 s, joints: {reel: {position: 0 rad}}}
      - {time: 3 s, joints: {reel: {position: 8 rad}}}
"""
PEAK = """
name: peak
motions:
  - controller: elbow
    points:
      - {time: 1 s, joints: {elbow: {position: -80 deg, velocity: 0 deg/s}}}
      - {time: 4 s, joints: {elbow: {position: 80 deg, velocity: 0 deg/s}}}
"""
SOFT_GRIP = f"""
name: omx{BUSES}
loop: {{rate: 100}}
joints:
  j1:
    {{bus: main, id: 1, model: XL330-M288, reference: 180 deg, direction: 1,
     limits: {{position: [-90 deg, 90 deg], velocity: 2 rad/s}}}}
  grip:
    {{bus: main, id: 2, model: XL330-M288, reference: 180 deg, direction: 1,
     limits: {{position: [-90 deg, 90 deg], velocity: 2 rad/s}}}}
controllers:
  arm: {{type: joint_trajectory_controller, joints: [j1, grip], into: [soft]}}
  soft: {{type: thermal_governor, joints: [j1, grip], command_interface: poseffort, limit: 60}}
"""
CANCEL_LIMIT = f"""
name: cancel_limit{BUSES}
loop: {{rate: 100}}
joints:
  elbow:
    {{bus: main, id: 1, model: XM430-W350, reference: 180 deg, direction: 1,
     limits: {{position: [-90 deg, 60 deg], velocity: 4 rad/s, acceleration: 10 rad/s^2}}}}
controllers:
  arm: {{type: joint_trajectory_controller, joints: [elbow]}}
"""


def written(directory: Path, text: str, name: str = "robot.yaml") -> Path:
    path = directory / name
    path.write_text(text)
    return path


def shaft(robot: VirtualRobot, number: int) -> float:
    """Return where the shaft of a servo stands, rad from the middle of its turn."""
    return robot.buses[0].servo(number).shaft_angle - math.pi


def ended(run: Any) -> list[dict[str, Any]]:
    """Return how the goals ended, in order."""
    return [json.loads(event.data) for event in run.log.events if event.code == EventCode.GOAL_ENDED]


@pytest.fixture
def play(tmp_path: Path, dxlrun: Dxlrun, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Run a robot with a motion from the command line; return what the run and `analyze` said."""

    def played(robot: str, motion: str) -> tuple[Any, Any]:
        monkeypatch.chdir(tmp_path)
        ran = dxlrun(
            written(tmp_path, robot), "--virtual", "--play", written(tmp_path, motion, "motion.yaml")
        )
        (log,) = [line.split()[1] for line in ran.out.splitlines() if line.startswith("log: ")]
        return ran, dxlrun("analyze", log)

    return played


def test_a_played_goal_that_the_velocity_limit_holds_back_is_missed(play):
    ran, analyzed = play(FAR_GOAL, FAR)
    assert ran.code == 1
    assert "failed: " in ran.out
    assert "reel missed the goal of its trajectory: after 4.000 s, joint reel is " in ran.out
    for said in (ran.out, analyzed.out):
        assert "joint reel is 12" in said, "it is 4.15 rad off at the end, and has one second more"
    assert analyzed.code == 1
    assert analyzed.out.splitlines()[0].startswith("Not good: ")
    assert "(reel 12" in analyzed.out
    assert "0 of 1 goal reached" in analyzed.out


def test_a_played_goal_that_is_aborted_at_once_fails_the_run(play):
    ran, analyzed = play(FAR_GOAL, PEAK)
    assert (ran.code, analyzed.code) == (1, 1)
    assert "failed: " in ran.out
    assert "elbow aborted the goal of its trajectory" in ran.out
    assert analyzed.out.splitlines()[0].startswith("Not good: ")


def test_a_jammed_gripper_under_a_trajectory_is_missed(tmp_path):
    def jam(robot: VirtualRobot) -> None:
        bus = robot.buses[0]
        bus.at(500_000_000, lambda: bus.servo(2).jam_shaft(True))

    to = {"points": [{"time": 1.0, "positions": [math.radians(40)] * 2}]}
    run = steered(
        tmp_path, written(tmp_path, SOFT_GRIP), 3.0, [Ask(0.45, "arm", "trajectory", to)], before=jam
    )
    (goal,) = ended(run)
    off = math.radians(40) - shaft(run.robot, 2)
    assert off > math.radians(30)
    assert goal["joint"] == "grip"
    if goal["status"] == "aborted":  # its servo shut itself down for overload, a moment ago or before
        assert re.search(r"joint grip \(.*\) has (no torque|not confirmed its torque)", goal["text"])
    else:
        assert goal["status"] == "missed"
        assert goal["error"] == pytest.approx(off, abs=0.01)
    assert shaft(run.robot, 1) == pytest.approx(math.radians(40), abs=0.05)


def test_a_cancel_near_a_limit_stops_inside_it(tmp_path):
    asks = [
        Ask(0.2, "arm", "trajectory", {"points": [{"time": 0.65, "positions": [math.radians(-88)]}]}),
        Ask(2.5, "arm", "trajectory", {"points": [{"time": 0.66, "positions": [math.radians(59)]}]}),
        Ask(3.1, "", "cancel", {"controller": "arm"}),
    ]
    farthest = [0.0]

    def watch(robot: VirtualRobot) -> None:
        bus = robot.buses[0]
        for at_ms in range(2500, 5000, 5):
            bus.at(at_ms * 1_000_000, lambda: farthest.append(shaft(robot, 1)))

    run = steered(tmp_path, written(tmp_path, CANCEL_LIMIT), 5.0, asks, before=watch)
    assert [goal["status"] for goal in ended(run)] == ["reached", "cancelled"]
    assert math.radians(30) < max(farthest) < math.radians(60.5)


HELD_OFF = """
name: held_off
motions:
  - controller: reel
    points:
      - {time: 1 s, joints: {reel: {position: 0 rad}}}
      - {time: 3 s, joints: {reel: {position: 4.2 rad}}}
"""


@pytest.mark.parametrize(
    ("tolerance", "status"),
    [
        ("", "reached"),
        ("tolerance: {time: 0 s}, ", "missed"),
        ("tolerance: {position: inf, velocity: inf, time: 0 s}, ", "reached"),
        ("tolerance: {position: 30 deg, velocity: inf, time: 0 s}, ", "reached"),
        ("tolerance: 0.01 deg, ", "missed"),
    ],
)
def test_the_tolerance_of_a_joint_decides(tmp_path, tolerance, status):
    """At the end of its motion the joint is 0.2 rad behind, and 0.1 s later at its goal."""
    robot = FAR_GOAL.replace("id: 1, ", f"id: 1, {tolerance}")
    run = steered(tmp_path, written(tmp_path, robot), 5.0, play=[written(tmp_path, HELD_OFF, "motion.yaml")])
    (goal,) = ended(run)
    assert goal["status"] == status, goal


GROUP = f"""
name: group{BUSES}
loop: {{rate: 50}}
joints:
  pan:
    {{bus: main, id: 1, model: XM430-W350, reference: 180 deg, direction: 1, limits: {{velocity: 2 rad/s}},
     tolerance: {{time: 150 ms}}}}
  tilt:
    {{bus: main, id: 2, model: XM430-W350, reference: 180 deg, direction: 1, limits: {{velocity: 2 rad/s}},
     tolerance: {{time: 150 ms}}}}
controllers:
  neck: {{type: joint_group_position_controller, joints: [pan, tilt]}}
"""
NOD = """
name: nod
motions:
  - controller: neck
    points:
      - {time: 0.5 s, joints: {pan: {position: 0 deg}, tilt: {position: 0 deg}}}
      - {time: 1 s, joints: {tilt: {position: 30 deg}}}
      - {time: 1.5 s, joints: {pan: {position: 40 deg}}}
"""


def jam_tilt(robot: VirtualRobot) -> None:
    bus = robot.buses[0]
    bus.at(1_050_000_000, lambda: bus.servo(2).jam_shaft(True))


def cut_tilt(robot: VirtualRobot) -> None:
    bus = robot.buses[0]
    bus.at(700_000_000, lambda: bus.servo(2).cut_power(900_000_000))


@pytest.mark.parametrize(
    ("before", "status"),
    [(lambda robot: None, "reached"), (jam_tilt, "missed"), (cut_tilt, "aborted")],
    ids=["free", "jammed", "limp"],
)
def test_the_positions_that_a_motion_gives_a_group_controller_are_a_goal(tmp_path, before, status):
    run = steered(
        tmp_path,
        written(tmp_path, GROUP),
        4.0,
        before=before,
        play=[written(tmp_path, NOD, "motion.yaml")],
    )
    (goal,) = ended(run)
    assert goal["status"] == status, goal
    assert goal["controller"] == "neck"
    if status != "reached":
        assert goal["joint"] == "tilt"
        assert abs(shaft(run.robot, 2)) < math.radians(20)
    else:
        assert shaft(run.robot, 1) == pytest.approx(math.radians(40), abs=0.02)
        assert shaft(run.robot, 2) == pytest.approx(math.radians(30), abs=0.02)


SLOW = """
name: slow
motions:
  - controller: neck
    points:
      - time: 0 s
        joints: {pan: {position: 0 deg, velocity: 60 deg/s}, tilt: {position: 0 deg, velocity: 60 deg/s}}
      - {time: 1 s, joints: {pan: {position: 60 deg, velocity: 30 deg/s}}}
"""


def test_a_played_goal_is_judged_when_its_commanded_speed_allows_it(tmp_path):
    robot = GROUP.replace("joint_group_position_controller", "joint_group_posvel_controller")
    motion = written(tmp_path, SLOW, "motion.yaml")
    run = steered(tmp_path, written(tmp_path, robot), 4.5, play=[motion])
    (goal,) = ended(run)
    assert goal["status"] == "reached", goal
    assert shaft(run.robot, 1) == pytest.approx(math.radians(60), abs=0.02)


def test_a_command_of_a_client_takes_the_place_of_a_planned_goal(tmp_path):
    asks = [Ask(1.2, "neck", "positions", {"positions": [0.1, 0.1]})]
    run = steered(tmp_path, written(tmp_path, GROUP), 4.0, asks, play=[written(tmp_path, NOD, "motion.yaml")])
    assert [goal["status"] for goal in ended(run)] == ["preempted"]


PAN = f"""
name: c{BUSES}
loop: {{rate: 50}}
joints:
  pan:
    {{bus: main, id: 1, model: XM430-W350, reference: 180 deg, direction: 1, continuous: true,
     limits: {{velocity: 6 rad/s}}}}
controllers:
  arm: {{type: joint_trajectory_controller, joints: [pan]}}
"""


def way(*degrees: float) -> dict[str, object]:
    points = [{"time": 1.5 * n, "positions": [math.radians(each)]} for n, each in enumerate(degrees, 1)]
    return {"points": points}


@pytest.mark.parametrize(
    ("robot", "end"),
    [
        (PAN, 178.0),
        (PAN.replace("continuous: true", "continuous: true, wrap: true"), -182.0),
        (PAN.replace("joints: [pan]", "joints: [pan], wrap: [pan]"), -182.0),
    ],
    ids=["turns", "joint", "controller"],
)
def test_a_wrapped_angle_is_reached_on_the_shorter_way(tmp_path, robot, end):
    asks = [Ask(0.2, "arm", "trajectory", way(-90, -179)), Ask(4.5, "arm", "trajectory", way(178))]
    run = steered(tmp_path, written(tmp_path, robot), 7.5, asks)
    assert [goal["status"] for goal in ended(run)] == ["reached", "reached"]
    assert math.degrees(shaft(run.robot, 1)) == pytest.approx(end, abs=1.0)
    warned = [event.text for event in run.log.events if "turns by" in event.text]
    assert bool(warned) is (end > 0)
    if warned:
        assert warned[0].startswith("joint pan turns by 357")


def test_points_of_a_wrapped_joint_follow_each_other_on_the_shorter_way(tmp_path):
    robot = PAN.replace("continuous: true", "continuous: true, wrap: true")
    asks = [Ask(0.2, "arm", "trajectory", way(-90, -179, 178, 90))]
    run = steered(tmp_path, written(tmp_path, robot), 8.0, asks)
    assert [goal["status"] for goal in ended(run)] == ["reached"]
    assert math.degrees(shaft(run.robot, 1)) == pytest.approx(90 - 360, abs=1.0)


def test_a_motion_that_turns_a_continuous_joint_the_longer_way_is_warned_of(tmp_path):
    from dxlrun.compile.robot_compiler import compile_robot
    from dxlrun.description.motion import read_motion
    from dxlrun.description.reading import read_robot

    motion = read_motion(written(tmp_path, FAR, "motion.yaml"), {})
    for wraps, warned in (("", 1), ("wrap: true, ", 0)):
        robot = read_robot(written(tmp_path, FAR_GOAL.replace("id: 1, ", f"id: 1, {wraps}")), {})
        found = [one.what for one in compile_robot(robot, [motion], None).warnings if "turns by" in one.what]
        assert found == ["reel turns by 458.4 deg from one point to the next"] * warned


def weighted(directory: Path, keys: str) -> Path:
    """Return a robot with a joint whose motor is known."""
    motor = Path(__file__).parents[2] / "robots/motors/XM430-W350.motor.yaml"
    written(directory, motor.read_text(), "a.motor.yaml")
    text = f"""
name: weight{BUSES}
loop: {{rate: 50}}
joints:
  arm: {{bus: main, id: 1, model: XM430-W350, reference: 180 deg, direction: 1, motor: a.motor.yaml, {keys}}}
controllers:
  arm: {{type: joint_trajectory_controller, joints: [arm]}}
"""
    return written(directory, text)


@pytest.mark.parametrize(
    ("keys", "warned"),
    [
        ("simulation: {gravity: 2 Nm}", "arm sags by up to 5.38 deg"),
        ("simulation: {gravity: 5 Nm}", "arm sags far"),
        ("simulation: {gravity: 1 Nm}", ""),
        ("simulation: {gravity: 2 Nm}, tolerance: 8 deg", ""),
        ("simulation: {gravity: 2 Nm}, registers: {position_p_gain: 1600}", ""),
        ("simulation: {gravity: 2 Nm}, registers: {position_i_gain: 100}", ""),
        ("simulation: {gravity: 2 Nm}, limits: {position: [-10 deg, 10 deg]}", ""),
    ],
)
def test_a_weight_that_keeps_a_joint_beyond_its_tolerance_is_warned_of(tmp_path, keys, warned):
    from dxlrun.compile.robot_compiler import compile_robot
    from dxlrun.description.reading import read_robot

    robot = weighted(tmp_path, keys)
    found = [one.what for one in compile_robot(read_robot(robot, {}), [], None).warnings]
    found = [one for one in found if "arm sags" in one]
    assert bool(found) is bool(warned), found
    assert warned in "".join(found)


@pytest.mark.parametrize(("gravity", "status"), [("2.5 Nm", "missed"), ("1 Nm", "reached")])
def test_a_weight_that_is_warned_of_keeps_a_goal_from_being_reached(tmp_path, gravity, status):
    asks = [Ask(0.2, "arm", "trajectory", way(90))]
    run = steered(tmp_path, weighted(tmp_path, f"simulation: {{gravity: {gravity}}}"), 4.0, asks)
    (goal,) = ended(run)
    off = math.degrees(math.pi / 2 - shaft(run.robot, 1))
    assert (goal["status"], off > 5.0) == (status, status == "missed"), (goal, off)


@pytest.mark.parametrize("protocol", [1.0, 2.0])
@pytest.mark.parametrize("before_ms", [3, 12])
def test_a_joint_that_shuts_itself_down_before_its_goal_is_judged_has_not_reached_it(
    tmp_path, protocol, before_ms
):
    """Its reply reports the error, so its torque is in doubt, although it still stands at the goal."""
    model = "MX-64" if protocol == 1.0 else "XM430-W350"
    (tmp_path / "arm.yaml").write_text(f"""\
name: arm
buses:
  main: {{port: sim, protocol: {protocol}, baud_rate: 1_000_000, return_delay_time: 0 us}}
loop: {{rate: 50}}
joints:
  a: {{bus: main, id: 1, model: {model}, reference: 180 deg, direction: 1}}
controllers:
  arm: {{type: joint_trajectory_controller, joints: [a]}}
""")
    judged_ms = 2000

    def run(overloads_ms: float | None) -> tuple[str, float]:
        log = tmp_path / "log.mcap"
        log.unlink(missing_ok=True)
        robot = simulated_robot(tmp_path / "arm.yaml", duration_s=judged_ms / 1000 + 0.8, log=log)
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
