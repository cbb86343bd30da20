"""A pose has one notation: `joint=position` in a command line, `{joint: position}` in a file."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PLACES = [
    ROOT / "README.md",
    ROOT / "runtime/dxlrun/cli/examples.txt",
    *sorted((ROOT / "docs").rglob("*.md")),
    *sorted((ROOT / "robots").glob("*.yaml")),
]
POSITION = re.compile(r"\w+=-?\d+(\.\d+)?(deg|mm|rad|m)")


def _lines() -> list[list[str]]:
    """Return the words of every command line that the documentation shows."""
    found = []
    for place in PLACES:
        if place.parent.name != "changes":
            for line in re.findall(
                r"^[# ]*(dxlrun (?:send|frames) [^#`\n]+)", place.read_text(), re.MULTILINE
            ):
                found.append(shlex.split(line.split("   ")[0]))
    return found


LINES = _lines()
POSES = [words for words in LINES if "--at" in words or words[3:4] in (["position"], ["positions"])]


@pytest.mark.parametrize("words", POSES, ids=" ".join)
def test_pose_in_the_documentation_has_one_notation(words: list[str]) -> None:
    first = words.index("--at") + 1 if "--at" in words else 4
    assert "positions" not in words
    rest = words[first:]
    options = [number for number, word in enumerate(rest) if word.startswith("--")]
    pose = rest[: options[0]] if options else rest
    assert pose
    assert all(POSITION.fullmatch(word) for word in pose)


def test_the_documentation_shows_poses() -> None:
    assert len(POSES) >= 6
