"""Tests that start whole runs in real time stay on one worker when the tests are spread over several."""

from __future__ import annotations

from pathlib import Path

import pytest

HERE = Path(__file__).parent
REAL_TIME = ("bench", "plugins", "run", "test_readme.py")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Two robots at once on two cores would only measure each other; before xdist looks at the groups."""
    for item in items:
        if item.path.relative_to(HERE).parts[0] in REAL_TIME:
            item.add_marker(pytest.mark.xdist_group("real_time"))
