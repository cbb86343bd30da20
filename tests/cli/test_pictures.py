"""The pages' pictures: the script that makes them works, and its check names a picture whose inputs changed.

tests/test_reference.py runs that check on the pictures of the pages.
"""

from __future__ import annotations

import html
import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
from tests.kit.awaited import DEADLINE_S
from tests.kit.pages import PATHS

ROOT = Path(__file__).parents[2]
PICTURES = ROOT / "docs" / "pictures"
NAMES = tuple(json.loads((PICTURES / "inputs.json").read_text()))
SAME = ("check", "mistakes", "graph", "lost", "setup", "calibrate", "teach")
"""Pictures of a terminal that are the same in each run, but for measured numbers."""
OTHERS = ("terminal", "scan", "fall", "cycle", "setup_hands", "calibrate_hands", "teach_hands", "motion")
"""Pictures that need neither Chromium nor minutes, and that the machine changes."""


pytestmark = [pytest.mark.long, pytest.mark.timeout(300)]


def words(path: Path) -> list[str]:
    """Return the texts of a picture, with 0 for each number."""
    texts = re.findall(r"<text[^>]*>(.*?)</text>", path.read_text(), re.DOTALL)
    lines = [html.unescape(one).replace("\xa0", " ").strip() for one in texts]
    return [re.sub(r"\d[\d.:-]*", "0", line) for line in lines if line]


@pytest.mark.needs("report")
@pytest.mark.parametrize("name", [*SAME, *OTHERS])
def test_picture_can_be_made(tmp_path: Path, name: str) -> None:
    make = [sys.executable, PICTURES / "make.py", name, "--into", tmp_path, "--virtual"]
    ran = subprocess.run(make, check=False, capture_output=True, text=True, timeout=DEADLINE_S)
    assert ran.returncode == 0, ran.stderr
    made = words(tmp_path / f"{name}.svg")
    assert made
    if name in SAME:
        assert made == words(PICTURES / f"{name}.svg")


def test_check_names_the_picture_and_the_command_when_an_input_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(PICTURES))
    import inputs  # a script of docs/pictures

    texts = {"pan": {"robots/pan.yaml": "rate: 50", "drawing": "<svg/>"}, "tilt": {"drawing": "<svg/>"}}
    monkeypatch.setattr(inputs, "HASHES", tmp_path / "inputs.json")
    monkeypatch.setattr(
        inputs,
        "inputs_of_pictures",
        lambda _: {
            name: {one: lambda text=text: text for one, text in found.items()}
            for name, found in texts.items()
        },
    )
    inputs.record(["pan", "tilt"])
    assert inputs.stale() == []
    texts["pan"]["robots/pan.yaml"] = "rate: 100"
    assert inputs.stale() == ["pan: robots/pan.yaml changed; run python docs/pictures/make.py pan"]
    inputs.record(["pan"])
    assert inputs.stale() == []


def test_the_pages_show_them_and_they_are_small() -> None:
    shown = {
        (path.parent / target).resolve()
        for path in (ROOT / "README.md", *PATHS.values())
        for target in re.findall(r"!\[[^\]]+\]\(([^)\s]+)\)", path.read_text())
    }
    assert shown == {path for path in PICTURES.iterdir() if path.suffix in {".png", ".svg"}}
    assert {path.stem for path in shown} == set(NAMES)
    assert len(shown) >= 20
    assert sum(one.stat().st_size for one in shown) < 3_000_000
    for one in shown:
        assert one.stat().st_size < 200_000, one
        if one.suffix == ".svg":
            text = one.read_text()
            assert not re.search(r"(href|src)=\"(?!#|data:)|url\((?!#)|@import|<script", text), one
