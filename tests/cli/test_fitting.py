"""Tables that are wider than their terminal, and colours where there is no terminal."""

from __future__ import annotations

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


def shown(*parts: Table | Sentence | str, width: int, terminal: bool = False) -> str:
    console = Console(
        file=io.StringIO(),
        width=width,
        force_terminal=terminal,
        color_system="standard" if terminal else None,
    )
    show_parts(*parts, console=console)
    text: str = console.file.getvalue()  # type: ignore[attr-defined]  # a StringIO, given above
    return "\n".join(line.rstrip() for line in text.splitlines())


@pytest.mark.parametrize(
    ("width", "expected"),
    [
        (
            80,
            "ID  model       return delay  firmware  remark\n"
            "----\n"
            " 1  XM430-W350        500 us        52  its supply is a little low\n"
            " 2  AX-12A                          24",
        ),
        (
            58,
            "              return\n"
            "ID model       delay firmware remark\n"
            "----\n"
            " 1 XM430-W350 500 us       52 its supply is a little low\n"
            " 2 AX-12A                  24",
        ),
        (
            49,
            "              return\n"
            "ID model       delay remark\n"
            "----\n"
            " 1 XM430-W350 500 us its supply is a little low\n"
            " 2 AX-12A",
        ),
        (
            30,
            "ID 1: model XM430-W350,\n"
            "  return delay 500 us,\n"
            "  firmware 52, remark its\n"
            "  supply is a little low\n"
            "ID 2: model AX-12A, firmware\n"
            "  24",
        ),
    ],
)
def test_a_table_that_does_not_fit_becomes_paragraphs_in_which_nothing_is_cut(
    width: int, expected: str
) -> None:
    lines = shown(SERVOS, width=width).splitlines()
    rule = {"\N{BOX DRAWINGS LIGHT HORIZONTAL}", " "}
    ruled = ["----" if set(line) <= rule else line for line in lines]
    assert "\n".join(ruled) == expected


def test_a_long_text_is_folded_between_words() -> None:
    table = Table.from_rows(
        "Events", [Column("event", "name"), Column("text", "text")], [("SETUP", "word " * 20)]
    )
    lines = shown(table, width=50).splitlines()
    assert lines[:2] == ["", "Events"]
    assert max(map(len, lines)) <= 50
    assert " ".join(lines).split().count("word") == 20


def test_a_row_needs_a_value_for_each_column() -> None:
    with pytest.raises(ValueError, match="zip"):
        Table.from_rows("", [Column("ID"), Column("model")], [(1,)])


def test_only_a_terminal_gets_colours() -> None:
    assert "\x1b[31m" in shown(SERVOS, Sentence("bad", "error"), width=80, terminal=True)
    assert "\x1b" not in shown(SERVOS, Sentence("bad", "error"), width=80)


HOSTILE = "\x1b]0;owned\x07\x1b[2J \x9b31m \u202egood\u202c \r\b \x7f \ud800"


def test_texts_of_plug_ins_have_no_effect_on_a_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    table = Table.from_rows(
        HOSTILE, [Column(HOSTILE, "name"), Column("b", "text")], [(HOSTILE, HOSTILE), ("a", "b")]
    )
    graph = Graph(HOSTILE, (Node("a", "controller", (HOSTILE,)),), ())
    texts = [shown(table, HOSTILE, Sentence(HOSTILE), width=width) for width in (40, 80, 200)]
    texts.append(shown(graph, width=200))  # type: ignore[arg-type]  # a part like the others
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
