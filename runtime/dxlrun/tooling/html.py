"""HTML: the elements of a report in one self-contained file.

Each function returns an element of `xml.etree`; `document` joins them.

    from dxlrun.tooling import html

    top = html.header("Servos", "bioloid_torso", "", ["No servo responded."], good=False, key_numbers=[])
    section = html.section("servos", "Servos", [html.paragraph("ID 7: no response")])
    page = html.document("Servos", top, [section], html.footer("Made by dxlrun"), {"servos": 0})
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from dxlwire.faces import lazy_face

if TYPE_CHECKING:
    from dxlrun.output.html_tree import data as data
    from dxlrun.output.html_tree import document as document
    from dxlrun.output.html_tree import figure as figure
    from dxlrun.output.html_tree import folded as folded
    from dxlrun.output.html_tree import footer as footer
    from dxlrun.output.html_tree import header as header
    from dxlrun.output.html_tree import paragraph as paragraph
    from dxlrun.output.html_tree import script as script
    from dxlrun.output.html_tree import section as section
    from dxlrun.output.html_tree import table_element as table_element
else:
    __getattr__, __dir__ = lazy_face(__name__, __file__)
