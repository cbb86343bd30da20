# ruff: noqa: E501 (a mistake and its sentence are read best side by side)
"""YAML 1.2: scalars, and mistakes of syntax at their places."""

import math
import os
import re
from pathlib import Path

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.kit import desk
from tests.kit.desk import TORSO

from dxlrun.description import document
from dxlrun.description.document import grow, literal, plain_value, text_of
from dxlrun.description.reading import read_robot
from dxlrun.errors import InputError, Mark

WRONG = [
    ("a: {port: ${port}, x: 1}\n", "1:12: ${...} inside { } or [ ] has no quotes", 'write "${name}"'),
    ("a:\n\tb: 1\n", "2:1: the indentation contains a tab", "spaces"),
    ("a:\n  - b: 1\n\tc: 2\n", "3:1: the indentation contains a tab", "spaces"),
    ("a: b: c\n", "1:5: this ':' is not allowed here", "quotes"),
    ("a: [1, 2\nb: 3\n", "1:4: this [ is not closed", "write ] at the end of line 1"),
    ("a: 1\nb: 'x\nc: 1\n", "2:4: this quote is not closed", "close"),
    ("a: *x\n", "1:4: the anchor of this alias is not defined", "value"),
    ("a: @x\n", "1:4: a value cannot start with @", "quotes"),
    ("- a\nb: 1\n", "2:1: this line", "indent"),
    ("a:\n  - 1\n 2\n", "3:2: this line does not match the indentation", "indent"),
    ("a: }\n", "1:4: a value is missing", "write a value"),
    ("a: - b\n", "1:4: a list cannot start here", "new line"),
    ("a: 1\n---\nb: 1\n", "2:1: a second document", "one document"),
    ("", "1:1: the file is empty", "key: value"),
    ("# nothing\n", "1:1: the file is empty", "key: value"),
    ("- a\n", "1:1: the file is not a mapping", "key: value"),
    ("a: >5x\n", "1:6: this is not YAML (", "correct"),
]


@pytest.fixture(params=["CSafeLoader", "SafeLoader"])
def loader(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    # where PyYAML was built without libyaml, the same file must give the same answer
    monkeypatch.setattr(document, "_Loader", getattr(yaml, request.param))


@pytest.mark.usefixtures("loader")
@pytest.mark.parametrize(("text", "what", "mend"), WRONG)
def test_a_syntax_error_is_one_problem_in_plain_words(text: str, what: str, mend: str) -> None:
    (problem,) = desk.refusals(text)
    assert problem.startswith(f"robot.yaml:{what}")
    assert mend in problem.split("; ", 1)[1]


@pytest.mark.usefixtures("loader")
def test_quotes_decide_between_text_and_number() -> None:
    tree = document.parse("a: 5\nb: '5'\nc: \"5\"\nd: |\n  5\n", "f")
    assert grow(tree, "f", literal).data == {"a": 5, "b": "5", "c": "5", "d": "5\n"}


@pytest.mark.parametrize(
    ("name", "what"),
    [
        ("none.yaml", "file not found"),
        (".", "this is a directory"),
        ("pipe", "this is not a regular file"),
        ("\0", "cannot be read"),
        ("x" * 300, "cannot be read"),
    ],
    ids=lambda text: text[:9].replace("\0", "zero"),
)
def test_what_is_no_file_is_refused(name: str, what: str) -> None:
    os.mkfifo("pipe")
    (problem,) = desk.caught(lambda: read_robot(Path.cwd() / name, {}))
    assert what in problem


def test_other_encodings_and_control_characters_are_refused_where_they_stand() -> None:
    assert desk.refusals("a: 1\nb: é\n".encode("latin-1")) == [
        "robot.yaml:2:4: the byte 0xe9 is not UTF-8; save the file as UTF-8"
    ]
    assert desk.refusals("é: 1\nb: x\0\n") == [
        "robot.yaml:2:5: the character U+0000 is not allowed in YAML; remove it"
    ]


def test_a_byte_order_mark_and_other_line_ends_are_read() -> None:
    path = desk.write(b"\xef\xbb\xbf" + TORSO.replace("\n", "\r\n").encode())
    description = read_robot(path, {})
    assert description.marks.value("joints", "elbow", "id") == Mark(str(path), 12, 26)


def test_duplicate_merge_empty_and_compound_keys_are_refused_together() -> None:
    text = TORSO + "recording: {}\n<<: {a: 1}\n? [a, b]\n: 1\n'': 2\n${rate}: 3\n'<<': 4\n"
    assert [refusal.partition("; known keys: ")[0] for refusal in desk.refusals(text)] == [
        "robot.yaml:18:1: recording is already defined in line 17; keep one of the two",
        "robot.yaml:19:1: the merge key << is not YAML 1.2; put shared keys of joints in joint_defaults or "
        "groups, and shared sections in an include",
        "robot.yaml:20:3: a mapping or a list cannot be a key; write a name before the ':'",
        "robot.yaml:22:1: a key is empty; write a name before the ':'",
        "robot.yaml:23:1: a key cannot contain ${...}; write the key",
        "robot.yaml:24:1: the file has an unknown key '<<'; remove it",
    ]


def test_an_anchor_may_be_used_and_stands_where_it_was_written() -> None:
    grown = grow(document.parse("a: &x {b: 1}\nc: *x\n", "f"), "f", literal)
    assert grown.data == {"a": {"b": 1}, "c": {"b": 1}}
    assert grown.marks.value("c", "b") == Mark("f", 1, 11)


@pytest.mark.usefixtures("loader")
def test_an_anchor_bomb_is_refused_before_it_grows(monkeypatch: pytest.MonkeyPatch) -> None:
    # the true limit takes seconds to reach
    monkeypatch.setattr("dxlrun.description.document.MOST_NODES", 10_000)
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 20)]
    (problem,) = desk.refusals("\n".join(lines))
    assert "after its aliases are expanded" in problem


@pytest.mark.usefixtures("loader")
def test_an_endless_anchor_is_refused() -> None:
    (problem,) = desk.refusals("a: &x [*x]\n")
    assert "an anchor contains itself" in problem


@pytest.mark.usefixtures("loader")
@pytest.mark.parametrize(
    "text", ["[" * 50_000, "a: " + "{x: " * 40, "\n".join(" " * i + "x:" for i in range(500))]
)
def test_depth_is_limited_before_anything_recurses(text: str) -> None:
    (problem,) = desk.refusals(text)
    # PyYAML 6.0.4 has a limit of its own, too
    assert re.search("nested deeper than 32 levels|exceeded maximum nesting depth", problem)


def test_size_and_number_of_values_are_limited() -> None:
    (large,) = desk.refusals("#" * (1 << 20) + "\n")
    assert "larger than 1024 KiB" in large
    (many,) = desk.refusals("a: [" + "1, " * 210_000 + "]")
    assert "more than 200000 values" in many


@settings(max_examples=150, deadline=None)
@given(st.text(alphabet="ab:-[]{}&*!'\"|>#%@ \n\t,?${}<01~.", max_size=60))
def test_any_text_gives_a_tree_or_refusals(text: str) -> None:
    try:
        grown = grow(document.parse(text, "f"), "f", literal)
    except InputError as error:
        refused = error.problems
    else:
        refused = ()
    if refused:
        assert {problem.mark.file for problem in refused} == {"f"}
        return
    lines = text.split("\n")
    for mark in (*grown.marks.values.values(), *grown.marks.keys.values()):
        assert 1 <= mark.line <= len(lines) + 1
        assert mark.column >= 1


@settings(max_examples=100, deadline=None)
@given(st.dictionaries(st.from_regex(r"[a-z]{1,8}", fullmatch=True), st.recursive(
    st.one_of(st.booleans(), st.integers(-999, 999), st.text("xyz ", max_size=5)),
    lambda inner: st.one_of(st.lists(inner, max_size=3), st.dictionaries(st.text("abc", min_size=1), inner, max_size=3)),
    max_leaves=10), min_size=1, max_size=4))  # fmt: skip
def test_what_a_foreign_writer_wrote_reads_back_with_marks_at_the_values(data: dict[str, object]) -> None:
    text = yaml.safe_dump(data)
    grown = grow(document.parse(text, "f"), "f", literal)
    assert grown.data == data
    lines = text.split("\n")
    for path, mark in grown.marks.values.items():
        value: object = data
        for step in path:
            value = value[step]  # type: ignore[index]  # the path exists, as the values are equal
        if isinstance(value, int):
            assert plain_value(lines[mark.line - 1][mark.column - 1 :].split(",")[0].strip("]} ")) == value


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
