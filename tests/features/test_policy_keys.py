"""A package with a policy of its own, that of add-a-section.md: runs in `stories`, files in `cases`."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.kit.cases import case_parameters, read_head
from tests.kit.robot_cases import check_case
from tests.kit.told_stories import check_story, story_parameters

from dxlrun.cli import check
from dxlrun.plan.robot_plan import from_json
from dxlrun.testing import installed, plan_of, read_log, simulated_robot
from dxlrun_analysis.replay.log_replay import replay_log

HERE = Path(__file__).parent
ROBOT = read_head(HERE / "cases" / "hot_servo.txt")
HOT = ROBOT.replace("exit_timeout: 6 s", "on_hot_servo: {above: 70 degC, do: limp}")


@pytest.fixture(autouse=True)
def with_package() -> Iterator[None]:
    """Let dxlrun find the package."""
    with installed(HERE / "hot_servo"):
        yield


@pytest.mark.parametrize("case", [*story_parameters(HERE / "stories" / "hot_servo.txt")])
def test_story(case, tmp_path):
    check_story(case, tmp_path)


@pytest.mark.parametrize("case", case_parameters(HERE / "cases" / "hot_servo.txt"))
def test_robot_file(case):
    check_case(case)


def test_check_shows_the_policy(robot_file, capsys):
    assert check.check_robot(robot_file(HOT)) == 0
    assert "on_hot_servo" in capsys.readouterr().out


def test_robot_without_the_key_does_not_use_the_package(robot_file):
    plan = plan_of(robot_file(ROBOT))
    assert "on_hot_servo" not in {feature.name for feature in plan.features}
    assert "dxlrun_hot" not in plan.packages
    group = "groups: {on_hot_servo: {joints: [pan], on_lost_servo: limp}}"
    assert "dxlrun_hot" not in plan_of(robot_file(ROBOT.replace("exit_timeout: 6 s", group))).packages


def test_replay_without_the_package_says_so(robot_file, tmp_path, monkeypatch):
    log = tmp_path / "run.mcap"
    simulated_robot(robot_file(HOT), duration_s=0.2, log=log).run()
    features = from_json(read_log(log).attachments["plan.json"]).features
    assert features[-1].distribution == "dxlrun-hot 1.0"
    assert not any("not installed" in remark for remark in replay_log(log).remarks)
    monkeypatch.setattr("dxlrun.features.installed_features", lambda: features[:-1])
    assert any("dxlrun-hot 1.0; it is not installed" in remark for remark in replay_log(log).remarks)
