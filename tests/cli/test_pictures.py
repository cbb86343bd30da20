"""The pages' pictures: their check names a picture whose inputs changed; tests/test_reference.py runs it."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from tests.kit.pages import PATHS

ROOT = Path(__file__).parents[2]
PICTURES = ROOT / "docs" / "pictures"
NAMES = tuple(json.loads((PICTURES / "inputs.json").read_text()))


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
