from pathlib import Path

import pytest


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let each test write its files into a folder of its own."""
    monkeypatch.chdir(tmp_path)
