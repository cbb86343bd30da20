"""Tables of texts: each event has a row with code, severity and text in the `texts.py` of its room."""

import ast
import inspect
import string
from pathlib import Path

import pytest
from tests.kit.loaded import loaded

from dxlrun.channels.answers import Code
from dxlrun.channels.event_records import EventCode, Severity, event_names, event_text

ROOT = Path(__file__).parents[1]
generate = loaded(ROOT / "docs/generate.py")
ROWS = generate.event_rows()
WITHOUT_TABLE = {"log/log_writer.py"}
"""Rooms with a single event."""
PRODUCT = sorted(
    path
    for base in ("runtime", "plugins")
    for path in (ROOT / base).rglob("*.py")
    if "tests" not in path.parts and "build" not in path.parts
)


@pytest.mark.parametrize(("file", "name", "row"), ROWS, ids=[f"{file}-{name}" for file, name, _ in ROWS])
def test_text_shows_every_field(file: str, name: str, row) -> None:
    text = generate.text_of(row)
    shown = {field for _, field, _, _ in string.Formatter().parse(text) if field}
    fields = {field.removesuffix("_ns") for field in inspect.signature(row.write).parameters}
    # a flag chooses the wording
    assert {field.removesuffix("_ns") for field in shown} == fields - {"catches_up"}


def test_rows_differ() -> None:
    rows = [(file, row.code, row.severity, generate.text_of(row)) for file, _, row in ROWS]
    passing = {text for *_, text in rows if text.startswith("{") and text.endswith("}")}
    repeated = {row for row in rows if rows.count(row) > 1 and row[-1] not in passing}
    assert repeated == set()
    assert len(rows) > 100


def calls(path: Path, name: str) -> list[str]:
    """Return the calls of a function in a file, as file:line."""
    text = path.read_text()
    found = [
        node
        for node in ast.walk(ast.parse(text if name in text else ""))  # most files are not worth parsing
        if isinstance(node, ast.Call) and getattr(node.func, "attr", getattr(node.func, "id", "")) == name
    ]
    return [f"{path.relative_to(ROOT)}:{node.lineno}" for node in found]


def test_rows_are_in_tables() -> None:
    outside = [
        call
        for path in PRODUCT
        if path not in generate.text_tables() and "/".join(path.parts[-2:]) not in WITHOUT_TABLE
        for call in calls(path, "event_text")
    ]
    assert outside == []


def test_only_rows_make_events() -> None:
    """No other place chooses a code or a severity."""
    bodies = [call for path in PRODUCT for call in calls(path, "EventBody")]
    assert len(bodies) == 1, bodies
    assert bodies[0].startswith("runtime/dxlrun/channels/event_records.py:")


def test_every_code_has_a_row() -> None:
    assert {*event_names()} == {row.code for _, _, row in ROWS}


def test_row_writes_its_text() -> None:
    @event_text(EventCode.SERVO_HOT, Severity.INFO)
    def sensor_hot(sensor: str, celsius: float) -> str:
        return f"sensor {sensor} is at {celsius:.0f} degC"

    assert sensor_hot("imu", celsius=41.7) == (EventCode.SERVO_HOT, Severity.INFO, "sensor imu is at 42 degC")
    assert generate.text_of(sensor_hot) == "sensor {sensor} is at {celsius} degC"


def refusals(path: Path) -> list[tuple[str, ast.Call]]:
    """Return the refusals that a file makes with literal fields, each with its code."""
    found, text = [], path.read_text()
    for node in ast.walk(ast.parse(text if "Code." in text else "")):
        if (
            isinstance(node, ast.Call)
            and getattr(node.func, "id", "") in {"Refusal", "refused"}
            and node.args
        ):
            code = node.args[0]
            if isinstance(code, ast.Attribute) and getattr(code.value, "id", "") == "Code":
                found.append((code.attr, node))
    return found


def test_refusals_have_the_fields_of_their_texts() -> None:
    wrong, seen = [], set()
    for path in PRODUCT:
        for name, call in refusals(path):
            seen.add(name)
            fields = {field for _, field, _, _ in string.Formatter().parse(Code[name].text) if field}
            given = call.args[1] if len(call.args) > 1 else ast.Dict([], [])
            if isinstance(given, ast.Dict) and not all(isinstance(key, ast.Constant) for key in given.keys):
                continue
            if isinstance(given, ast.Dict) and (missing := fields - {key.value for key in given.keys}):
                wrong.append(f"{path.relative_to(ROOT)}:{call.lineno}: {name} lacks {sorted(missing)}")
    assert wrong == []
    assert len(seen) > 30
