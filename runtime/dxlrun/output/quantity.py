"""Quantity: values of sources for people: numbers with SI units, and names with their units."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import groupby

_TEXTS = {"degC": "deg C", "1": ""}
"""Units with another spelling than in control tables; a fraction has none."""


def quantity_text(value: float | None, unit: str = "", *, digits: int = 6) -> str:
    """Format a number with its unit: `0.25 rad/s`; `-` when unknown.

    Args:
        value: Number in SI; None when unknown.
        unit: SI unit; empty without one.
        digits: Significant digits.
    """
    if value is None:
        return "-"
    return f"{value:.{digits}g} {unit_text(unit)}".rstrip()


def unit_text(unit: str) -> str:
    """Format an SI unit: `rad/s`, `deg C`; empty for a fraction."""
    return _TEXTS.get(unit, unit)


def names_with_units(names: Iterable[str], units: Mapping[str, str]) -> str:
    """Format names of values; adjacent ones with a common unit share it: `x, y (rad/s); voltage (V)`.

    Args:
        names: Names of values.
        units: SI units by name, for values that have one.
    """
    groups = (
        (unit_text(unit), ", ".join(group))
        for unit, group in groupby(names, lambda name: units.get(name, ""))
    )
    return "; ".join(f"{group} ({unit})" if unit else group for unit, group in groups)
