"""Every standard controller when its stream ends, or a joint is lost: topics and holds continue."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

import numpy as np
import pytest
from tests.kit.virtual_run import VirtualRun

from dxlrun import Controller, Floats, LogReader, open_log
from dxlrun_controllers.plugin import dxlrun_controllers

pytestmark = pytest.mark.long

ROBOTS = Path(__file__).parents[2] / "robots"
JOINTS = ("shoulder", "elbow")
RATE, PERIOD_S = 50, 0.02
FIRST, LAST, END = 25, 75, 200
"""Cycles of the first and the last command, and of the end of the run."""
LEASE_S = 0.1
LEASE_OVER = LAST + round(LEASE_S / PERIOD_S)
STILL = END - 25
"""Cycle from which the joints rest; a law with feedback has settled."""
LOST_S = 1.2, 2.4
"""In the stream."""
NOTICED = 25
"""Cycles. A servo is lost after 50 ms; then the other one comes to rest."""
FORCES = ("joint_group_effort_controller", "joint_group_pwm_controller")
TICK = 2 * np.pi / 4096
Fields = Callable[[float], dict[str, Any]]


@dataclass(frozen=True)
class Entry:
    """A controller in a robot with two joints, and the stream that a client sends to it."""

    keys: dict[str, Any]
    kind: str = ""
    """Of the stream's commands; empty: they go to a group controller beside this one."""
    fields: Fields = lambda time_s: {"positions": [0.4 * time_s, 0.2 * time_s]}
    """Of the command at a time since the stream began, s"""
    below: bool = False
    """True: the group controller that gets the stream is `into` this one."""


def chunk(time_s: float) -> dict[str, Any]:
    ahead = [time_s + 0.1 * step for step in (1, 2, 3)]
    points = [{"time": each, "positions": [0.4 * each, 0.2 * each]} for each in ahead]
    return {"points": points, "now": time_s}


OWN: dict[str, Any] = {"joints": list(JOINTS)}
GAINS = {"gains": {"p": 4.0, "d": 0.1}}
SLOW = {"gains": {"p": 0.2, "feed_forward": 1.0}}
SPEEDS: Fields = lambda _: {"velocities": [0.4, 0.2]}  # noqa: E731  a table of such lines
PID = Entry(OWN | GAINS | {"command_interface": "velocity"}, "positions")
ENTRIES: dict[str, Entry | list[Entry]] = {
    "battery_state_broadcaster": Entry({"voltages": ["shoulder/voltage"], "warn": "11 V", "stop": "10 V"}),
    "device_command_controller": [],  # claims no joint and has no topic: see tests/dynamixel/test_devices.py
    "diff_drive_controller": Entry(
        {"left": ["shoulder"], "right": ["elbow"], "separation": "160 mm", "radius": "33 mm"},
        "velocity",
        lambda _: {"linear": 0.1},
    ),
    "fall_reflex": [],  # has neither topics nor commands
    "feed_forward": Entry(OWN | {"command_interface": "position"}, below=True),
    "gravity_compensation": Entry(OWN, below=True),
    "gripper_controller": Entry(
        {"joint": "shoulder"}, "positions", lambda time_s: {"positions": [0.4 * time_s]}
    ),
    "ilc_controller": [],  # takes goals only, and publishes once a repetition
    "imu_sensor_broadcaster": Entry({"sensor": "torso"}),
    "joint_group_effort_controller": Entry(OWN, "efforts", lambda _: {"efforts": [0.1, 0.1]}),
    "joint_group_poseffort_controller": Entry(
        OWN, "poseffort", lambda time_s: {"positions": [0.4 * time_s, 0.2 * time_s], "efforts": [0.5, 0.5]}
    ),
    "joint_group_position_controller": Entry(OWN, "positions"),
    "joint_group_posvel_controller": Entry(
        OWN, "posvel", lambda time_s: {"positions": [0.4 * time_s, 0.2 * time_s], "velocities": [1.0, 1.0]}
    ),
    "joint_group_pwm_controller": Entry(OWN, "pwm", lambda _: {"pwm": [0.1, 0.1]}),
    "joint_group_velocity_controller": Entry(OWN, "velocities", SPEEDS),
    "joint_position_controller": PID,
    "joint_state_broadcaster": Entry({}),
    "joint_trajectory_controller": [
        Entry(OWN, "chunk", chunk),
        Entry(OWN | {"command_interface": "posvel"}, "chunk", chunk),
        Entry(OWN | GAINS | {"command_interface": "velocity"}, "chunk", chunk),
    ],
    "keyframe_player": [],  # takes goals only, and has no topic
    "leader_follower": Entry({"pairs": [{"joint": joint} for joint in JOINTS]}, "positions"),
    "pid_controller": [
        PID,
        Entry(OWN | SLOW | {"reference": "velocity", "command_interface": "velocity"}, "velocities", SPEEDS),
        Entry(OWN | GAINS | {"command_interface": "effort"}, "positions"),
        Entry(OWN | SLOW | {"command_interface": "position"}, below=True),
    ],
    "sample_player": [],  # its rows move nothing before their goal, and it has no topic
    "sensor_broadcaster": Entry({"message": "Range", "fields": {"range": "shoulder/position"}}),
    "thermal_governor": Entry(OWN | {"command_interface": "poseffort"}, below=True),
}
CASES = [
    pytest.param(kind, entry, id=f"{kind}-{number}")
    for kind, entries in ENTRIES.items()
    for number, entry in enumerate(entries if isinstance(entries, list) else [entries])
]


def controller_of(kind: str) -> type[Controller[Any]]:
    found: type[Controller[Any]] = resolve_name(dxlrun_controllers()[kind])
    return found


def robot_text(kind: str, entry: Entry) -> str:
    """Return the robot of an entry; its controller is `own`."""
    controllers: dict[str, Any] = {"own": {"type": kind, **entry.keys}}
    if not entry.kind:
        into = {"into": "own"} if entry.below else {}
        controllers["mover"] = {"type": "joint_group_position_controller", **OWN, **into}
    joint = {"bus": "main", "model": "XM430-W350", "reference": "180 deg", "direction": 1}
    joint |= {"motor": str(ROBOTS / "motors" / "XM430-W350.motor.yaml")}
    joint |= {"limits": {"position": ["-110 deg", "110 deg"], "velocity": "3 rad/s", "effort": "1 A"}}
    noisy = {"noise_density": 1e-3}
    imu = {"type": "simulated_imu", "rate": 50, "link": "base_link"}
    bus = {"port": "sim", "protocol": 2.0, "baud_rate": 1_000_000, "return_delay_time": "0 us"}
    robot = {
        "name": "streamed",
        "buses": {"main": bus},
        "loop": {"rate": RATE},
        "joints": {name: joint | {"id": number} for number, name in enumerate(JOINTS, 1)},
        "sensors": {"torso": imu | {"gyroscope": noisy, "accelerometer": noisy}},
        "controllers": controllers,
        "model": {"urdf": str(ROBOTS / "urdf" / "held_arm.urdf")},
    }
    return json.dumps(robot)


def run(folder: Path, kind: str, entry: Entry, *, lease_s: float = LEASE_S) -> VirtualRun:
    """Return the run of a stream that ends, before it begins."""
    sampled = VirtualRun.of_text(folder, robot_text(kind, entry), END * PERIOD_S)
    sampled.sample(sampled.servos.values(), PERIOD_S * 1000)
    to, command = "own" if entry.kind else "mover", entry.kind or "positions"
    for cycle in range(FIRST, LAST + 1, 2):
        fields = entry.fields((cycle - FIRST) * PERIOD_S)
        sampled.command(cycle * PERIOD_S * 1000, to, command, fields, lease_s)
    return sampled


def shafts(sampled: VirtualRun) -> Floats:
    """Run; return the angles of the shafts, rad, a row each period of the loop."""
    result = sampled.run()
    assert (result.reason, result.detail) == ("ended", ""), result
    began_ms = open_log(sampled.path).columns("/cycle", "scheduled_ns")["scheduled_ns"][0] / 1e6
    return np.array([sampled.shaft(sampled.servos[joint], began_ms) for joint in JOINTS]).T


def assert_topics_continue(log: LogReader, kind: str, entry: Entry, gap_s: float = 0.0) -> None:
    found = controller_of(kind)
    topics = [f"/own/{topic}" for topic in found.topics(found.Parameters.model_validate(entry.keys))]
    for topic in (*topics, *found.publishes):
        times = log.columns(topic)["t_ns"] * 1e-9
        interval = np.median(np.diff(times))
        assert np.diff(times).max() < max(1.5 * interval, gap_s), topic
        assert END * PERIOD_S - (times[-1] - times[0]) < 1.5 * interval, topic


def test_every_standard_controller_has_an_entry():
    assert sorted(ENTRIES) == sorted(dxlrun_controllers())
    for kind, entries in ENTRIES.items():
        found = controller_of(kind)
        streamed = set(found.Commands) - found.Goals
        if not entries:
            assert not found.publishes
            assert not found.Topics or kind == "ilc_controller"
            assert not streamed or kind in ("device_command_controller", "ilc_controller", "sample_player")


@pytest.mark.parametrize(("kind", "entry"), CASES)
def test_topics_outlive_a_stream_and_its_joints_are_held(tmp_path, kind, entry):
    sampled = run(tmp_path, kind, entry)
    positions, log = shafts(sampled), open_log(sampled.path)
    assert_topics_continue(log, kind, entry)
    before, ended = positions[FIRST], positions[LEASE_OVER]
    assert abs(ended - before).max() > 0.05, "the stream moved nothing"
    assert abs(positions[LEASE_OVER:] - ended).max() < 0.1
    assert np.ptp(positions[STILL:], axis=0).max() <= 2 * TICK
    if kind == "diff_drive_controller":
        speed = log.columns("/own/odometry", "twist.twist.linear.x")["twist.twist.linear.x"]
        assert speed.max() > 0.09
        assert abs(speed[-1]) < 1e-3


@pytest.mark.parametrize(("kind", "entry"), CASES)
def test_topics_outlive_a_lost_joint_and_the_other_one_is_held(tmp_path, kind, entry):
    """Efforts and PWM continue, as without them what they hold would fall."""
    sampled = run(tmp_path, kind, entry, lease_s=0.0)
    sampled.silence([2], *(1000 * at for at in LOST_S))
    shoulder = shafts(sampled)[:, 0]
    assert_topics_continue(open_log(sampled.path), kind, entry, gap_s=0.1)  # until a servo counts as lost
    lost, back = (round(at / PERIOD_S) for at in LOST_S)
    assert np.ptp(shoulder[:lost]) > 0.05, "the stream moved nothing"
    if "elbow" in str(entry.keys) and kind not in FORCES:
        assert np.ptp(shoulder[lost + NOTICED : back]) <= 2 * TICK
