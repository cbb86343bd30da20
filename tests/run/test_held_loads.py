"""A lost joint lets no other joint of its controllers fall or run away.

Judged by the simulated shafts, which gravity pulls at: the shoulder is loaded when the elbow is lost.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.kit.sampled_run import SampledRun, texts
from tests.kit.stories import prepared, silence

from dxlrun.channels.cycle import Floats, Torque
from dxlrun.channels.event_records import EventCode
from dxlrun.log.log_reader import Log, open_log

TICK_DEG = 360 / 4096
HELD_DEG = 0.5
"""By how much a joint that a law holds may settle: an integral is still on its way to the load."""
COMMANDED_MS = 200
MOVING_MS, RESTING_MS, GONE_MS = 700, 2200, 600
"""When the elbow is lost: on the way of the trajectory, or behind it; and for how long."""
NOTICED_MS = 80
"""A servo counts as lost by then: three replies and 50 ms."""
END_S = 3.2
MOTOR = Path(__file__).parents[2] / "robots" / "motors" / "XM430-W350.motor.yaml"
HANGS_DEG = -40
"""Where the shoulder's weight hangs straight down."""
SHAPE = f"""\
name: held_loads
buses:
  main: {{port: sim, protocol: 2.0, baud_rate: 4_000_000, adapter: {{kind: direct}}, return_delay_time: 0 us}}
loop: {{rate: 100}}
joint_defaults:
  bus: main
  model: XM430-W350
  reference: 180 deg
  direction: 1
  motor: {MOTOR}
  limits: {{position: [-100 deg, 100 deg], velocity: 4 rad/s, effort: 1.2 A}}
joints:
  shoulder: {{id: 1, simulation: {{inertia: 0.01 kg m^2, gravity: 0.6 Nm, gravity_angle: {HANGS_DEG} deg}}}}
  elbow: {{id: 2, simulation: {{inertia: 0.004 kg m^2, gravity: 0.2 Nm}}}}
model: {{urdf: arm.urdf}}
policies: {{on_returned_servo: hold}}
controllers:
"""
REACH_M, MASS_KG = 0.15, 0.6 / 9.81 / 0.15
COM = (
    f"{REACH_M * math.sin(math.radians(-HANGS_DEG)):.5f} 0 {-REACH_M * math.cos(math.radians(HANGS_DEG)):.5f}"
)
URDF = f"""<robot name="arm"><link name="base"/>
<joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 -1 0"/>
<limit lower="-1.8" upper="1.8" effort="4" velocity="4"/></joint>
<link name="upper"><inertial><origin xyz="{COM}"/><mass value="{MASS_KG:.5f}"/>
<inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="elbow" type="revolute"><parent link="upper"/><child link="lower"/><axis xyz="0 -1 0"/>
<limit lower="-1.8" upper="1.8" effort="4" velocity="4"/></joint>
<link name="lower"><inertial><mass value="0.001"/>
<inertia ixx="1e-6" iyy="1e-6" izz="1e-6" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>"""
OWN = "joints: [shoulder, elbow]"
ARM = f"arm: {{type: joint_trajectory_controller, {OWN}"
PID = f"pid: {{type: pid_controller, {OWN}"
GAINS = "gains: {p: 6.0, i: 8.0, d: 0.15}, derivative_filter: 5 ms"
LAW = f"{PID}, {GAINS}, integral_limit: 0.8}}"
SECONDS = 1.2
POINTS = {"points": [{"positions": [0.7, -0.35], "time": SECONDS}]}
POSITIONS = {"positions": [0.4, -0.35]}


@dataclass(frozen=True)
class Chain:
    """Controllers of a robot, and the command that one of them gets."""

    controllers: tuple[str, ...]
    to: str = "arm"
    kind: str = "trajectory"
    command: Mapping[str, Any] = field(default_factory=lambda: POINTS)


CHAINS = {
    "trajectory into pid": Chain((f"{ARM}, into: [pid]}}", LAW)),
    "trajectory into pid without integral": Chain(
        (f"{ARM}, into: [pid]}}", f"{PID}, gains: {{p: 6.0, d: 0.15}}}}")
    ),
    "trajectory into pid into pid": Chain(
        (
            f"{ARM}, into: [pid]}}",
            f"{PID}, command_interface: velocity, gains: {{p: 8.0}}, into: [speed]}}",
            f"speed: {{type: pid_controller, {OWN}, reference: velocity, gains: {{p: 1.0, i: 8.0}}}}",
        )
    ),
    "trajectory of efforts": Chain((f"{ARM}, command_interface: effort, {GAINS}}}",)),
    "trajectory of velocities": Chain((f"{ARM}, command_interface: velocity, gains: {{p: 5.0}}}}",)),
    "trajectory": Chain((f"{ARM}}}",)),
    "pid": Chain((LAW,), "pid", "positions", POSITIONS),
    "pid without integral": Chain((f"{PID}, gains: {{p: 6.0, d: 0.15}}}}",), "pid", "positions", POSITIONS),
    "pid of velocities": Chain(
        (f"{PID}, reference: velocity, gains: {{p: 1.0, i: 8.0}}}}",),
        "pid",
        "velocities",
        {"velocities": [0.2, -0.1]},
    ),
    "pid of positions": Chain(
        (f"{PID}, command_interface: position, gains: {{p: 0.2, i: 1.0}}}}",), "pid", "positions", POSITIONS
    ),
    "efforts": Chain(
        (f"group: {{type: joint_group_effort_controller, {OWN}}}",),
        "group",
        "efforts",
        {"efforts": [0.2, 0.0]},
    ),
    "velocities": Chain(
        (f"group: {{type: joint_group_velocity_controller, {OWN}}}",),
        "group",
        "velocities",
        {"velocities": [0.2, -0.1]},
    ),
}
FLOATING = Chain((f"gravity: {{type: gravity_compensation, {OWN}, command_interface: effort}}",), "", "")


class Arm(SampledRun):
    """A robot on virtual time that got its command."""

    def __init__(self, folder: Path, chain: Chain, seconds: float = END_S) -> None:
        (folder / "arm.urdf").write_text(URDF)
        super().__init__(folder, SHAPE + "".join(f"  {line}\n" for line in chain.controllers), seconds)
        if chain.kind:
            self.ask(COMMANDED_MS, prepared(self.robot, chain.to, chain.kind, **chain.command))

    def lose(self, at_ms: float, fault: str) -> None:
        """Let the elbow not answer for a while, or be without power."""
        if fault == "silent":
            silence(self.robot, [2], at_ms, at_ms + GONE_MS)
        else:
            self.at(at_ms, lambda: self.servos["elbow"].cut_power(round((at_ms + GONE_MS) * 1e6)))

    def shoulder_deg(self, from_ms: float, to_ms: float) -> Floats:
        return np.degrees(self.shaft("shoulder", from_ms, to_ms))


@pytest.mark.parametrize(
    ("name", "fault"),
    [
        *((name, "silent") for name in CHAINS),
        ("trajectory into pid", "without power"),
        ("pid", "without power"),
    ],
)
def test_a_loaded_joint_stays_while_another_one_of_its_controllers_is_lost(tmp_path, name, fault):
    arm = Arm(tmp_path, CHAINS[name])
    arm.lose(RESTING_MS, fault)
    log = arm.run()
    stopping = 5 if "velocities" in CHAINS[name].command else 1
    held = arm.shoulder_deg(RESTING_MS + stopping * NOTICED_MS, RESTING_MS + GONE_MS)
    assert np.ptp(held) <= HELD_DEG
    assert commanded_when_lost(log) == 0
    goals = texts(log, EventCode.GOAL_ENDED)
    assert all("reached" in text for text in goals)


def commanded_when_lost(log: Log) -> int:
    """Return in how many cycles the elbow was commanded while it was lost."""
    gone = log.cycles["torque"][:, 1] == Torque.LOST
    assert gone.sum() > 50
    commands = ("command_position", "command_velocity", "command_effort", "command_pwm")
    return sum(int(np.isfinite(log.cycles[name][gone, 1]).sum()) for name in commands)


@pytest.mark.parametrize(
    "name", ["trajectory into pid", "trajectory into pid into pid", "trajectory of efforts"]
)
def test_a_moving_joint_comes_to_rest_while_another_one_is_lost_and_a_replay_decides_the_same(tmp_path, name):
    arm = Arm(tmp_path, CHAINS[name])
    arm.lose(MOVING_MS, "silent")
    arm.run()
    before = arm.shoulder_deg(MOVING_MS, MOVING_MS + NOTICED_MS)
    held = arm.shoulder_deg(MOVING_MS + NOTICED_MS, MOVING_MS + GONE_MS)
    assert np.ptp(before) > 1, "it did not move"
    assert np.ptp(held) < 3
    assert np.ptp(held[25:]) < 0.5


def test_the_law_and_its_topic_go_on_while_a_joint_is_lost(tmp_path):
    arm = Arm(tmp_path, CHAINS["trajectory into pid"])
    arm.lose(RESTING_MS, "silent")
    arm.run()
    times_ms = open_log(arm.path).columns("/pid/state")["t_ns"] / 1e6
    assert np.diff(times_ms).max() < 1.5 * 20


@pytest.mark.needs("physics")
@pytest.mark.parametrize("fault", ["silent", "without power"])
def test_a_floating_joint_floats_while_another_one_is_lost(tmp_path, fault):
    arm = Arm(tmp_path, FLOATING)
    arm.lose(RESTING_MS, fault)
    arm.run()
    assert np.ptp(arm.shoulder_deg(300, RESTING_MS)) < 10, "the law does not carry it"
    assert np.ptp(arm.shoulder_deg(RESTING_MS, END_S * 1000)) <= 4 * TICK_DEG


def test_a_goal_in_which_a_joint_is_lost_is_aborted_with_servo_and_distance(tmp_path):
    arm = Arm(tmp_path, CHAINS["trajectory"])
    arm.at(MOVING_MS, arm.servos["elbow"].silence)
    log = arm.run()
    (text,) = texts(log, EventCode.GOAL_ENDED)
    found = re.fullmatch(
        r"goal 1 aborted: after 2\.2\d+ s, joint elbow \(ID 2 on bus main\) does not answer; "
        r"it is (\d+\.\d+) deg off",
        text,
    )
    assert found, text
    off = abs(math.degrees(-0.35) - float(np.degrees(log.cycles["position"][-1, 1])))
    assert float(found[1]) == pytest.approx(off, abs=0.01)


STEPS = "steps: [{time: 400 ms, pose: {shoulder: 20 deg}}, {time: 400 ms, pose: {shoulder: 0 deg}}]"
KEYFRAMES = (
    f"player: {{type: keyframe_player, {OWN}, start: wave, motions: {{wave: {{repeat: 50, {STEPS}}}}}}}"
)


def test_the_motion_of_an_activation_is_not_begun_again_when_a_joint_was_given_torque(tmp_path):
    arm = Arm(tmp_path, Chain((KEYFRAMES,), "", ""), seconds=5.0)
    arm.lose(MOVING_MS, "without power")
    arm.ask(4000, prepared(arm.robot, "player", "play", motion="wave"))
    log = arm.run()
    back_ms = next(event.t_ns for event in log.events if event.code == EventCode.SERVO_BACK) / 1e6
    assert np.ptp(arm.shoulder_deg(0, MOVING_MS)) > 15
    assert np.ptp(arm.shoulder_deg(back_ms, 4000)) <= HELD_DEG
    assert np.ptp(arm.shoulder_deg(4000, 5000)) > 15


def test_a_group_of_efforts_carries_its_other_joint_when_one_was_given_torque(tmp_path):
    arm = Arm(tmp_path, CHAINS["efforts"])
    arm.lose(RESTING_MS - 500, "without power")
    log = arm.run()
    assert [event for event in log.events if "restarted at the measured positions" in event.text]
    assert np.ptp(arm.shoulder_deg(RESTING_MS - 500, END_S * 1000)) <= HELD_DEG
    assert log.cycles["goal_effort"][-1].tolist() == pytest.approx([0.2, 0.0])
