"""What clients request of a robot that runs, and what comes of it: the stories of `*.txt`."""

from __future__ import annotations

from pathlib import Path

import pytest
from tests.kit.steering import STORIES, Story, stories

FOUND = [
    pytest.param(story, id=f"{path.stem}: {story.title}")
    for path in sorted(STORIES.glob("*.txt"))
    for story in stories(path)
]


@pytest.mark.parametrize("story", FOUND)
def test_each_story_comes_out_as_written(story: Story, tmp_path: Path) -> None:
    story.check(tmp_path)
