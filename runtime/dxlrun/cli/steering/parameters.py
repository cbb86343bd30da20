"""`dxlrun parameters`: show or change the parameters of a controller in a run."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from msgspec import to_builtins

from dxlrun.cli.inputs import parse_pair
from dxlrun.cli.steering.steer import ONLY_ONE, RobotChoice, Words, connect_robot
from dxlrun.errors import InputError
from dxlrun.output.terminal import show_json, show_parts
from dxlrun.output.text_table import Column, Table
from dxlrun.remote.requests.replies import Parameter

_DURATIONS = ("s", 1e9), ("ms", 1e6), ("us", 1e3)


def parameters(controller: str, /, *words: Words, chosen: RobotChoice = ONLY_ONE) -> int:
    """Show the parameters of a controller, or change live ones: `dxlrun parameters arm gains.p=4.0`.

    All given parameters change in the same cycle, or none does.

    Parameters
    ----------
    controller
        Name of the controller.
    words
        New values of live parameters, as in the robot file. Quantities have units: 'speed=20 deg/s'.
    """
    values = dict(_pair(word) for word in words)
    if len(values) < len(words):
        raise InputError("a parameter is given twice; give each once")
    with connect_robot(chosen.robot, "parameters") as robot:
        if not values:
            rows = robot.parameter_table(controller)
            if chosen.as_json:
                show_json({"robot": robot.name, "controller": controller, "parameters": to_builtins(rows)})
            elif rows:
                show_parts(_table(rows))
            else:
                show_parts(f"{robot.name}: {controller} has no parameters")
            return 0
        changed = robot.set_parameters(controller, values)
        if chosen.as_json:
            shown = [{"name": name, "old": old, "new": new} for name, (old, new) in changed.items()]
            show_json({"robot": robot.name, "controller": controller, "changed": shown})
        else:
            for name, (old, new) in changed.items():
                show_parts(f"{robot.name}: {controller} {name}: {format_value(old)} -> {format_value(new)}")
    return 0


def _pair(word: str) -> tuple[str, bool | float | str]:
    from dxlrun.description.document import plain_value

    name, text = parse_pair(word, "gains.p=4.0")
    value = plain_value(text)
    return name, value if isinstance(value, bool | int | float) else text


def _table(rows: Sequence[Parameter]) -> Table:
    columns: list[tuple[Column, Callable[[Parameter], str]]] = [
        (Column("parameter", "name"), lambda row: row.name),
        (Column("value", "text"), lambda row: format_value(row.value)),
        (Column("in a run", "name"), lambda row: "live" if row.live else "fixed"),
        (Column("range", "text"), lambda row: row.range),
        (Column("description", "text", detail=True), lambda row: row.description),
    ]
    used = [(column, cell) for column, cell in columns if any(cell(row) for row in rows)]
    return Table.listing("", used, rows)


def format_value(value: object) -> str:
    """Return a parameter's value as text: numbers with six digits, times in a fitting unit."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, list):
        return f"[{', '.join(map(format_value, value))}]"
    if isinstance(value, dict):
        return f"{{{', '.join(f'{key}: {format_value(inner)}' for key, inner in value.items())}}}"
    if value is None:
        return ""
    number, _, unit = str(value).partition(" ")
    try:
        size = float(number)
    except ValueError:
        return str(value)
    if unit == "ns":
        size, unit = next(((size / ns, short) for short, ns in _DURATIONS if size >= ns), (size, "ns"))
        unit = unit if size else "s"
    return f"{size:.6g} {unit}".strip()
