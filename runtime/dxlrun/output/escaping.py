"""Escaping: texts of plug-ins, logs and files as a terminal or a page shows them, without effect on it."""

from __future__ import annotations

import json


def escaped_json(text: str) -> str:
    """Return JSON with an escape for all that no terminal should get, of which JSON leaves some as it is."""
    if text.isprintable():
        return text
    return "".join(
        one if one.isprintable() or one == "\n" else json.dumps(one, ensure_ascii=True)[1:-1] for one in text
    )


def escaped(text: str) -> str:
    """Return a text of anything, such as a plug-in, as it is shown: control characters and what turns the
    direction of writing are written out, `\\x1b`, but for the ends of lines."""
    if text.isprintable():
        return text
    return "".join(
        one if one.isprintable() or one == "\n" else one.encode("unicode_escape").decode() for one in text
    )
