"""Names and numbers of models, tables of plug-ins, and files that extend another one."""

from __future__ import annotations

from pathlib import Path

import pytest

import dxlwire.control_table
from dxlwire.control_table import add_control_table, find_table, model_names, models_by_number, servo_models
from dxlwire.control_table.table_files import resolve

AX_12A = Path(dxlwire.control_table.__file__).parent / "tables/protocol1/AX-12A.toml"


@pytest.fixture
def mine(monkeypatch: pytest.MonkeyPatch) -> str:
    """The table of a servo that a plug-in brings along; it is forgotten after the test."""
    monkeypatch.setattr(servo_models, "_ADDED", {1.0: [], 2.0: []})
    text = AX_12A.read_text("utf-8")
    for old, new in (
        ('model = "AX-12A"', 'model = "Mine-1"'),
        ('aliases = ["AX-12", "AX-12+"]', "aliases = []"),
        ("model_number = 12\n", "model_number = 60001\n"),
    ):
        assert old in text
        text = text.replace(old, new)
    return text


@pytest.mark.parametrize(
    ("name", "model"),
    [
        ("AX-12", "AX-12A"),
        ("AX-12+", "AX-12A"),
        ("XL-430", "XL430-W250"),
        ("xl430", "XL430-W250"),
        ("XL430-W250-T", "XL430-W250"),
        ("XM540-W270-R", "XM540-W270"),
        ("2XC430", "2XC430-W250"),
        ("AX12", "AX-12A"),
        ("ax 12a", "AX-12A"),
        ("XL_320", "XL-320"),
        ("EX-106", "EX-106+"),
        ("MX64AT", "MX-64"),
        ("XC330-M288-T", "XC330-M288"),
        # with ball bearings
        ("XC430-T150BB", "XC430-W150"),
        ("XC430-W150BB", "XC430-W150"),
        ("XC430-T240BB", "XC430-W240"),
        ("XC430-W240BB", "XC430-W240"),
    ],
)
def test_names_that_mean_one_model_are_understood(name: str, model: str) -> None:
    assert find_table(name).model == model


@pytest.mark.parametrize(
    "name", ["XM430", "XL330", "XL", "XL-3", "AX", "AX-13", "XL430-W250-B", "T", "-", ""]
)
def test_names_that_mean_several_models_or_none_are_not(name: str) -> None:
    with pytest.raises(LookupError, match="no control table for the model"):
        find_table(name)


def test_a_model_of_both_protocols_is_chosen_by_the_protocol() -> None:
    assert find_table("MX-28", 1.0).model_number == 29
    assert find_table("MX-28", 2.0).model_number == 30
    assert find_table("MX-28(2.0)").model_number == 30
    with pytest.raises(LookupError, match=r"Protocol 1\.0 and 2\.0; give the protocol"):
        find_table("MX-28")
    with pytest.raises(LookupError, match=r"AX-12A uses Protocol 1\.0, not Protocol 2\.0"):
        find_table("AX-12A", 2.0)
    with pytest.raises(LookupError, match="'AX-13'; `dxlrun models` lists all"):
        find_table("AX-13", 1.0)


def test_a_table_of_a_plug_in_is_found_by_name_and_number(mine: str) -> None:
    table = add_control_table(mine)
    assert find_table("Mine-1") is table
    assert models_by_number(60001, 1.0) == (table,)
    assert "Mine-1" in model_names()
    assert add_control_table(mine) == table, "the same table twice is no contradiction"


LOAD = 'tick = "{}", page = "Present Load'


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ('model = "Mine-1"', 'model = "AX-12+"', "is already used by the AX-12A"),
        ("model_number = 60001\n", "model_number = 12\n", "is already used by the AX-12A"),
        ("model_number = 60001\n", "", "the entry 'model_number' is missing"),
        ("protocol = 1.0\n", "protocol = 3.0\n", "protocol must be 1.0 or 2.0, not 3.0"),
        ('["sync_write"]', '["telepathy"]', "not allowed in a data file: telepathy"),
        (
            LOAD.format("1/1023 fraction"),
            LOAD.format("1 V"),
            "load: the unit must be a fraction, A or Nm, not V",
        ),
    ],
)
def test_a_table_of_a_plug_in_that_cannot_be_used_is_refused(
    mine: str, old: str, new: str, complaint: str
) -> None:
    assert old in mine
    with pytest.raises(ValueError, match=complaint):
        add_control_table(mine.replace(old, new))


def test_a_file_takes_over_what_it_does_not_say() -> None:
    entries = {
        "a": {
            "model": "A",
            "aliases": ["A-T"],
            "speed": 1,
            "items": {"x": {"address": 4, "size": 1}, "y": {"address": 6, "size": 1}},
        },
        "b": {
            "extends": "a",
            "model": "B",
            "left_out": ["y"],
            "items": {"x": {"size": 2}, "z": {"address": 0}},
        },
    }
    merged = resolve("b", entries)
    assert (merged["model"], merged["aliases"], merged["speed"]) == ("B", [], 1)
    assert merged["items"] == {"z": {"address": 0}, "x": {"address": 4, "size": 2}}
    assert list(merged["items"]) == ["z", "x"], "in the order of addresses"
    assert entries["a"]["items"] == {"x": {"address": 4, "size": 1}, "y": {"address": 6, "size": 1}}


@pytest.mark.parametrize("entries", [{"a": {"extends": "b"}}, {"a": {"extends": "b"}, "b": {"extends": "a"}}])
def test_a_file_that_extends_nothing_or_itself_is_refused(entries: dict[str, dict[str, str]]) -> None:
    with pytest.raises(ValueError, match="is not another control table"):
        resolve("a", entries)
