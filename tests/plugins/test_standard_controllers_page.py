"""standard-controllers.md: every controller and key is described, snippets are accepted, the script runs."""

from __future__ import annotations

import json
import re
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from tests.kit.pages import page_text

import dxlrun
from dxlrun.cli.examples import schema_text
from dxlrun.control.controllers.plugins import load_plugins

ROOT = Path(__file__).parents[2]
PAGE = page_text("standard-controllers.md")
SECTIONS = dict(re.findall(r"^## (\w+)\n(.*?)(?=^## |\Z)", PAGE, re.DOTALL | re.MULTILINE))
OFFERS = load_plugins().controllers
TYPES = {name: section for name, section in SECTIONS.items() if name in OFFERS}
RUNTIME_KEYS = {"type", "active", "rate", "fallback", "into"}


def test_there_are_sections() -> None:
    assert {"diff_drive_controller", "gripper_controller", "keyframe_player", "leader_follower"} <= set(TYPES)


@pytest.mark.parametrize("name", TYPES)
def test_a_section_has_a_table_of_the_keys(name: str) -> None:
    assert re.search(rf"^<!-- keys: {name} -->$", TYPES[name], re.MULTILINE)


def test_every_controller_and_each_of_its_keys_is_described() -> None:
    parts = json.loads(schema_text("robot", only="dxlrun "))["$defs"]
    named = {name for name in OFFERS if f"`{name}`" in PAGE or name in TYPES}
    assert set(OFFERS) - named == {"joint_state_broadcaster"}  # it has no key
    assert [
        f"{name}.{key}"
        for name, part in parts.items()
        if name.partition(".")[0] in OFFERS
        for key, entry in part["properties"].items()
        if not {"description", "const", "$ref"} & set(entry)
    ] == []


@pytest.mark.parametrize("name", TYPES)
def test_snippets_are_accepted(name: str) -> None:
    for block in re.findall(r"```yaml\n(.*?)```", TYPES[name], re.DOTALL):
        for entry in yaml.safe_load(block).values():
            kind = OFFERS[entry["type"]].controller
            kind.Parameters.model_validate({key: entry[key] for key in entry if key not in RUNTIME_KEYS})


class Robot:
    """A running robot of which the script asks; after five looks the person at it presses Ctrl-C."""

    def __init__(self) -> None:
        self.sent: list[list[float]] = []
        self.looks = 0

    def __enter__(self) -> Robot:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def states(self) -> SimpleNamespace:
        self.looks += 1
        if self.looks > 5:
            raise KeyboardInterrupt
        age_ns = 300_000_000 if self.looks == 3 else 10_000_000
        names = ("left_shoulder", "left_elbow")
        positions, ages_ns = np.full(2, 0.1 * self.looks), np.full(2, age_ns)
        return SimpleNamespace(joints=names, position=positions, age_ns=ages_ns)

    def stream(self, controller: str, kind: str, lease: float) -> Robot:
        assert (controller, kind) == ("follow", "positions")
        return self

    def send(self, command: dict[str, list[float]]) -> None:
        self.sent.append(command["positions"])


def test_the_mirroring_script_sends_fresh_positions_only(monkeypatch: pytest.MonkeyPatch) -> None:
    (script,) = re.findall(r"```python\n(.*?)```", SECTIONS["leader_follower"], re.DOTALL)
    robots = {"leader": Robot(), "follower": Robot()}
    monkeypatch.setattr(dxlrun, "connect", robots.__getitem__)
    monkeypatch.setattr(time, "sleep", lambda _: None)
    with pytest.raises(KeyboardInterrupt):
        # as code: after an interrupt in a text CPython ends with 130, whatever was caught
        exec(compile(script, "page", "exec"), {})  # noqa: S102  # the page's own
    assert [positions[0] for positions in robots["follower"].sent] == pytest.approx([0.1, 0.2, 0.4, 0.5])


def test_every_robot_is_in_the_table_of_examples() -> None:
    named = set(re.findall(r"\(\.\./\.\./robots/(\w+)\.yaml\)", PAGE))
    assert named == {path.stem for path in (ROOT / "robots").glob("*.yaml")}
