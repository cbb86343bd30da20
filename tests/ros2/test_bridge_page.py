"""docs/how-to/ros2.md, and the command line of the bridge: what they name is there."""

import re
import shlex
from pathlib import Path

import pytest

from dxlrun_ros2 import bridge_command

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs/how-to/ros2.md").read_text()
COMMANDS = [shlex.split(line) for line in re.findall(r"^    (ros/bin/.+)$", PAGE, re.MULTILINE)]


def test_the_commands_of_the_page_install_and_start_what_is_there() -> None:
    installs = [words[1:] for words in COMMANDS if words[0].endswith("pip")]
    assert installs == [["install", ".", "./plugins/dxlrun_ros2"]]  # in one: it needs dxlrun of its version
    assert all((ROOT / path / "pyproject.toml").is_file() for path in installs[0][1:])
    starts = [words for words in COMMANDS if words[0].endswith("dxlrun-ros2")]
    assert len(installs) + len(starts) == len(COMMANDS)
    for _, *words in starts:
        own = words[: words.index("--ros-args")] if "--ros-args" in words else words
        robot = bridge_command.arguments(own).robot
        assert (ROOT / f"robots/{robot}.yaml").is_file()


@pytest.mark.parametrize("words", [["--lease", "0"], ["--lease", "soon"], ["a", "b"], ["--nope"]])
def test_a_wrong_command_line_ends_with_2(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        bridge_command.arguments(words)
    assert ended.value.code == 2
    assert "dxlrun-ros2: error" in capsys.readouterr().err


def test_one_of_several_robots_must_be_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(bridge_command, "running", lambda: ("left", "right"))
    with pytest.raises(SystemExit):
        bridge_command.arguments([])
    assert "several robots run: left, right; name one" in capsys.readouterr().err
    assert bridge_command.arguments(["left"]).robot == "left"
