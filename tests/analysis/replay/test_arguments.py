"""Other arguments for the robot file in the log: with what it includes, and nowhere else on the disk."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from dxlrun.errors import InputError
from dxlrun.testing import simulated_robot
from dxlrun_analysis.replay import replay_log

ROBOTS = Path(__file__).parents[3] / "robots"
Change = Callable[..., Path]


@pytest.fixture
def log_with_include(robot_file: Path, tmp_path: Path) -> Path:
    """The robot's log, whose controllers stand in a file above the robot's directory."""
    head, tail = robot_file.read_text().split("controllers:\n")
    (tmp_path / "robots").mkdir()
    (tmp_path / "robots/pair.yaml").write_text(f"include: [../controllers.yaml]\n{head}")
    (tmp_path / "controllers.yaml").write_text(f"controllers:\n{tail}")
    log = tmp_path / "run.mcap"
    simulated_robot(tmp_path / "robots/pair.yaml", duration_s=0.5, log=log).run()
    (tmp_path / "controllers.yaml").unlink()
    (tmp_path / "robots/pair.yaml").unlink()
    return log


def test_included_files_come_from_the_log(log_with_include: Path) -> None:
    assert replay_log(log_with_include, (), {"speed": "5 rad/s"}).compared == 25


def test_the_urdf_comes_from_the_log(tmp_path: Path) -> None:
    log = tmp_path / "run.mcap"
    simulated_robot(ROBOTS / "bioloid_torso.yaml", duration_s=0.2, log=log).run()
    assert replay_log(log, (), {"rate": "50"}).same


def test_a_file_outside_of_the_robots_directory_is_not_written(
    log_with_include: Path, changed: Change, tmp_path: Path
) -> None:
    target = tmp_path / "written.yaml"
    up = "/".join([".."] * 40)

    def change(content: Any) -> None:
        plan = json.loads(content.attachments["plan.json"])
        plan["included"][f"{up}{target}"] = "name: gotcha"
        content.attachments["plan.json"] = json.dumps(plan).encode()

    with pytest.raises(InputError, match="outside of its robot's directory"):
        replay_log(changed(log_with_include, change), (), {"speed": "5 rad/s"})
    assert not target.exists()


def test_a_plan_that_the_file_no_longer_gives(pair_log: Path, changed: Change) -> None:
    def change(content: Any) -> None:
        plan = json.loads(content.attachments["plan.json"])
        plan["loop"]["joints"][1]["upper"] = 0.5
        content.attachments["plan.json"] = json.dumps(plan).encode()

    with pytest.raises(InputError, match="no longer gives the plan that was run"):
        replay_log(changed(pair_log, change), (), {"speed": "5 rad/s"})
