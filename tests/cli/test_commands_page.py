"""commands.md: a wrong file is reported as it says; tests/test_reference.py has the commands."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from tests.kit.pages import page_text

PAGE = page_text("commands.md")
Dxlrun = Callable[..., Any]

WRONG = """name: wrong
buses:
  main: {port: sim, protocol: 1.0, baud_rate: 1_000_000}
loop: {rate: 50}
joints:
  left_joint: {bus: main, id: 1, model: AX-12A, reference: 150 deg, direction: 1}
  neck_joint: {bus: mian, id: 3, model: AX-12A, reference: 150 deg, direction: 1}
  back_joint: {bus: main, id: 1, model: AX-12A, reference: 150 deg, direction: 1}
  tail_joint: {bus: main, id: 4, model: AX-12B, reference: 150 deg, direction: 1}
"""


def test_a_wrong_file_is_reported_as_the_page_has_it(
    dxlrun: Dxlrun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "robot.yaml").write_text(WRONG)
    (shown,) = re.findall(r"```\n(robot.yaml:.*?)```", PAGE, re.DOTALL)
    checked = dxlrun("check", "robot.yaml")
    assert (checked.code, checked.err) == (2, shown)
