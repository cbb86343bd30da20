"""HTML elements, built as a tree, so that a page is well-formed and every text is escaped."""

from __future__ import annotations

from collections.abc import Iterable
from xml.etree import ElementTree as ET
from xml.etree.ElementTree import Element

from dxlrun.output.table import Table

__all__ = ["Element", "clean", "figure", "paragraph", "section", "table_element"]


def section(name: str, title: str, parts: Iterable[Element]) -> Element:
    """Return a section under a heading."""
    element = Element("section", {"id": name})
    ET.SubElement(element, "h2").text = title
    element.extend(parts)
    return element


def paragraph(text: str, kind: str = "") -> Element:
    """Return a paragraph; `kind` is its class."""
    element = Element("p", {"class": kind} if kind else {})
    element.text = clean(text)
    return element


def figure(name: str, title: str, drawing: Element, caption: str) -> Element:
    """Return a drawing with its title above and its caption below."""
    element = Element("figure", {"id": name})
    ET.SubElement(element, "h3").text = clean(title)
    element.append(drawing)
    ET.SubElement(element, "figcaption").text = clean(caption)
    return element


def table_element(table: Table) -> Element:
    """Return a table with its title as caption; a table without column names gets names of rows only."""
    scroll = Element("div", {"class": "table"})
    element = ET.SubElement(scroll, "table")
    ET.SubElement(element, "caption").text = table.title
    if any(column.name for column in table.columns):
        row = ET.SubElement(ET.SubElement(element, "thead"), "tr")
        for column in table.columns:
            ET.SubElement(row, "th", {"scope": "col", "class": column.kind}).text = column.name
    body = ET.SubElement(element, "tbody")
    for cells in table.rows:
        row = ET.SubElement(body, "tr")
        for number, (column, cell) in enumerate(zip(table.columns, cells, strict=True)):
            tag, scope = ("th", {"scope": "row"}) if number == 0 else ("td", {})
            kind = column.kind if cell.tone == "plain" else f"{column.kind} {cell.tone}"
            indented = "sub " if cell.text.startswith(" ") else ""
            ET.SubElement(row, tag, {**scope, "class": indented + kind}).text = clean(cell.text.strip())
    return scroll


def clean(text: str) -> str:
    """Replace what no document may hold, such as the escape character in a text from a log."""
    return "".join(
        character if character.isprintable() or character == "\n" else "\N{REPLACEMENT CHARACTER}"
        for character in text
    )
