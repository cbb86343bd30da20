"""commands.md has every command and every option of the program, and no others."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from tests.kit.pages import page_text

PAGE = page_text("commands.md")
SECTIONS: dict[str, str] = dict(re.findall(r"^## ([^\n]+)\n(.*?)(?=^## |\Z)", PAGE, re.M | re.S))
RUN = "dxlrun ROBOT.yaml"
STEER = {
    "send",
    "echo",
    "play",
    "cancel",
    "parameters",
    "switch",
    "watch",
    "get",
    "set",
    "torque",
    "reboot",
    "rate",
    "halt",
    "pause",
    "resume",
    "load",
    "unload",
    "stop",
}
ON_ROBOT = {"characterize", "identify", "teach", "teleop"}
DIALOGUES = {"setup", "calibrate", "teach", "teleop"}
EVERYWHERE = {"--debug", "--json", "--robot"}
"""Options that the page describes once."""
Dxlrun = Callable[..., Any]


def rows(text: str) -> list[str]:
    """Return the first word of each row in the tables of a help."""
    return [row.split()[0] for row in re.findall(r"^(\S+(?: \S+)*?) {2,}\S", text, re.MULTILINE)]


def test_every_command_has_a_section(dxlrun: Dxlrun) -> None:
    commands = {row for row in rows(dxlrun("--help").out) if re.fullmatch("[a-z]+(-[a-z]+)*", row)}
    assert {heading.split()[0] for heading in SECTIONS} - {"dxlrun"} == commands
    for family in ("bench", "experiment"):
        found = {row for row in rows(dxlrun(family, "--help").out) if re.fullmatch("[a-z]+(-[a-z]+)*", row)}
        assert {f"{family} {row}" for row in found} == {one for one in SECTIONS if one.startswith(family)}
    table = PAGE[: PAGE.index("**Exit codes**")]
    assert commands == set(re.findall(r"\[`([a-z-]+)`\]\(#", table))
    for option in ("--install-completion", "--version", "--help"):
        assert f"`{option}`" in table
        assert option in dxlrun("--help").out


WRONG = """name: wrong
buses:
  main: {port: sim, protocol: 1.0, baud_rate: 1_000_000}
loop: {rate: 50}
joints:
  left_joint: {bus: main, id: 1, model: AX-12A, reference: 150 deg, direction: 1}
  neck_joint: {bus: mian, id: 3, model: AX-12A, reference: 150 deg, direction: 1}
  back_joint: {bus: main, id: 1, model: AX-12A, reference: 150 deg, direction: 1}
  tail_joint: {bus: main, id: 4, model: AX-12A, reference: 150, direction: 1}
"""


def test_a_wrong_file_is_reported_as_the_page_has_it(
    dxlrun: Dxlrun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "robot.yaml").write_text(WRONG)
    (shown,) = re.findall(r"```\n(robot.yaml:.*?)```", PAGE, re.DOTALL)
    checked = dxlrun("check", "robot.yaml")
    assert (checked.code, checked.err) == (2, shown)


@pytest.mark.parametrize("heading", SECTIONS)
def test_every_option_of_a_command_is_there(dxlrun: Dxlrun, heading: str) -> None:
    words = [] if heading == RUN else heading.split()
    options = {row for row in rows(dxlrun(*words, "--help").out) if row.startswith("--")}
    if heading == RUN:
        options -= {"--help", "--install-completion", "--version"}
    assert "--debug" in options
    assert ("--json" in options) == (heading not in {RUN, "schema", *DIALOGUES})
    assert ("--robot" in options) == (heading in {"list", *ON_ROBOT, *STEER})
    described = set(
        re.findall(r"(?<=`)--[a-z-]+", "\n".join(re.findall(r"^\| (.+?) \|", SECTIONS[heading], re.M)))
    )
    assert described == options - EVERYWHERE
