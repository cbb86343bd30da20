"""`dxlrun models` on all tables, and the names on models.md; single models are in models.txt."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from tests.kit.answers import result_of
from tests.kit.commands import Dxlrun
from tests.kit.pages import page_text

import dxlwire
from dxlrun.cli.tools.models import runs, unit_of
from dxlrun.contract.hookspecs import HookSpecs
from dxlwire.control_table import all_tables, find_table
from dxlwire.control_table.device_models import device_tables

PAGE = page_text("models.md")


def test_all_models_are_listed_without_their_items(dxlrun: Dxlrun) -> None:
    said = dxlrun("models")
    assert [one.model for one in all_tables() if f"\n{one.model} " not in said.out] == []
    shown = result_of(dxlrun("models", "--json").out)
    servos = [(each["model"], each["protocol"]) for each in shown if each["kind"] == "servo"]
    assert servos == [(table.model, table.protocol) for table in all_tables()]
    devices = [each["model"] for each in shown if each["kind"] == "device"]
    assert devices == [table.model for table in device_tables()]
    assert not any("items" in each for each in shown)


def test_one_model_has_all_items_and_capabilities(dxlrun: Dxlrun) -> None:
    table = find_table("XM430-W350")
    (shown,) = result_of(dxlrun("models", "XM430-W350", "--json").out)
    assert [item["name"] for item in shown["items"]] == list(table.items)
    assert shown["capabilities"] == sorted(table.capabilities)
    assert shown["rad_per_tick"] == table.rad_per_tick
    assert [item.name for run in runs(tuple(table.items.values())) for item in run] == list(table.items)


@pytest.mark.parametrize(
    ("item", "unit"),
    [("goal_position", "0.08789 deg"), ("goal_pwm", "0.113 %"), ("present_current", "2.69 mA"), ("led", "")],
)
def test_units_are_those_that_people_read(item: str, unit: str) -> None:
    assert unit_of(find_table("XM430-W350").items[item]) == unit


def test_page_shows_hooks_and_files_that_exist() -> None:
    (code,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    hooks = re.findall(r"^@hookimpl\ndef (\w+)\(\) -> (.+):$", code, re.MULTILINE)
    assert [name for name, _ in hooks] == ["dxlrun_contract", "dxlrun_servo_models"]
    assert all(hasattr(HookSpecs, name) for name, _ in hooks)
    compile(code, "models.md", "exec")
    folder = Path(dxlwire.__file__).parent / "control_table" / "tables"
    names = re.findall(r"`(\w[\w-]*\.toml)`", PAGE)
    assert names
    assert [name for name in names if not list(folder.rglob(name))] == []
