"""The pages' pictures: the script that makes them works, and their words are those of the program today."""

from __future__ import annotations

import html
import re
import shutil
import struct
import subprocess
import sys
from pathlib import Path

import pytest
from tests.kit.pages import PATHS

ROOT = Path(__file__).parents[2]
PICTURES = ROOT / "docs" / "pictures"
SAID = ("check", "mistakes", "graph", "lost")
"""Pictures of a terminal that are the same in each run; the words of what was measured are not compared."""
VERDICT = ("bioloid_torso: done: ran for ", "The loop kept ")


pytestmark = pytest.mark.timeout(300)


def words(path: Path) -> list[str]:
    """Return the texts of a picture: of a row its first column, with 0 for each number."""
    texts = re.findall(r"<text[^>]*>(.*?)</text>", path.read_text(), re.DOTALL)
    lines = [html.unescape(one).replace("\xa0", " ").strip() for one in texts]
    return [re.sub(r"\d[\d.:-]*", "0", re.split(r"\s{2,}", line)[0]) for line in lines if line]


def test_the_pictures_have_the_words_of_today(tmp_path: Path) -> None:
    """Made anew on virtual time, because a busy machine adds sentences of its own to the verdict."""
    pytest.importorskip("bokeh")
    make = [sys.executable, PICTURES / "make.py", "terminal", *SAID, "--into", tmp_path, "--virtual"]
    ran = subprocess.run(make, check=False, capture_output=True, text=True, timeout=280)
    assert ran.returncode == 0, ran.stderr
    for name in SAID:
        assert words(tmp_path / f"{name}.svg") == words(PICTURES / f"{name}.svg"), name
    made = set(words(tmp_path / "terminal.svg"))
    shown = words(PICTURES / "terminal.svg")
    if "real time" in shown:  # the table of what was granted
        first = shown.index("real time")
        end = next(place for place, line in enumerate(shown) if line.startswith("bioloid_torso: done: "))
        assert {"collector", "polling", "guardian: scheduler"} <= set(shown[first:end])
        del shown[first:end]
    helps = ("helps.", "would help.")  # ends of remedies, broken at the terminal's width
    pinned = {
        line
        for line in shown
        if not line.startswith(("$", "dxlrun ", "─", "log: ", "real time: ", *VERDICT))
        and not line.endswith(helps)
    }
    pinned = {line for line in pinned if re.sub(r"\W|\d", "", line)}
    assert len(pinned) >= 25
    assert pinned <= made
    if shutil.which("chromium") is not None:
        made_size, shown_size = size_of(tmp_path / "report.png"), size_of(PICTURES / "report.png")
        assert made_size[0] == shown_size[0]
        assert 1000 < made_size[1] <= shown_size[1]  # a run on virtual time has no plot of wake-ups


def size_of(picture: Path) -> tuple[int, int]:
    """Return width and height of a PNG file, by its header."""
    width, height = struct.unpack(">II", picture.read_bytes()[16:24])
    return width, height


def test_the_pages_show_them_and_they_are_small() -> None:
    shown = {
        (path.parent / target).resolve()
        for path in (ROOT / "README.md", *PATHS.values())
        for target in re.findall(r"!\[[^\]]+\]\(([^)\s]+)\)", path.read_text())
    }
    assert shown == {path for path in PICTURES.iterdir() if path.suffix in {".png", ".svg"}}
    assert len(shown) >= 20
    assert sum(one.stat().st_size for one in shown) < 3_000_000
    for one in shown:
        assert one.stat().st_size < 200_000, one
        if one.suffix == ".svg":
            text = one.read_text()
            assert not re.search(r"(href|src)=\"(?!#|data:)|url\((?!#)|@import|<script", text), one
