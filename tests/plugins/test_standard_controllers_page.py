"""standard-controllers.md: every controller and key is described, snippets are accepted."""

import json
import re
from pathlib import Path

import pytest
import yaml
from pydantic import ValidationError
from tests.kit.pages import page_text

from dxlrun.cli.examples import schema_text
from dxlrun.control.controllers.plugin_loading import load_plugins
from dxlrun.description.form_problems import data_problems

ROOT = Path(__file__).parents[2]
PAGE = page_text("standard-controllers.md")
SECTIONS = dict(re.findall(r"^## (\w+)\n(.*?)(?=^## |\Z)", PAGE, re.DOTALL | re.MULTILINE))
OFFERS = load_plugins().controllers
TYPES = {name: section for name, section in SECTIONS.items() if name in OFFERS}
RUNTIME_KEYS = {"type", "active", "rate", "fallback", "into"}


def test_every_controller_and_each_of_its_keys_is_described():
    parts = json.loads(schema_text("robot", only="dxlrun "))["$defs"]
    named = {name for name in OFFERS if f"`{name}`" in PAGE or name in TYPES}
    assert set(OFFERS) == named
    assert [
        f"{name}.{key}"
        for name, part in parts.items()
        if name.partition(".")[0] in OFFERS
        for key, entry in part["properties"].items()
        if not {"description", "const", "$ref"} & set(entry)
    ] == []


@pytest.mark.parametrize("name", TYPES)
def test_snippets_are_accepted(name):
    for block in re.findall(r"```yaml\n(.*?)```", TYPES[name], re.DOTALL):
        for entry in yaml.safe_load(block).values():
            kind = OFFERS[entry["type"]].controller
            kind.Parameters.model_validate({key: entry[key] for key in entry if key not in RUNTIME_KEYS})


@pytest.mark.parametrize("name", [name for name in OFFERS if name != "cartesian_controller"])
def test_missing_key_comes_with_an_example(name):
    model = OFFERS[name].controller.Parameters
    try:
        model.model_validate({})
    except ValidationError as error:
        missing = [problem.fix for problem in data_problems(error, name, model, 20)]
        assert [fix for fix in missing if "..." in fix] == []


def test_every_robot_is_in_the_table_of_examples():
    named = set(re.findall(r"\(\.\./\.\./robots/(\w+)\.yaml\)", PAGE))
    assert named == {path.stem for path in (ROOT / "robots").glob("*.yaml")}
