"""Numbers with their nouns, as a person writes them."""

from __future__ import annotations


def counted(number: int, one: str, many: str) -> str:
    """Return `1 period`, `2 periods`: one form for exactly one, the other for all else, none included."""
    return f"{number} {one if number == 1 else many}"
