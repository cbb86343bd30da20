"""Keys and commands of every standard controller: what they claim, and what is refused, in which words."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pkgutil import resolve_name
from typing import Any

import pytest

from dxlrun import Controller, Interfaces
from dxlrun_controllers.plugin import dxlrun_controllers

Keys = dict[str, Any]
TWO: Keys = {"joints": ["a", "b"]}
GAINS: Keys = {"gains": {"p": 2.0}}
PID, GRIPPER = TWO | GAINS, {"joint": "gripper"}
VELOCITY, POSVEL = {"reference": "velocity"}, {"command_interface": "posvel"}
OF_POSITION, OF_EFFORT = {"command_interface": "position"}, {"command_interface": "effort"}
WIDTHS = [{"angle": "-1.26 rad", "width": "78 mm"}, {"angle": "0.66 rad", "width": "20 mm"}]
WIDE = GRIPPER | {"effort": 0.4, "widths": WIDTHS}
LED: Keys = {"pairs": [{"joint": "f", "leader": "l"}]}
STREAM: Keys = {"pairs": [{"joint": "f"}, {"joint": "g"}]}
BASE: Keys = {"left": ["l"], "right": ["r"], "separation": "160 mm", "radius": "33 mm"}
FOUR = BASE | {"left": ["l1", "l2"], "right": ["r1", "r2"]}
STEP: Keys = {"time": "500 ms", "pose": {"a": "0.5 rad"}}
BATTERY: Keys = {"voltages": ["power/voltage"], "warn": "10.8 V", "stop": "10.2 V"}
FALL: Keys = {"imu": "imu", "activate": ["curl"]}
FOOT: Keys = {"message": "WrenchStamped", "cells": {"foot/front": ["40 mm", "20 mm"]}}


def player(**motions: object) -> Keys:
    return TWO | {"motions": motions}


def page(*steps: Keys, **more: object) -> Keys:
    return {"steps": list(steps or (STEP,)), **more}


WAVE, TORQUE = player(wave=page()), player(wave=page(STEP | {"torque": {"a": 0.3}}))


IMU = ("angular_velocity", "linear_acceleration")


def axes(owner: str, *groups: str) -> str:
    return " ".join(f"{owner}{group}.{axis}" for group in groups for axis in "xyz")


def type_of(name: str) -> type[Controller[Any]]:
    found: type[Controller[Any]] = resolve_name(dxlrun_controllers()[name])
    return found


def claims(name: str, keys: Keys) -> Interfaces:
    kind = type_of(name)
    return kind.interfaces(kind.Parameters.model_validate(keys), ("a", "b", "c"))


@pytest.mark.parametrize(
    ("name", "keys", "joints", "command", "reference"),
    [
        ("joint_state_broadcaster", {}, "a b c", "", ""),
        ("joint_group_position_controller", TWO, "a b", "position", ""),
        ("joint_group_posvel_controller", TWO, "a b", "position velocity", ""),
        ("joint_group_poseffort_controller", TWO, "a b", "position effort", ""),
        ("joint_group_velocity_controller", TWO, "a b", "velocity", ""),
        ("joint_group_effort_controller", TWO, "a b", "effort", ""),
        ("joint_group_pwm_controller", TWO, "a b", "pwm", ""),
        ("joint_trajectory_controller", TWO, "a b", "position", ""),
        ("joint_trajectory_controller", TWO | POSVEL, "a b", "position velocity", ""),
        ("joint_trajectory_controller", PID | {"command_interface": "velocity"}, "a b", "velocity", ""),
        ("joint_trajectory_controller", PID | OF_EFFORT, "a b", "effort", ""),
        ("pid_controller", PID, "a b", "effort", "position velocity effort"),
        ("pid_controller", PID | {"command_interface": "velocity"}, "a b", "velocity", "position velocity"),
        ("pid_controller", PID | OF_POSITION, "a b", "position", "position velocity"),
        ("pid_controller", PID | VELOCITY | {"command_interface": "pwm"}, "a b", "pwm", "velocity pwm"),
        ("pid_controller", PID | VELOCITY, "a b", "effort", "velocity effort"),
        ("gripper_controller", GRIPPER, "gripper", "position velocity", ""),
        ("gripper_controller", WIDE, "gripper", "position velocity effort", ""),
        ("diff_drive_controller", FOUR, "l1 l2 r1 r2", "velocity", ""),
        ("leader_follower", LED, "f", "position", ""),
        ("leader_follower", LED | POSVEL, "f", "position velocity", ""),
        ("keyframe_player", WAVE, "a b", "position", ""),
        ("keyframe_player", WAVE | POSVEL, "a b", "position velocity", ""),
        ("keyframe_player", TORQUE, "a b", "position effort", ""),
        ("keyframe_player", TORQUE | POSVEL, "a b", "position velocity effort", ""),
    ],
)
def test_what_it_claims_and_exports(name: str, keys: Keys, joints: str, command: str, reference: str) -> None:
    found = claims(name, keys)
    assert (" ".join(found.joints), " ".join(found.command)) == (joints, command)
    assert " ".join(found.reference) == reference


@pytest.mark.parametrize(
    ("name", "keys", "reads", "provides", "takeovers"),
    [
        (
            "leader_follower",
            {"pairs": [{"joint": "f", "leader": "l"}, {"joint": "g", "leader": "m"}]},
            "l/position m/position l/velocity m/velocity l/age m/age",
            "",
            (),
        ),
        ("leader_follower", STREAM, "", "", ()),
        (
            "imu_sensor_broadcaster",
            {"sensor": "chip", "magnetometer": "compass"},
            axes("chip/", *IMU) + " chip/age " + axes("compass/", "magnetic_field") + " compass/age",
            axes("", "orientation") + " orientation.w " + axes("", *IMU),
            (),
        ),
        (
            "fall_reflex",
            FALL,
            axes("imu/", "orientation") + " imu/orientation.w imu/age",
            "fallen",
            ("curl",),
        ),
    ],
)  # fmt: skip
def test_what_it_reads_and_provides(
    name: str, keys: Keys, reads: str, provides: str, takeovers: tuple[str, ...]
) -> None:
    found = claims(name, keys)
    assert (" ".join(found.reads), " ".join(found.provides)) == (reads, provides)
    assert found.takeovers == takeovers


WRONG_KEYS: Mapping[str, tuple[Keys, list[tuple[Keys, str]]]] = {
    "battery_state_broadcaster": (BATTERY, [
        ({"stop": "10.8 V"}, "stop is not below warn"),
        ({"voltages": []}, "at least 1 item"),
        ({"voltages": ["power"]}, "power is not a state; write OWNER/STATE, such as power/voltage"),
        ({"warn": 10.8}, "warn"),
    ]),
    "diff_drive_controller": (BASE, [
        ({"separation": "0 m"}, "separation"),
        ({"radius": "33 deg"}, "radius"),
        ({"left": []}, "left"),
        ({"linear": {"velocity": "-1 m/s"}}, "linear"),
        ({"odometry": "gps"}, "odometry"),
        ({"timeout": "0 s"}, "timeout"),
    ]),
    "fall_reflex": (FALL, [
        ({"roll": ["10 deg", "40 deg"]}, "the range of roll does not enclose 0"),
        ({"pitch": ["40 deg", "-40 deg"]}, "the range of pitch does not enclose 0"),
        ({"activate": []}, "at least 1 item"),
        ({"timeout": "0 s"}, "greater than 0"),
    ]),
    "feed_forward": (TWO, [
        ({"pass_on": True}, "pass_on does not fit command_interface position; remove pass_on"),
        ({"scale": 1.5}, "less than or equal to 1"),
        ({"scale": {"c": 1.0}}, "c is not one of its joints"),
        ({"most": 0.0}, "greater than 0"),
        ({"friction_speed": "0 rad/s"}, "greater than 0"),
        ({"command_interface": "velocity"}, "position"),
    ]),
    "gripper_controller": (WIDE, [
        ({"widths": WIDTHS[:1]}, "one width is not enough"),
        ({"widths": [*WIDTHS, {"angle": "1 rad", "width": "50 mm"}]}, "must all grow, or all shrink"),
        ({"widths": [WIDTHS[0], WIDTHS[0]]}, "write each angle once"),
        ({"effort": 0.0}, "greater than 0"),
    ]),
    "ilc_controller": (TWO, [
        (OF_EFFORT, "position"),
        ({"gain": 1.5}, "less than or equal to 1"),
        ({"cutoff": 0}, "greater than 0"),
        ({"most": "0 deg"}, "greater than 0"),
        ({"growth": 1.0}, "greater than 1"),
    ]),
    "imu_sensor_broadcaster": ({"sensor": "chip"}, [
        ({"orientation": "sensor", "magnetometer": "compass"}, "need orientation: madgwick"),
        ({"declination": "3 deg"}, "name a magnetometer"),
        ({"gain": -0.1}, "greater than or equal to 0"),
        ({"mounting": ["0 deg", "0 deg"]}, "at least 3 items"),
        ({"timeout": "0 s"}, "greater than 0"),
        ({"covariance": {"orientation": [1.0, 1.0]}}, "at least 3 items"),
        ({"covariance": {"orientation": [1.0, 1.0, -1.0]}}, "greater than or equal to 0"),
    ]),
    "joint_group_position_controller": (TWO, [
        ({"joints": []}, "at least 1 item"),
        ({"surplus": 1}, "Extra inputs are not permitted"),
    ]),
    "joint_trajectory_controller": (TWO, [
        (OF_EFFORT, "effort needs gains"),
        ({"gains": {"p": 1.0}}, "gains count only for velocity and effort"),
        ({"tolerances": {"path": {"c": "1 deg"}}}, "c is not one of its joints"),
        ({"deceleration": "0 rad/s^2"}, "greater than 0"),
        ({"speed": -0.1}, "greater than or equal to 0"),
    ]),
    "keyframe_player": (WAVE, [
        (player(), "at least 1 item"),
        (player(w={"steps": []}), "at least 1 item"),
        (player(w=page(STEP | {"pose": {"c": "1 rad"}})), "c is not one of its joints"),
        (player(w=page(STEP | {"torque": {"c": 1.0}})), "c is not one of its joints"),
        (player(w=page(next="x")), "motion x is not defined; the motions are w"),
        (player(w=page(next="x"), x=page(next="w")), "in a circle: w -> x -> w"),
        (player(w=page(STEP | {"time": "1 ms"})), "greater than or equal"),
        (player(w=page(STEP | {"interpolation": "bezier"})), "smooth"),
        ({"start": "flap"}, "motion flap is not defined"),
    ]),
    "leader_follower": (LED, [
        ({"pairs": []}, "at least 1 item"),
        ({"pairs": [{"joint": "f", "leader": "l"}, {"joint": "g"}]}, "g has no leader"),
        ({"pairs": [{"joint": "f", "scale": 2.0}]}, "scale and offset need a leader"),
        ({"pairs": [{"joint": "f", "leader": "l", "scale": 0.0}]}, "with a scale of 0"),
        ({"pairs": [{"joint": "f", "leader": "l"}, {"joint": "g", "leader": "f"}]}, "is leader and follower"),
        (STREAM | POSVEL, "posvel needs leaders"),
    ]),
    "pid_controller": (PID, [
        ({"gains": {"p": -1.0}}, "greater than or equal to 0"),
        ({"gains": {"p": {"c": 1.0}}}, "c is not one of its joints; they are a, b"),
        ({"output_limit": {"c": 1.0}}, "c is not one of its joints"),
        ({"wrap": ["c"]}, "c is not one of its joints"),
        (VELOCITY | {"wrap": ["a"]}, "velocities do not wrap"),
        (VELOCITY | OF_POSITION, "does not fit command_interface position"),
        ({"gains": {"p": "3 Nm"}}, "valid number"),
    ]),
    "sample_player": (TWO, [
        ({"bounds": {"range": {"a": ["0.2 rad", "0.1 rad"]}}}, r"from 0\.2 rad to 0\.1 rad is empty"),
        ({"bounds": {"range": {"c": ["0.1 rad", "0.2 rad"]}}}, "c is not one of its joints"),
    ]),
    "sensor_broadcaster": ({"message": "Range"}, [
        ({"fields": {"rang": "sonar/range"}}, "Range has no numeric field rang; use one of radiation_type"),
        ({"fields": {"range": 1.0}}, "no field or cell names a state"),
        ({"fields": {"range": "sonar"}}, "sonar is not a state"),
        ({"fields": {"radiation_type": "a/b"}}, "radiation_type of Range must be a whole number"),
        ({"fields": {"radiation_type": 0.5, "range": "a/b"}}, "must be a whole number"),
        ({"cells": {"a/b": ["1 mm", "1 mm"]}}, "cells are only for WrenchStamped, not Range"),
        ({**FOOT, "fields": {"wrench.force.z": "a/b"}}, "wrench.force.z is computed from the cells"),
        ({"message": "Imu", "fields": {}}, "Input should be"),
    ]),
    "thermal_governor": (TWO, [
        ({"hysteresis": -1}, "greater than or equal to 0"),
        ({"limit": {"c": 60}}, "c is not one of its joints"),
        ({"reach": "0 deg"}, "greater than 0"),
        ({"command_interface": "velocity"}, "position"),
    ]),
}  # fmt: skip


@pytest.mark.parametrize(
    ("name", "keys", "sentence"),
    [(name, {**own, **keys}, text) for name, (own, wrong) in WRONG_KEYS.items() for keys, text in wrong],
)
def test_wrong_keys_are_refused_in_words(name: str, keys: Keys, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        type_of(name).Parameters.model_validate(keys)


def points(*positions: float, time: float | str = 1.0) -> list[Keys]:
    return [{"time": time, "positions": positions}]


@pytest.mark.parametrize(
    ("name", "keys", "kind", "command", "sentence"),
    [
        (name, keys, kind, command, sentence)
        for name, keys, kind, cases in (
            ("joint_group_position_controller", TWO, "positions", [
                ({"positions": [1, 2, 3]}, r"3 positions for 2 joints \(a, b\)"),
                ({"positions": [0.0, math.nan]}, "finite"),
                ({"positions": [0.0, math.inf]}, "finite"),
            ]),
            ("joint_group_posvel_controller", TWO, "posvel", [
                ({"positions": [1, 2], "velocities": [3]}, "1 velocities for 2 joints"),
            ]),
            ("joint_group_velocity_controller", TWO, "velocities", [
                ({"velocities": [1]}, "1 velocities for 2 joints"),
            ]),
            ("joint_group_effort_controller", TWO, "efforts", [({"efforts": [1]}, "1 efforts for 2 joints")]),
            ("joint_group_pwm_controller", TWO, "pwm", [
                ({"pwm": [1]}, "1 pwm for 2 joints"),
                ({"pwm": [0.2, 20]}, "less than or equal to 1"),  # it was meant in percent
            ]),
            ("pid_controller", PID, "velocities", [
                ({"velocities": [1, 2]}, "its reference is the position; send positions"),
            ]),
            ("pid_controller", PID | VELOCITY, "positions", [
                ({"positions": [1, 2]}, "send velocities instead of positions"),
            ]),
            ("pid_controller", PID, "positions", [({"positions": [1]}, "1 positions for 2 joints")]),
            ("leader_follower", LED, "positions", [({"positions": [1]}, "the joints follow leaders")]),
            ("leader_follower", STREAM, "positions", [({"positions": [1]}, "1 positions for 2 joints")]),
            ("diff_drive_controller", BASE, "velocity", [
                ({"linear": math.nan}, "finite"),
                ({"linear": "20 deg"}, "validation error"),
                ({"sideways": 1.0}, "Extra inputs"),
            ]),
            ("joint_trajectory_controller", {"joints": ["a"]}, "trajectory", [
                ({"points": points(1, 2)}, r"2 positions in point 1 for 1 joints \(a\)"),
                ({"points": [points(1)[0] | {"velocities": []}]}, "0 velocities in point 1"),
                ({"points": points(1) * 2}, "the times of a trajectory must grow: point 2 is at 1 s"),
                ({"points": []}, "at least 1 item"),
                ({"points": points(1, time=-1)}, "greater than or equal to 0"),
                ({"points": points(1, time="1 deg")}, "validation error"),
                ({"points": points(1), "joints": ["c"]}, r"c is not one of its joints \(a\)"),
                ({"points": points(1, 1), "joints": ["a", "a"]}, "joints names a twice"),
            ]),
            ("keyframe_player", player(wave=page(), bow=page()), "play", [
                ({"motion": "wav"}, "there is no motion 'wav'; there are wave, bow"),
                ({"motion": "wave", "speed": 0.0}, "greater than 0"),
                ({"motion": "wave", "speed": 11}, "less than or equal to 10"),
                ({"motion": "wave", "repeat": 0}, "greater than or equal to 1"),
            ]),
            *(
                ("sample_player", TWO | {"bounds": {"range": {"b": ("-0.5 rad", "0.5 rad")}}}, kind, [
                    ({"rows": [], **more}, "the table has no rows; give at least one"),
                    ({"rows": [[0.1, 0.1], [0.1]], **more}, r"row 2 has 1 numbers; .* of 2 joints \(a, b\)"),
                    (
                        {"rows": [[0.1, 0.1], [0.1, 0.7]], **more},
                        "row 2 moves b to 0.7 rad, outside its range of -0.5 to 0.5 rad",
                    ),
                ])
                for kind, more in (("rows", {}), ("samples", {"period": 0.02}))
            ),
            ("gripper_controller", WIDE, "grip", [
                ({"width": 0.09}, "width 0.09 m is not between 0.02 m and 0.078 m"),
                ({}, "give either position or width"),
                ({"position": 0.1, "width": 0.03}, "give either position or width"),
                ({"position": math.nan}, "finite"),
                ({"position": 0.1, "effort": -0.1}, "greater than 0"),
                ({"position": "30 kg"}, "unit kg"),
                ({"position": "30 mm"}, "the position must be an angle"),
            ]),
            ("gripper_controller", GRIPPER, "grip", [
                ({"width": 0.03}, "the gripper has no widths"),
                ({"position": 0.3, "effort": 0.1}, "no effort limit"),
            ]),
            ("gripper_controller", GRIPPER | {"speed": "5 mm/s"}, "grip", [
                ({"position": "30 deg"}, "must be a length, such as 10 mm"),
            ]),
        )
        for command, sentence in cases
    ],
)  # fmt: skip
def test_a_command_that_does_not_fit_is_refused_in_words(
    name: str, keys: Keys, kind: str, command: Keys, sentence: str
) -> None:
    controller = type_of(name)
    with pytest.raises(ValueError, match=sentence):
        controller.prepare(
            kind,
            controller.Commands[kind].model_validate(command),
            controller.Parameters.model_validate(keys),
        )


def test_a_command_of_another_controller_is_refused() -> None:
    group, other = type_of("joint_group_position_controller"), type_of("joint_group_posvel_controller")
    command = other.Commands["posvel"].model_validate({"positions": [1], "velocities": [1]})
    with pytest.raises(ValueError, match="has no command 'posvel'"):
        group.prepare("posvel", command, group.Parameters.model_validate(TWO))
