"""The pages of the documentation; their names are unique, so a test names a page and not its folder."""

from __future__ import annotations

from pathlib import Path

DOCS = Path(__file__).parents[2] / "docs"
PATHS = {path.name: path for path in sorted(DOCS.rglob("*.md")) if path.parent.name != "changes"}


def page_text(name: str) -> str:
    """Return the text of a page."""
    return PATHS[name].read_text()
