"""What clients request of a robot that runs, and what comes of it: the stories of `*.txt`."""

from pathlib import Path

import pytest
from tests.kit.cases import TextCase, case_parameters
from tests.kit.steering import check_story


@pytest.mark.parametrize("case", case_parameters(Path(__file__).parent))
def test_each_story_comes_out_as_written(case: TextCase, tmp_path: Path) -> None:
    check_story(case, tmp_path)
