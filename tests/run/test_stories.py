"""Joints that are halted, lost, limp or moved by hand, told in `stories`; see tests/kit/told_stories.py."""

from pathlib import Path

import pytest
from tests.kit.cases import TextCase
from tests.kit.told_stories import check_story, story_parameters


@pytest.mark.parametrize("case", [*story_parameters(Path(__file__).with_name("stories"))])
def test_story(case: TextCase, tmp_path: Path) -> None:
    check_story(case, tmp_path)
