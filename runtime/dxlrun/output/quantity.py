"""Values of sources as people read them: a number with its SI unit, and names with their units."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import groupby

_TEXTS = {"degC": "deg C", "1": ""}
"""Units that people write in another way than control tables; a fraction has none."""


def quantity_text(value: float | None, unit: str = "", *, digits: int = 6) -> str:
    """Write a number with its unit: `0.25 rad/s`; `-` where it is not known.

    Args:
        value: Number in SI; None if it is not known.
        unit: SI unit; empty if it has none.
        digits: Significant digits.
    """
    if value is None:
        return "-"
    return f"{value:.{digits}g} {unit_text(unit)}".rstrip()


def unit_text(unit: str) -> str:
    """Write an SI unit: `rad/s`, `deg C`; empty for a fraction."""
    return _TEXTS.get(unit, unit)


def names_with_units(names: Iterable[str], units: Mapping[str, str]) -> str:
    """Write names of values; those in a row that share a unit have it together: `x, y (rad/s); voltage (V)`.

    Args:
        names: Names of values.
        units: SI unit of each value that has one, by its name.
    """
    groups = (
        (unit_text(unit), ", ".join(group))
        for unit, group in groupby(names, lambda name: units.get(name, ""))
    )
    return "; ".join(f"{group} ({unit})" if unit else group for unit, group in groups)
