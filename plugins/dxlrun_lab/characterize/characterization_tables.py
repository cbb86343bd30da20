"""Result of `dxlrun characterize` as a table for each joint, and as JSON."""

from __future__ import annotations

import math
from collections.abc import Iterator

from dxlrun.tooling.output import Cell, Column, Part, Sentence, Table
from dxlrun_lab.characterize.joint_figure import JointFigure
from dxlrun_lab.characterize.procedure import CharacterizationResult, JointCharacteristics

_SHOWN = {"rad": ("deg", math.degrees(1.0)), "s": ("ms", 1e3)}
"""Units of the tables by SI unit, with the factor. The JSON output has SI units."""


def results(found: CharacterizationResult) -> dict[str, object]:
    """Return the content of the JSON output of `dxlrun characterize`, in SI units; angles in rad."""
    return {
        "robot": found.robot,
        "complete": not found.why,
        "why": found.why,
        "tolerance": found.tolerance,
        "joints": [
            {
                "joint": one.joint.name,
                "servo": one.joint.plan.label,
                "model": one.joint.servo.model,
                "range": (one.joint.lower, one.joint.upper),
                "figures": one.figures,
                "rates": one.rates,
                "gaps": one.gaps,
            }
            for one in found.joints
        ],
    }


def parts(found: CharacterizationResult) -> Iterator[Part]:
    """Yield the terminal output: a table for each joint, and why figures were not measured."""
    for joint in found.joints:
        yield table(joint)
        for one in joint.figures:
            if one.value is None:
                yield Sentence(f"{one.name} is not measurable: {one.why}", "warning")
    if found.why:
        yield Sentence(f"the experiment ended early: {found.why}", "error")


def table(found: JointCharacteristics) -> Table:
    """Return the table of a joint, one row per figure."""
    joint = found.joint
    lower, upper = math.degrees(joint.lower), math.degrees(joint.upper)
    columns = (
        Column("figure", "name"),
        Column("value"),
        Column("95 %"),
        Column("spread"),
        Column("measured by", "text"),
        Column("limit or cause", "text"),
    )
    rows = (
        (
            one.name,
            Cell("-", "warning") if one.value is None else format_figure(one),
            shown_uncertainty(one),
            "" if one.spread is None else _number(one.spread * _factor(one)),
            one.how,
            one.limit,
        )
        for one in found.figures
    )
    title = f"{joint.plan.label}, {joint.servo.model}, within {lower:.4g} to {upper:.4g} deg"
    return Table.from_rows(title, columns, rows)


def format_figure(one: JointFigure) -> str:
    """Format a figure: `21.4 ms`, or `below 3 ms` if its interval contains 0."""
    if one.value is None:
        return "-"
    if one.near_zero:
        return f"below {_number((abs(one.value) + (one.uncertainty or 0.0)) * _factor(one))} {unit_of(one)}"
    return f"{_number(one.value * _factor(one))} {unit_of(one)}"


def shown_uncertainty(one: JointFigure) -> str:
    """Format the uncertainty of a figure: `± 0.8`, or an empty text if the figure is an upper bound."""
    known = one.value is not None and one.uncertainty is not None and not one.near_zero
    return f"± {_number((one.uncertainty or 0.0) * _factor(one))}" if known else ""


def unit_of(one: JointFigure) -> str:
    """Return the unit of a figure in tables."""
    return _SHOWN.get(one.unit, (one.unit, 1.0))[0]


def _factor(one: JointFigure) -> float:
    return _SHOWN.get(one.unit, (one.unit, 1.0))[1]


def _number(value: float) -> str:
    return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}"  # three digits either way
