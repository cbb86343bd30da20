"""Joints that are lost, limp or moved by hand, by the texts in `stories`; see tests/kit/told_stories.py."""

from __future__ import annotations

from pathlib import Path

import pytest
from tests.kit.told_stories import check_story, stories

pytestmark = pytest.mark.long


@pytest.mark.parametrize(("path", "head", "lines"), [*stories(Path(__file__).with_name("stories"))])
def test_story(path: Path, head: str, lines: list[tuple[int, str]], tmp_path: Path) -> None:
    check_story(path, head, lines, tmp_path)
