"""A plug-in that is missing or wrong: one sentence each, with its place in the robot file."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from tests.kit.answers import read_answer

from dxlrun.cli import main

EXAMPLE = Path(__file__).parents[2] / "plugins" / "example"
TYPE_MARK = "example.yaml:12:16: "
NAME_MARK = "example.yaml:12:3: "
WHO = "plug-in easing of dxlrun-easing 0.1.0"
NOT_OFFERED = "no plug-in offers the controller type easing_position_controller of head; "
CONTROLLER = (Path(__file__).parent / "plain/controller.py").read_text()
PLUGIN = (EXAMPLE / "src/dxlrun_easing/plugin.py").read_text()

Told = Callable[..., list[str]]


@pytest.fixture
def told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Iterator[Told]:
    """Install the example with some text replaced, check its robot file, return the lines of the errors."""
    monkeypatch.chdir(tmp_path)

    def told(old: str = "", new: str = "", *, install: bool = True) -> list[str]:
        assert not old or (old in CONTROLLER) != (old in PLUGIN)
        package = tmp_path / "dxlrun_easing"
        package.mkdir()
        (package / "__init__.py").touch()
        (package / "easing.py").write_text(CONTROLLER.replace(old, new) if old in CONTROLLER else CONTROLLER)
        (package / "plugin.py").write_text(PLUGIN.replace(old, new) if old in PLUGIN else PLUGIN)
        if install:
            info = tmp_path / "dxlrun_easing-0.1.0.dist-info"
            info.mkdir()
            (info / "METADATA").write_text("Metadata-Version: 2.1\nName: dxlrun-easing\nVersion: 0.1.0\n")
            (info / "entry_points.txt").write_text("[dxlrun]\neasing = dxlrun_easing.plugin\n")
        (tmp_path / "example.yaml").write_text((EXAMPLE / "example.yaml").read_text())
        monkeypatch.syspath_prepend(tmp_path)
        code = main(["check", "example.yaml"])
        out, err = capsys.readouterr()
        assert (out, code) == ("", 2 if err else 0)
        return list(err.splitlines())

    yield told
    for name in [name for name in sys.modules if name.startswith("dxlrun_easing")]:
        del sys.modules[name]


def test_a_plugin_that_is_not_installed(told: Told) -> None:
    (line,) = told(install=False)
    assert line.startswith(TYPE_MARK + NOT_OFFERED)
    assert line.endswith("?") or "install its package in this environment" in line


WRONG = {
    "import math": (
        "import no_such_thing",
        f"{WHO} cannot be imported (ModuleNotFoundError: No module named 'no_such_thing'); "
        "reinstall it, or report it to its author",
    ),
    "return 4": (
        "return 7",
        f"{WHO} was written for contract 7, but this dxlrun has contract 4; install a matching version",
    ),
    "def dxlrun_controllers()": (
        "def dxlrun_controllers(robot)",
        f"{WHO} has an invalid hook (PluginValidationError: Plugin 'easing' for hook 'dxlrun_controllers' "
        "hookimpl definition: dxlrun_controllers(robot) -> 'Mapping[str, type[Controller[Any]]]' "
        "Argument(s) {'robot'} are declared in the hookimpl but can not be found in the hookspec); "
        "report it to its author",
    ),
    "@hookimpl\ndef dxlrun_controllers": (
        "def dxlrun_controllers",
        f"{WHO} has an unmarked hook dxlrun_controllers; put @dxlrun.hookimpl above this function",
    ),
    "def update(self, time_ns: int, period_ns: int)": (
        "def update(self, period_ns: int)",
        f"{WHO} offers Easing as easing_position_controller: its update(period_ns) cannot be called as "
        "update(time_ns, period_ns); declare these arguments",
    ),
    "    def update(": (
        "    def renew(",
        f"{WHO} offers Easing as easing_position_controller: it has no method update; add the method",
    ),
    "class EasingParameters(ParametersModel)": (
        "class EasingParameters",
        f"{WHO} offers Easing as easing_position_controller: its Parameters is not a parameters model; "
        "derive it from dxlrun.ParametersModel",
    ),
    '{"positions": PositionsCommand}': (
        "(PositionsCommand,)",
        f"{WHO} offers Easing as easing_position_controller: its Commands has the wrong type: Expected "
        "`object`, got `array`; write {name: class of dxlrun.CommandModel}",
    ),
}


@pytest.mark.parametrize("old", WRONG, ids=range(len(WRONG)))
def test_a_plugin_that_is_wrong(told: Told, old: str) -> None:
    new, sentence = WRONG[old]
    (line,) = told(old, new)
    head, _, tail = line.partition(WHO)
    assert head.startswith(TYPE_MARK + NOT_OFFERED)
    assert WHO + tail == sentence


ASKED = {
    'Interfaces(parameters.joints, ("position",))': (
        "None",
        "returns None from interfaces; report this to the plug-in's author: return "
        "dxlrun.Interfaces(joints, command)",
    ),
    'parameters.joints, ("position",)': (
        'list(parameters.joints), ("position",)',
        "returns lists in its interfaces; "
        "report this to the plug-in's author: write tuples of names, as in dxlrun.Interfaces",
    ),
    ', ("position",))': (
        ', ("position", "pwm"))',
        "requests incompatible command interfaces: no servo mode combines position and pwm; "
        "report this to the plug-in's author: request position (alone, or with velocity or effort), or "
        "velocity, effort or pwm alone",
    ),
    '("position",))': (
        '("torque",))',
        "returns wrong interfaces: Invalid enum value 'torque' - at `$.command[0]`; "
        "report this to the plug-in's author: write tuples of names, as in dxlrun.Interfaces",
    ),
}


@pytest.mark.parametrize("old", ASKED, ids=range(len(ASKED)))
def test_a_controller_that_asks_for_nonsense(told: Told, old: str) -> None:
    new, says = ASKED[old]
    assert told(old, new) == [f"{NAME_MARK}controller head (dxlrun-easing 0.1.0) {says}"]


def test_parameters_whose_model_raises(told: Told) -> None:
    (line,) = told(
        "from pydantic import Field",
        "from pydantic import AfterValidator\nField = lambda **_: AfterValidator(lambda value: 1 / 0)",
    )
    assert line.startswith(
        f"{NAME_MARK}controller head (dxlrun-easing 0.1.0) cannot check its parameters: ZeroDivision"
    )


def test_the_same_for_programs_from_a_process_of_its_own(told: Told, tmp_path: Path) -> None:
    told("return 4", "return 7")
    path = os.pathsep.join(filter(None, [str(tmp_path), os.environ.get("PYTHONPATH")]))
    code = "import sys; from dxlrun.cli import main; sys.exit(main(sys.argv[1:]))"
    check = subprocess.run(
        [sys.executable, "-P", "-c", code, "check", "example.yaml", "--json"],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=False,
    )
    (error,) = read_answer(check.stdout).errors
    assert check.returncode == 2
    assert (error.file, error.line, error.column) == ("example.yaml", 12, 16)
