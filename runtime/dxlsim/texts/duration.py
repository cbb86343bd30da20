"""Durations in text form, such as `500 us` or `2 s`; splits quantities with any unit."""

from __future__ import annotations

import re
from collections.abc import Mapping
from fractions import Fraction
from types import MappingProxyType

DURATION_NS: Mapping[str, int] = MappingProxyType(
    {"ns": 1, "us": 10**3, "ms": 10**6, "s": 10**9, "min": 60 * 10**9, "h": 3600 * 10**9}
)
LONGEST_NS = 10**9 * DURATION_NS["s"]  # 31 years; the sum of a few such durations fits into 64 bits
LONGEST_QUANTITY = 64  # Characters

# At most three digits of exponent: Fraction("1e-999999999") would fill the memory.
_QUANTITY = re.compile(
    r"([-+]?(?:\d+(?:_\d+)*)?(?:\.\d*)?(?:[eE][-+]?\d{1,3})?)\s*([A-Za-z/^0-9% ]*)", re.ASCII
)


def split_quantity(text: str) -> tuple[str, str] | None:
    """Split a quantity into number and unit, such as `("1.5", "ms")`; return None for another text."""
    match = _QUANTITY.fullmatch(text.strip()) if len(text) <= LONGEST_QUANTITY else None
    number = match[1].replace("_", "") if match else ""
    if match is None or not any(character.isdigit() for character in number.split("e")[0].split("E")[0]):
        return None
    return number, match[2]


def nanoseconds(number: str, unit: str) -> int | None:
    """Return a duration, given as number and unit of `DURATION_NS`, in ns, or None if it is not from 0 s
    to 31 years."""
    duration_ns = round(Fraction(number) * DURATION_NS[unit])  # Exact: 0.1 ms is 100000 ns
    return duration_ns if 0 <= duration_ns <= LONGEST_NS else None


def parse_duration(text: str) -> int:
    """Return a duration, ns.

    Raises:
        ValueError: The text is not a duration from 0 s to 31 years.

    >>> parse_duration("1.5 ms")
    1500000
    """
    number, unit = split_quantity(text) or ("", "")
    duration_ns = nanoseconds(number, unit) if unit in DURATION_NS else None
    if duration_ns is None:
        raise ValueError(f"{text!r} is not a duration from 0 s to 31 years")
    return duration_ns
