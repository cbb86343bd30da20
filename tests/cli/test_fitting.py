"""Tables that are wider than their terminal, and colours where there is no terminal."""

import io
import json

import pytest
from rich.console import Console

from dxlrun.output.graph import Graph, Node
from dxlrun.output.html_tree import table_element
from dxlrun.output.terminal import print_error, print_warning, show_json, show_parts
from dxlrun.output.text_table import Cell, Column, Sentence, Table

SERVOS = Table.from_rows(
    "",
    [
        Column("ID"),
        Column("model", "name"),
        Column("return delay", form="{} us"),
        Column("firmware", detail=True),
        Column("remark", "text"),
    ],
    [
        (1, "XM430-W350", 500, 52, "its supply is a little low"),
        (2, Cell("AX-12A", "error"), None, 24, None),
    ],
)
SHOWN = {
    80: """\
ID  model       return delay  firmware  remark
----
 1  XM430-W350        500 us        52  its supply is a little low
 2  AX-12A                          24""",
    58: """\
              return
ID model       delay firmware remark
----
 1 XM430-W350 500 us       52 its supply is a little low
 2 AX-12A                  24""",
    49: """\
              return
ID model       delay remark
----
 1 XM430-W350 500 us its supply is a little low
 2 AX-12A""",
    30: """\
ID 1: model XM430-W350,
  return delay 500 us,
  firmware 52, remark its
  supply is a little low
ID 2: model AX-12A, firmware
  24""",
}
"""The table at each width; ---- is a drawn line"""


def shown(*parts: Table | Graph | Sentence | str, width: int, terminal: bool = False) -> str:
    file, colours = io.StringIO(), "standard" if terminal else None
    console = Console(file=file, width=width, force_terminal=terminal, color_system=colours)  # type: ignore[arg-type]
    show_parts(*parts, console=console)
    return "\n".join(line.rstrip() for line in file.getvalue().splitlines())


@pytest.mark.parametrize("width", SHOWN)
def test_table_that_does_not_fit_becomes_paragraphs_in_which_nothing_is_cut(width: int) -> None:
    rule = {"\N{BOX DRAWINGS LIGHT HORIZONTAL}", " "}
    lines = ["----" if set(line) <= rule else line for line in shown(SERVOS, width=width).splitlines()]
    assert "\n".join(lines) == SHOWN[width]


def test_only_a_terminal_gets_colours() -> None:
    assert "\x1b[31m" in shown(SERVOS, Sentence("bad", "error"), width=80, terminal=True)
    assert "\x1b" not in shown(SERVOS, Sentence("bad", "error"), width=80)


HOSTILE = "\x1b]0;owned\x07\x1b[2J \x9b31m \u202egood\u202c \r\b \x7f \ud800"


def test_texts_of_plug_ins_have_no_effect_on_a_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    columns = [Column(HOSTILE, "name"), Column("b", "text")]
    table = Table.from_rows(HOSTILE, columns, [(HOSTILE, HOSTILE), ("a", "b")])
    texts = [shown(table, HOSTILE, Sentence(HOSTILE), width=width) for width in (40, 80, 200)]
    texts.append(shown(Graph(HOSTILE, (Node("a", "controller", (HOSTILE,)),), ()), width=200))
    print_error(HOSTILE)
    print_warning(HOSTILE)
    show_json({HOSTILE: HOSTILE}, code=1, errors=[HOSTILE])
    said = capsys.readouterr()
    for text in (*texts, said.out, said.err):
        assert all(character.isprintable() or character == "\n" for character in text), ascii(text)
    assert r"\x1b]0;owned\x07\x1b[2J \x9b31m \u202egood" in texts[2]
    answer = json.loads(said.out)
    assert (answer["result"], answer["errors"][0]["what"]) == ({HOSTILE: HOSTILE}, HOSTILE.partition("; ")[0])
    page = "".join(table_element(table).itertext())
    assert r"\x1b[2J \x9b31m \u202egood" in page
    assert "\x1b" not in page
