"""Joints of several servos and linear joints at the terminal; the commands of mechanics.md."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from tests.kit.pages import page_text

ROOT = Path(__file__).parents[2]


def test_the_commands_of_the_page_work(
    dxlrun: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of mechanics.md."""
    (tmp_path / "robots").symlink_to(ROOT / "robots")
    monkeypatch.chdir(tmp_path)
    page = page_text("mechanics.md")
    check, run = re.findall(r"^    dxlrun (.+)$", page, re.MULTILINE)
    shown = dxlrun(*shlex.split(check))
    assert shown.code == 0
    assert "62.8 mm a turn" in shown.out
    assert dxlrun(*shlex.split(run)).code == 0
    (log,) = (tmp_path / "logs").iterdir()
    analyzed = dxlrun("analyze", str(log))
    assert re.search(r"gripper .* mm ", analyzed.out)
    assert re.search(r"main 2 +hip/2 ", analyzed.out)
    assert dxlrun("convert", str(log), "again.yaml").code == 0
    written = Path("again.yaml").read_text()
    assert re.search(r"gripper: \{position: 0\.0\d+ m\}", written)
    assert re.search(r"hip: \{position: -?0\.\d+ rad, velocity: -?\d\.\d+ rad/s\}", written)
