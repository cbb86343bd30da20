"""Escaping: replaces control characters in foreign texts before they reach a terminal or a page."""

from __future__ import annotations

import json


def escaped_json(text: str) -> str:
    """Replace unprintable characters in a JSON text by JSON escapes, except for line ends."""
    if text.isprintable():
        return text
    return "".join(
        one if one.isprintable() or one == "\n" else json.dumps(one, ensure_ascii=True)[1:-1] for one in text
    )


def escaped(text: str) -> str:
    """Replace control characters and direction marks in a text by visible escapes such as `\\x1b`.

    Line ends are kept.
    """
    if text.isprintable():
        return text
    return "".join(
        one if one.isprintable() or one == "\n" else one.encode("unicode_escape").decode() for one in text
    )
