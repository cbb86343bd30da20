"""thermal_governor: what is taken from hot servos, events, and mistakes in the file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace
from tests.kit.stages import Stage

from dxlrun import MotorModel, ServoModel
from dxlrun.compile.robot_compiler import compile_files
from dxlrun.control.controllers.plugin_loading import load_plugins
from dxlrun.errors import InputError
from dxlrun.remote.preparation import Preparation, RefusedRequest
from dxlrun_analysis.replay.changes import Setting, with_settings
from dxlrun_controllers.thermal_governor import (
    SMOOTHING_S,
    ThermalGovernor,
    torque_scale,
)

XM430 = ServoModel("XM430-W350", "ID 1 on bus main", "A", 4.1, 2.3, 12.0, 4.8, 80.0)
MOTOR = MotorModel("XM430-W350", 12.0, 1.6, 4.0, 0.01, position_gain=0.005, p_gain=800)


def test_torque_is_taken_in_proportion() -> None:
    temperature = np.array([20.0, 65.0, 70.0, 75.0, 99.0, np.nan])
    scale = torque_scale(temperature, np.full(6, 65.0), np.full(6, 75.0))
    assert scale.tolist() == [1.0, 1.0, 0.5, 0.0, 0.0, 1.0]


def test_the_scale_follows_the_measured_temperature_smoothly() -> None:
    robot = started({})
    robot.update(0.0, follow=False)
    assert robot.context.provided.tolist() == [1.0, 0.5]
    measured = robot.states.temperature
    measured[:] = (np.nan, 71.0)
    for cycle in range(1, 1 + round(SMOOTHING_S / 0.02)):
        robot.update(cycle * 0.02, follow=False)
    assert robot.context.provided == pytest.approx([1.0, 0.5 - 0.1 * (1 - 1 / np.e)], abs=1e-3)
    kept = robot.context.provided.copy()
    measured[:] = np.nan  # not heard any more
    robot.update(9.0, follow=False)
    assert robot.context.provided.tolist() == kept.tolist()


def started(more: dict[str, object], **keys: Any) -> Any:
    keys = {"motors": (None, None), "servos": (XM430, replace(XM430, label="ID 2 on bus main"))} | keys
    robot = Stage(ThermalGovernor, {"joints": ["a", "b"], "reach": "0.2 rad"} | more, **keys)
    robot.states.temperature[:] = (30.0, 70.0)  # the second is between warn, 65, and limit, 75
    robot.activate()
    return robot


def test_goals_of_hot_servos_are_held_back_to_where_they_are() -> None:
    robot = started({})
    goals = robot.update(0.0, follow=False)
    assert goals.tolist() == [0.3, -0.2]  # nothing is commanded: they hold
    robot.context.references.position[:] = (1.3, 1.0)
    cold, hot = robot.update(0.02, follow=False)
    scale = robot.context.provided[1]
    assert (cold, hot) == (1.3, pytest.approx(-0.2 + 0.2 * scale))
    assert scale == 0.5
    robot.context.references.position[1] = -0.25  # less than it may give: as it was commanded
    assert robot.update(0.04, follow=False)[1] == -0.25
    robot.context.references.position[1] = -1.0
    assert robot.update(0.06, follow=False)[1] == pytest.approx(-0.2 - 0.2 * scale)
    robot.states.valid[1] = False  # a lost packet: it is where it was
    assert robot.update(0.08, follow=False)[1] == pytest.approx(-0.2 - 0.2 * scale, abs=1e-3)
    robot.states.position[1] = np.nan  # where it is is not known
    assert robot.update(0.1, follow=False)[1] == -1.0
    by_motor = started({"reach": None}, motors=(MOTOR, MOTOR))
    by_motor.context.references.position[:] = 1.3
    assert by_motor.update(0.0, follow=False)[1] == pytest.approx(-0.2 + 0.5 / (0.005 * 800), abs=1e-3)
    limited = started({}, limits={"upper": -0.15})
    limited.context.references.position[1] = -0.1
    assert limited.update(0.0, follow=False)[1] == -0.15


def test_efforts_and_pwm_are_limited() -> None:
    robot = started({"command_interface": "poseffort", "most": {"a": 1.0}}, limits={"effort": 2.0})
    robot.context.references.position[:] = 1.0
    robot.update(0.0, follow=False)
    commands = robot.commands
    assert commands.position.tolist() == [1.0, 1.0]
    assert commands.effort == pytest.approx([1.0, 2.0 * 0.5], abs=0.02)
    robot.context.references.effort[:] = (0.4, 1.9)
    robot.update(0.02, follow=False)
    assert commands.effort == pytest.approx([0.4, 2.0 * 0.5], abs=0.02)
    robot = started({"command_interface": "effort"})
    robot.context.references.effort[:] = (-9.0, -9.0)
    robot.update(0.0, follow=False)
    assert robot.commands.effort == pytest.approx([-2.3, -2.3 * 0.5], abs=0.02)
    robot.context.references.effort[:] = np.nan
    robot.update(0.02, follow=False)
    assert robot.commands.effort.tolist() == [0.0, 0.0]
    robot = started({"command_interface": "pwm"})
    robot.context.references.pwm[:] = (0.3, 0.9)
    robot.update(0.0, follow=False)
    assert robot.commands.pwm == pytest.approx([0.3, 0.5], abs=0.01)


def test_events_say_once_that_a_servo_is_hot_spent_and_cool() -> None:
    robot = started({"hysteresis": 2})
    at_s = 0.0
    for celsius in (64, 66, 64, 66, 74, 76, 74, 72, 70, 62, 64, 66):
        robot.states.temperature[:] = (20.0, celsius)
        for _ in range(round(9 * SMOOTHING_S / 0.02)):
            robot.update(at_s, follow=False)
            at_s += 0.02
    named = "b (ID 2 on bus main) "
    assert robot.warned == [
        f"{named}is at 69.9 deg C (threshold 65): it gets less torque",
        f"{named}is at 75.0 deg C (threshold 75): it gets no torque",
        f"{named}is at 65.0 deg C (threshold 65): it gets less torque",
    ]
    assert [text.partition("has cooled")[0] for text in robot.said] == [named] * 2
    assert ["below 75" in text for text in robot.said] == [True, False]


ROBOT = """\
name: hot
buses: {main: {port: sim, protocol: 2.0, baud_rate: 1_000_000}}
loop: {rate: 50}
joints:
  j: {bus: main, id: 1, model: XM430-W350, reference: 180 deg, direction: 1}
controllers:
  hot: {type: thermal_governor, joints: [j], reach: 12 deg}
"""
PARTS = "reach: 12 deg"


@pytest.mark.parametrize(
    "change",
    [
        ("", ""),
        (PARTS, "command_interface: poseffort"),
        ("XM430-W350", "XL430-W250"),  # its effort is its output
        (PARTS, "reach: 12 deg, limit: 79, warn: {j: 60}"),
    ],
)
def test_what_fits_is_accepted(tmp_path: Path, change: tuple[str, str]) -> None:
    path = tmp_path / "robot.yaml"
    path.write_text(ROBOT.replace(*change))
    assert compile_files(path, {}, []).plan.loop.controllers[0].provides == ("j.scale",)


@pytest.mark.parametrize(
    ("change", "at", "what"),
    [
        ((f", {PARTS}", ""), "j]", "needs the position error of j at full torque; write reach"),
        ((PARTS, f"{PARTS}, limit: 80"), "80", "has 80 deg C as limit of j, but the XM430-W350 cuts"),
        (("direction: 1", "direction: 1, registers: {temperature_limit: 60}"), "", ""),
        ((PARTS, f"{PARTS}, limit: {{j: 95}}"), "{j: 95}", "beyond 80; write limit: 75 or less"),
        ((PARTS, f"{PARTS}, warn: 75"), "75", "warn of j at 75 deg C, not below its limit of 75"),
        ((PARTS, f"{PARTS}, limit: 60"), "60", "warn of j at 65 deg C, not below its limit of 60"),
        (("id: 1,", "servos: [{id: 1}, {id: 2}],"), "j]", "cannot limit the temperature of j: it has"),
    ],
)
def test_what_does_not_fit_is_one_sentence_at_its_place(
    tmp_path: Path, change: tuple[str, str], at: str, what: str
) -> None:
    path = tmp_path / "robot.yaml"
    path.write_text(ROBOT.replace(*change))
    if not what:  # thresholds go with the servo's own limit
        path.write_text(path.read_text().replace(PARTS, f"{PARTS}, limit: 70"))
        at, what = "70", "has 70 deg C as limit of j, but the XM430-W350 cuts torque beyond 60"
    with pytest.raises(InputError) as caught:
        compile_files(path, {}, [])
    (found,) = [text for text in str(caught.value).splitlines() if what in text]
    row, column = map(int, found.removeprefix(f"{path}:").split(":")[:2])
    assert path.read_text().splitlines()[row - 1][column - 1 :].startswith(at)


def test_a_controller_that_is_loaded_or_replayed_otherwise_is_compared_with_the_robot_too(
    tmp_path: Path,
) -> None:
    path = tmp_path / "robot.yaml"
    path.write_text(ROBOT)
    loop, plugins = compile_files(path, {}, []).plan.loop, load_plugins()
    preparation = Preparation({joint.name: joint for joint in loop.joints}, plugins, urdf=loop.urdf)
    entry = {"name": "more", "type": "thermal_governor", "joints": ["j"], "reach": "12 deg"}
    assert preparation.controller(entry, {}, 50.0).joints == ("j",)
    with pytest.raises(RefusedRequest, match=r"more has 90 deg C as limit of j.*; write limit: 75 or less"):
        preparation.controller(entry | {"limit": 90}, {}, 50.0)
    with_settings(loop, [Setting("hot", ("limit",), 70)], plugins)
    with pytest.raises(InputError, match="--set hot: hot has 90 deg C as limit of j"):
        with_settings(loop, [Setting("hot", ("limit",), 90)], plugins)
