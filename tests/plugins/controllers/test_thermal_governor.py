"""thermal_governor: its law, and settings that do not fit; `scripts/governor.txt` has what it commands."""

import numpy as np
import pytest
from tests.kit.robots import robot_text

from dxlrun.compile.robot_compiler import compile_files
from dxlrun.control.controllers.plugin_loading import load_plugins
from dxlrun.errors import InputError
from dxlrun.remote.preparation import Preparation, RefusedRequest
from dxlrun_analysis.replay.changes import Setting, with_settings
from dxlrun_controllers.thermal_governor import torque_scale


def test_torque_is_taken_in_proportion():
    temperature = np.array([20.0, 65.0, 70.0, 75.0, 99.0, np.nan])
    scale = torque_scale(temperature, np.full(6, 65.0), np.full(6, 75.0))
    assert scale.tolist() == [1.0, 1.0, 0.5, 0.0, 0.0, 1.0]


def test_a_controller_that_is_loaded_or_replayed_is_compared_with_the_robot_too(tmp_path):
    path = tmp_path / "robot.yaml"
    path.write_text(robot_text("governor"))
    loop, plugins = compile_files(path, {}, []).plan.loop, load_plugins()
    preparation = Preparation({joint.name: joint for joint in loop.joints}, plugins, urdf=loop.urdf)
    entry = {"name": "more", "type": "thermal_governor", "joints": ["j"], "reach": "12 deg"}
    assert preparation.controller(entry, {}, 50.0).joints == ("j",)
    with pytest.raises(RefusedRequest, match=r"more has 90 deg C as limit of j.*; write limit: 75 or less"):
        preparation.controller(entry | {"limit": 90}, {}, 50.0)
    with_settings(loop, [Setting("hot", ("limit",), 70)], plugins)
    with pytest.raises(InputError, match="--set hot: hot has 90 deg C as limit of j"):
        with_settings(loop, [Setting("hot", ("limit",), 90)], plugins)
