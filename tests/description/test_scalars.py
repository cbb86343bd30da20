# ruff: noqa: E501 (a mistake and its sentence are read best side by side)

from __future__ import annotations

import math

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from dxlrun.description.document import plain_value, text_of


@pytest.mark.parametrize("text", ["yes", "no", "on", "off", "y", "Yes", "OFF", "tRUE", "nUll", "1:30", "190:20:30",
                                  "0b1", "1__0", "_1", "1_", "0o8", "0x", "-0x1", "2024-01-01", "1e", ".", "+", "--1",
                                  "infinity", "nan", "1 2", "60 deg"])  # fmt: skip
def test_yaml_1_2_leaves_it_text(text: str) -> None:
    assert plain_value(text) == text


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1_000_000", 1_000_000), ("0o17", 15), ("0x1F", 31), ("017", 17), ("-5", -5), ("+1", 1),
        ("1.0", 1.0), ("1.", 1.0), (".5", 0.5), ("1e3", 1000.0), ("1_0.5", 10.5), (".inf", math.inf), ("-.INF", -math.inf),
        ("true", True), ("False", False), ("null", None), ("~", None), ("", None),
    ],
)  # fmt: skip
def test_yaml_1_2_reads(text: str, value: object) -> None:
    read = plain_value(text)
    assert read == value
    assert type(read) is type(value)


def test_a_number_of_a_million_digits_is_text() -> None:
    digits = "9" * 1_000_000
    assert plain_value(digits) == digits


def test_not_a_number_is_a_float() -> None:
    value = plain_value(".nan")
    assert isinstance(value, float)
    assert math.isnan(value)


@settings(max_examples=300, deadline=None)
@given(st.one_of(st.none(), st.booleans(), st.integers(-(10**30), 10**30), st.floats(allow_nan=False)))
def test_text_of_a_value_reads_back(value: object) -> None:
    assert plain_value(text_of(value)) == value


@settings(max_examples=100, deadline=None)
@given(st.one_of(st.booleans(), st.integers(-1000, 1000), st.floats(-1e6, 1e6).map(lambda x: round(x, 3))))
def test_common_numbers_mean_the_same_as_in_pyyaml(value: object) -> None:
    # where YAML 1.1 and 1.2 agree, a foreign reader must see what we see
    text = text_of(value)
    assert plain_value(text) == yaml.safe_load(text)
