"""thermal_governor: mistakes in the file; what it takes from hot servos is in `scripts/governor.txt`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dxlrun.compile.robot_compiler import compile_files
from dxlrun.control.controllers.plugin_loading import load_plugins
from dxlrun.errors import InputError
from dxlrun.remote.preparation import Preparation, RefusedRequest
from dxlrun_analysis.replay.changes import Setting, with_settings
from dxlrun_controllers.thermal_governor import torque_scale

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


def test_torque_is_taken_in_proportion() -> None:
    temperature = np.array([20.0, 65.0, 70.0, 75.0, 99.0, np.nan])
    scale = torque_scale(temperature, np.full(6, 65.0), np.full(6, 75.0))
    assert scale.tolist() == [1.0, 1.0, 0.5, 0.0, 0.0, 1.0]


@pytest.mark.parametrize(
    ("old", "new", "at", "what"),
    [
        ("", "", "", ""),
        (PARTS, "command_interface: poseffort", "", ""),
        ("XM430-W350", "XL430-W250", "", ""),  # its effort is its output
        (PARTS, "reach: 12 deg, limit: 79, warn: {j: 60}", "", ""),
        (f", {PARTS}", "", "j]", "needs the position error of j at full torque; write reach"),
        (PARTS, f"{PARTS}, limit: 80", "80", "has 80 deg C as limit of j, but the XM430-W350 cuts"),
        (PARTS, f"{PARTS}, limit: {{j: 95}}", "{j: 95}", "beyond 80; write limit: 75 or less"),
        (PARTS, f"{PARTS}, warn: 75", "75", "warn of j at 75 deg C, not below its limit of 75"),
        (PARTS, f"{PARTS}, limit: 60", "60", "warn of j at 65 deg C, not below its limit of 60"),
        ("id: 1,", "servos: [{id: 1}, {id: 2}],", "j]", "cannot limit the temperature of j: it has"),
        # the servo's own limit counts
        (
            "direction: 1}\ncontrollers:\n  hot: {type: thermal_governor, joints: [j]",
            "direction: 1, registers: {temperature_limit: 60}}\ncontrollers:\n"
            "  hot: {type: thermal_governor, joints: [j], limit: 70",
            "70",
            "has 70 deg C as limit of j, but the XM430-W350 cuts torque beyond 60",
        ),
    ],
)
def test_what_does_not_fit_is_one_sentence_at_its_place(
    tmp_path: Path, old: str, new: str, at: str, what: str
) -> None:
    path = tmp_path / "robot.yaml"
    assert old in ROBOT
    path.write_text(ROBOT.replace(old, new))
    if not what:
        assert compile_files(path, {}, []).plan.loop.controllers[0].provides == ("j.scale",)
        return
    with pytest.raises(InputError) as caught:
        compile_files(path, {}, [])
    (found,) = [text for text in str(caught.value).splitlines() if what in text]
    row, column = map(int, found.removeprefix(f"{path}:").split(":")[:2])
    assert path.read_text().splitlines()[row - 1][column - 1 :].startswith(at)


def test_a_controller_that_is_loaded_or_replayed_is_compared_with_the_robot_too(tmp_path: Path) -> None:
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
