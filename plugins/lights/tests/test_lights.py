"""The section `lights` on simulated servos and virtual time, registered as an installation does it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import dxlrun.features
from dxlrun import InputError
from dxlrun.channels.commands import Command
from dxlrun.cli import main
from dxlrun.description.robot import robot_form
from dxlrun.features import FEATURES
from dxlrun.testing import plan_of, read_log, simulated_robot

ROBOT = Path(__file__).parents[1] / "lights.yaml"
LIGHTS = "lights:\n  left: {joint: pan_joint}\n  right: {joint: tilt_joint}\n"


@pytest.fixture(autouse=True)
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Leave the metadata of the package as pip does."""
    info = tmp_path / "site" / "dxlrun_lights-0.1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: dxlrun-lights\nVersion: 0.1.0\n")
    (info / "entry_points.txt").write_text("[dxlrun]\nlights = dxlrun_lights.plugin\n")
    monkeypatch.syspath_prepend(str(tmp_path / "site"))
    forget_features()
    yield
    monkeypatch.undo()
    forget_features()


def forget_features() -> None:
    """Let dxlrun look for installed features again."""
    dxlrun.features._installed.cache_clear()
    robot_form.cache_clear()


def mistakes(tmp_path: Path, lights: str) -> list[str]:
    """Return the messages about a robot file with another section `lights`."""
    file = tmp_path / "robot.yaml"
    file.write_text(ROBOT.read_text().replace(LIGHTS, lights))
    with pytest.raises(InputError) as error:
        plan_of(file)
    return [f"{problem.what}; {problem.fix}" for problem in error.value.problems]


def test_light_follows_its_command(tmp_path: Path) -> None:
    log = tmp_path / "lights.mcap"
    robot = simulated_robot(ROBOT, duration_s=0.5, log=log)
    values = np.array([1.0, 0.0]).tobytes()
    robot.inbox.waiting.append(Command(1, "lamps", "device_commands", values, "test"))
    assert robot.run().reason == "ended"
    leds = [robot.buses[0].servo(servo_id).registers["led"] for servo_id in (1, 2)]
    assert leds == [1, 0]
    cycles = read_log(log).cycles
    assert cycles["device_command"][-1].tolist() == [1.0, 0.0]


def test_plan_and_log_name_the_package() -> None:
    plan = plan_of(ROBOT)
    assert plan.features[-1].name == "lights"
    assert plan.packages["dxlrun_lights"] == "dxlrun-lights"
    assert plan.loop.source_commands == ("lights/left", "lights/right")


def test_check_lists_the_lights(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "120")
    assert main(["check", str(ROBOT)]) == 0
    out = capsys.readouterr().out
    assert "Lights" in out
    assert "left   pan_joint" in out


@pytest.mark.parametrize(
    ("lights", "message"),
    [
        (
            "lights: {left: {joint: pan}}\n",
            "light left is on pan, which is not a joint; known: pan_joint, tilt_joint",
        ),
        ("lights: {left: {}}\n", "lights.left has no joint"),
    ],
)
def test_mistake_is_named(tmp_path: Path, lights: str, message: str) -> None:
    assert any(message in each for each in mistakes(tmp_path, lights)), mistakes(tmp_path, lights)


def test_robot_without_the_section_does_not_use_the_feature(tmp_path: Path) -> None:
    file = tmp_path / "robot.yaml"
    file.write_text(ROBOT.read_text().replace(LIGHTS, "").partition("controllers:")[0])
    plan = plan_of(file)
    assert plan.features == FEATURES
    assert "dxlrun_lights" not in plan.packages
