"""Escaping: makes texts of plug-ins, logs and files harmless to a terminal or a page."""

from __future__ import annotations

import json


def escaped_json(text: str) -> str:
    """Return JSON with escapes for all unprintable characters, some of which JSON allows unescaped."""
    if text.isprintable():
        return text
    return "".join(
        one if one.isprintable() or one == "\n" else json.dumps(one, ensure_ascii=True)[1:-1] for one in text
    )


def escaped(text: str) -> str:
    """Return a text with control characters and changes of the writing direction escaped: `\\x1b`.

    Line ends are kept.
    """
    if text.isprintable():
        return text
    return "".join(
        one if one.isprintable() or one == "\n" else one.encode("unicode_escape").decode() for one in text
    )
