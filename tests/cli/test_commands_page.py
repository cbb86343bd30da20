"""docs/commands.md has every command and every option of the program, and no others."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

PAGE = (Path(__file__).parents[2] / "docs" / "commands.md").read_text()
SECTIONS: dict[str, str] = dict(re.findall(r"^## ([^\n]+)\n(.*?)(?=^## |\Z)", PAGE, re.M | re.S))
RUN = "dxlrun ROBOT.yaml"
STEER = {"send", "switch", "set", "rate", "pause", "resume", "load", "unload", "stop"}
EVERYWHERE = {"--debug", "--json", "--robot"}
"""Options that the page describes once."""
Dxlrun = Callable[..., Any]


def rows(text: str) -> list[str]:
    """Return the left column of the tables of a help."""
    return re.findall(r"^│ (?:\*  )?([\w-]\S*(?: \(-h\))?)", text, re.MULTILINE)


def test_every_command_has_a_section(dxlrun: Dxlrun) -> None:
    commands = {row for row in rows(dxlrun("--help").out) if re.fullmatch("[a-z]+", row)}
    assert {heading.split()[0] for heading in SECTIONS} - {"dxlrun"} == commands
    families = {row for row in rows(dxlrun("bench", "--help").out) if re.fullmatch("[a-z]+", row)}
    assert {f"bench {row}" for row in families} == {one for one in SECTIONS if one.startswith("bench")}
    table = PAGE[: PAGE.index("**Exit codes**")]
    assert commands == set(re.findall(r"\[`([a-z]+)`\]\(#", table))
    for option in ("--install-completion", "--version", "--help"):
        assert f"`{option}`" in table
        assert option in dxlrun("--help").out


@pytest.mark.parametrize("heading", SECTIONS)
def test_every_option_of_a_command_is_there(dxlrun: Dxlrun, heading: str) -> None:
    words = [] if heading == RUN else heading.split()
    options = {row for row in rows(dxlrun(*words, "--help").out) if row.startswith("--")}
    if heading == RUN:
        options -= {"--help (-h)", "--install-completion", "--version"}
    assert "--debug" in options
    assert ("--json" in options) == (heading not in {RUN, "schema"})
    assert ("--robot" in options) == (heading in {"list", *STEER})
    described = set(
        re.findall(r"(?<=`)--[a-z-]+", "\n".join(re.findall(r"^\| (.+?) \|", SECTIONS[heading], re.M)))
    )
    assert described == options - EVERYWHERE
