"""Robots on virtual time by the texts in `stories`; `tests/kit/told_stories.py` has the form of a story."""

from pathlib import Path

import pytest
from tests.kit.cases import TextCase
from tests.kit.told_stories import check_story, story_parameters

pytestmark = pytest.mark.long


@pytest.mark.parametrize("case", [*story_parameters(Path(__file__).with_name("stories"))])
def test_story(case: TextCase, tmp_path: Path) -> None:
    check_story(case, tmp_path)
