"""Quantity text: formats numbers with SI units, and names of values with their units."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import groupby

_TEXTS = {"degC": "deg C", "1": ""}
"""Units that are written differently for people than in control tables; a fraction has none."""


def quantity_text(value: float | None, unit: str = "", *, digits: int = 6) -> str:
    """Format a number with its unit: `0.25 rad/s`; `-` if the value is None.

    Args:
        value: Number in SI; None when unknown.
        unit: SI unit; empty without one.
        digits: Significant digits.
    """
    if value is None:
        return "-"
    return f"{value:.{digits}g} {unit_text(unit)}".rstrip()


def unit_text(unit: str) -> str:
    """Format an SI unit for people: `rad/s`, `deg C`; empty for a fraction."""
    return _TEXTS.get(unit, unit)


def names_with_units(names: Iterable[str], units: Mapping[str, str]) -> str:
    """Join names of values with their units; neighbours share one: `x, y (rad/s); voltage (V)`.

    Args:
        names: Names of values.
        units: SI units by name, for values that have one.
    """
    groups = (
        (unit_text(unit), ", ".join(group))
        for unit, group in groupby(names, lambda name: units.get(name, ""))
    )
    return "; ".join(f"{group} ({unit})" if unit else group for unit, group in groups)
