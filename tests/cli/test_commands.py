"""Command lines and what they print: texts in this folder; `tests/kit/commands.py` has their form."""

import re
from pathlib import Path

import pytest
from tests.kit.answers import result_of
from tests.kit.commands import Case, Dxlrun, cases, play
from tests.kit.pages import page_text

import dxlwire
from dxlrun.contract.hookspecs import HookSpecs
from dxlwire.control_table import all_tables
from dxlwire.control_table.device_models import device_tables

TEXTS = ("refusals", "check", "frames", "models")


@pytest.mark.usefixtures("reader")
@pytest.mark.parametrize("case", [case for name in TEXTS for case in cases(f"{name}.txt")])
def test_command_prints_what_its_text_has(dxlrun: Dxlrun, case: Case) -> None:
    play(case, dxlrun)


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
