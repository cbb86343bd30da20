"""HTML: builds report pages as element trees, so that all text is escaped and no tag stays open.

A page contains its style and numbers, and loads no external resources. Its figures are SVG in the colours of
`page.css`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from xml.etree import ElementTree as ET
from xml.etree.ElementTree import Element

from dxlrun.output.escaping import escaped
from dxlrun.output.json import json_text
from dxlrun.output.text_table import Table

_STYLE_SHEET = Path(__file__).with_name("page.css")


def document(  # noqa: PLR0917  what the page has, from top to bottom
    title: str,
    top: Element,
    sections: Sequence[Element],
    end: Element,
    numbers: object,
    scripts: Iterable[Element] = (),
) -> str:
    """Return a whole page as HTML text: header, contents, non-empty sections, footer, scripts.

    `numbers` are embedded as JSON, in the element with the identifier `report`.
    """
    html = Element("html", {"lang": "en"})
    head = ET.SubElement(html, "head")
    ET.SubElement(head, "meta", {"charset": "utf-8"})
    ET.SubElement(head, "meta", {"name": "viewport", "content": "width=device-width, initial-scale=1"})
    ET.SubElement(head, "meta", {"name": "color-scheme", "content": "light dark"})
    ET.SubElement(head, "title").text = escaped(title)
    ET.SubElement(head, "style").text = _STYLE_SHEET.read_text(encoding="utf-8")
    head.append(data(json_text(numbers), "report"))
    body = ET.SubElement(html, "body")
    body.append(top)
    full = [part for part in sections if len(part) > 1 or len(part[0]) > 1]
    body.append(_contents(full))
    ET.SubElement(body, "main").extend(full)
    body.append(end)
    body.extend(scripts)
    return "<!DOCTYPE html>\n" + ET.tostring(html, encoding="unicode", method="html") + "\n"


def data(text: str, name: str) -> Element:
    """Return a script element that embeds JSON text in a page; `name` is its id."""
    element = Element("script", {"type": "application/json", "id": name})
    # Escape `<`, so that no text ends the element.
    element.text = text.replace("<", "\\u003c")
    return element


def script(text: str) -> Element:
    """Return an element with JavaScript. Raises ValueError if the text contains `</script`."""
    if "</script" in text.lower():
        raise ValueError("a script must not have the end of an element in it")
    element = Element("script")
    element.text = text
    return element


def header(  # noqa: PLR0917  what stands there, from top to bottom
    title: str,
    subtitle: str,
    verdict: str,
    sentences: Iterable[str | tuple[str, str, str]],
    good: bool,
    key_numbers: Iterable[tuple[str, str]],
) -> Element:
    """Return the header element of a report: title, verdict in sentences, and a few key numbers.

    A sentence may be a tuple with its remedy, which follows in bold, and the identifier of its figure.
    Remedy, identifier and verdict may be empty.
    """
    element = Element("header")
    ET.SubElement(element, "h1").text = escaped(title)
    element.append(paragraph(subtitle, "when"))
    kind = f"verdict {'good' if good else 'look'}"
    box = ET.SubElement(element, "section", {"class": kind, "id": "verdict"})
    if verdict:
        ET.SubElement(box, "h2").text = escaped(verdict)
    for one in sentences:
        sentence, remedy, shown = (one, "", "") if isinstance(one, str) else one
        box.append(paragraph(f"{sentence} " if remedy or shown else sentence))
        for tag, text, about in (("strong", remedy, {}), ("a", shown and "Plot", {"href": f"#{shown}"})):
            if text:
                ET.SubElement(box[-1], tag, about).text = escaped(text)
                box[-1][-1].tail = " "
    strip = ET.SubElement(element, "dl", {"class": "key"})
    for name, value in key_numbers:
        group = ET.SubElement(strip, "div")
        ET.SubElement(group, "dt").text = escaped(name)
        ET.SubElement(group, "dd").text = escaped(value)
    return element


def footer(text: str) -> Element:
    """Return the footer element of a page, with a text about its source."""
    element = Element("footer")
    element.append(paragraph(text))
    return element


def _contents(sections: Sequence[Element]) -> Element:
    nav = Element("nav", {"aria-label": "contents"})
    for part in sections:
        link = ET.SubElement(nav, "a", {"href": f"#{part.get('id')}"})
        link.text = part.findtext(".//h2")
    return nav


def section(name: str, title: str, parts: Iterable[Element]) -> Element:
    """Return a section element with a heading; `name` is its id."""
    element = Element("section", {"id": name})
    ET.SubElement(element, "h2").text = title
    element.extend(parts)
    return element


def folded(name: str, title: str, parts: Iterable[Element]) -> Element:
    """Return a section element that stays folded until its heading is clicked or a link leads into it."""
    element = section(name, title, ())
    details = ET.SubElement(element, "details")
    ET.SubElement(details, "summary").append(element[0])
    element.remove(element[0])
    details.extend(parts)
    return element


def paragraph(text: str, kind: str = "") -> Element:
    """Return a paragraph element; `kind` is its CSS class."""
    element = Element("p", {"class": kind} if kind else {})
    element.text = escaped(text)
    return element


def figure(name: str, title: str, drawing: Element, caption: str) -> Element:
    """Return a figure element: an SVG drawing with optional title and caption; `name` is its id."""
    element = Element("figure", {"id": name})
    if title:
        ET.SubElement(element, "h3").text = escaped(title)
    element.append(drawing)
    if caption:
        ET.SubElement(element, "figcaption").text = escaped(caption)
    return element


def table_element(table: Table) -> Element:
    """Return the HTML element of a table, with its title as caption and without a head if it has no names."""
    scroll = Element("div", {"class": "table"})
    element = ET.SubElement(scroll, "table")
    table = table.escaped()
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
            ET.SubElement(row, tag, {**scope, "class": indented + kind}).text = cell.text.strip()
    return scroll
