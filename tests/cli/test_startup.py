"""Start-up: which modules a command imports; how long that takes is measured by bench/startup.py."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
LOADED = """
import contextlib, io, json, sys
from dxlrun.cli import main
with contextlib.redirect_stdout(io.StringIO()):
    assert main(sys.argv[1:]) == 0
print(json.dumps(sorted(sys.modules)))
"""
DATACLASSES = """
import contextlib, dataclasses, io, json, sys
made = []
process = dataclasses._process_class
dataclasses._process_class = lambda cls, *rest: made.append(cls) or process(cls, *rest)
from dxlrun.cli import main
with contextlib.redirect_stdout(io.StringIO()):
    assert main(sys.argv[1:]) == 0
print(json.dumps([cls.__name__ for cls in made if cls.__module__.startswith("dxl")]))
"""
VALIDATORS = """
import json
import dxlrun.features.devices.form, dxlrun.features.mechanics.form, dxlrun.features.recording.form
import dxlrun.description.robot
from dxlrun.description.base_form import Form
def forms(form):
    return [form, *(each for below in form.__subclasses__() for each in forms(below))]
print(json.dumps([len(forms(Form)), [each.__name__ for each in forms(Form) if each.__pydantic_complete__]]))
"""
RUN_TIME = {
    "dxlrun.control": ("gate", "loop", "realtime_grants", "safe_motion", "steering"),
    "dxlrun.dynamixel": ("dynamixel_hardware", "servo/life", "servo/servo_supervision", "tools"),
    "dxlrun.log": ("identity", "recorder", "log_writer", "log_reader"),
    "dxlsim": ("bus", "serving"),
    "dxlwire": ("exchange", "port"),
}
"""Rooms of which `check` needs the plans, and the parts that it does not."""


def loaded(*words: str) -> set[str]:
    """Return the modules that a process has imported after a command."""
    return {str(name) for name in printed(LOADED, *words)}


def printed(code: str, *words: str) -> list[object]:
    """Return the list that a process prints as JSON."""
    done = subprocess.run(
        [sys.executable, "-c", code, *words], cwd=ROOT, capture_output=True, text=True, check=True
    )
    found: list[object] = json.loads(done.stdout)
    return found


def beneath(modules: set[str], *packages: str) -> set[str]:
    """Return the modules that are one of these packages, or in one."""
    return {name for name in modules if any(f"{name}.".startswith(f"{each}.") for each in packages)}


@pytest.fixture(scope="module")
def checked() -> set[str]:
    return loaded("check", "robots/bioloid_torso.yaml")


def test_check_imports_no_part_that_runs(checked: set[str]) -> None:
    run_time = (f"{room}.{part.replace('/', '.')}" for room, parts in RUN_TIME.items() for part in parts)
    assert beneath(checked, *run_time, "dxlrun.remote", "dxlrun.run") == set()
    packages = beneath(checked, "dxlrun_analysis", "dxlrun_lab", "dxlrun_mujoco")
    assert packages <= {f"dxlrun_{one}{part}" for one in ("analysis", "lab") for part in ("", ".plugin")}


def test_check_imports_no_library_that_it_does_not_use(checked: set[str]) -> None:
    unused = "mujoco mcap starlette uvicorn lz4 zstandard serial matplotlib simpleeval rich subprocess"
    assert beneath(checked, *unused.split()) == set()


def test_check_generates_no_methods_of_records() -> None:
    """A dataclass takes 50 times as long to import as a struct."""
    # The first two have fields without arguments, and `RobotInfo` inherits from the third and another one.
    # The help of a command uses the others, and imports no msgspec.
    allowed = "States Commands JointValues Mark Problem Cell Column Table Sentence"
    assert set(printed(DATACLASSES, "check", "robots/bioloid_torso.yaml")) == {*allowed.split()}


def test_forms_build_no_validators_on_import() -> None:
    """The form of the robot file builds one validator for all sections."""
    forms, built = printed(VALIDATORS)
    assert isinstance(forms, int)
    assert forms > 30
    assert built == []


def test_check_imports_what_it_uses(checked: set[str]) -> None:
    """The other side: the names above are those of modules that exist."""
    assert checked >= {"dxlrun.compile.robot_compiler", "dxlrun.description.robot", "pydantic", "yaml"}
    for room, parts in RUN_TIME.items():
        folder = ROOT / "runtime" / room.replace(".", "/")
        assert {part for part in parts if not any(folder.glob(f"{part}*"))} == set()


def test_a_virtual_run_imports_neither_gateway_nor_physics() -> None:
    ran = loaded("robots/bioloid_torso.yaml", "--virtual", "--duration", "0.1", "--no-record")
    assert "dxlsim.serving.simulation_server" not in ran
    assert beneath(ran, "mujoco", "starlette", "uvicorn", "matplotlib", "rich", "dxlrun.remote") == set()
    assert "dxlrun.run.virtual_run" in ran


LOOP = """
import json, sys
import dxlrun.run.loop_process
from dxlrun.control.monitors.monitor_stage import MonitorStage
from dxlrun.features import FEATURES, stages
assert list(stages(MonitorStage, FEATURES))
print(json.dumps(sorted(sys.modules)))
"""


def test_monitors_bring_no_compiler_into_the_process_of_the_loop() -> None:
    """A policy of one module has its monitor next to what `check` needs of it."""
    imported = {str(name) for name in printed(LOOP)}
    assert beneath(imported, "dxlrun.compile") == {"dxlrun.compile", "dxlrun.compile.contribution"}
    assert beneath(imported, "yaml", "rich", "cyclopts", "dxlrun.cli", "dxlrun.remote.gateway") == set()
