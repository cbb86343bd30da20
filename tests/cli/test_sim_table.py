"""The live table of `dxlrun sim`, and the letters that are typed below it."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from io import StringIO

import pytest
from msgspec.structs import replace
from rich.console import Console

from dxlrun.cli.sim.sim_views import SimulationView, TableView, page
from dxlrun.run.simulation_front import TypedLines
from dxlsim.messages import ServoLook, SimulationMessage

FIRST = ServoLook("main", 1, "XL430-W250", True, math.pi, math.pi / 2, 31.4, 11.94, 0, heard=101, answered=1)


def look(count: int, **lateness: float) -> SimulationMessage:
    second = {"torque": False, "goal": None, "error": 0x20}
    servos = [
        replace(FIRST, id=each, heard=100 + each, answered=each, **(second if each == 2 else {}))
        for each in range(1, count + 1)
    ]
    return SimulationMessage(servos=tuple(servos), lateness_us=lateness)


def drawn(
    shown: SimulationMessage, typed: str = "", width: int = 100, height: int = 24, *, several: bool = False
) -> list[str]:
    file = StringIO()
    console = Console(file=file, width=width, height=height)
    console.print(page(shown, typed, width, height, several=several))
    return [line.rstrip() for line in file.getvalue().splitlines()]


def test_row_has_the_state_of_a_servo() -> None:
    head, _, first, second, *_ = drawn(look(2))
    names = "ID model torque goal deg present deg degC V errors asked replies"
    assert head.split() == names.split()
    assert first.split() == ["1", "XL430-W250", "on", "180.0", "90.0", "31", "11.9", "-", "101", "1"]
    assert second.split() == ["2", "XL430-W250", "limp", "-", "90.0", "31", "11.9", "0x20", "102", "2"]
    assert drawn(look(1), several=True)[2].split()[:3] == ["main", "1", "XL430-W250"]


def test_eighty_columns_hold_it_whole() -> None:
    named = replace(FIRST, bus="left_arm", model="YM070-210-M001", heard=123456, answered=123456)
    lines = "".join(drawn(SimulationMessage(servos=(named,)), width=80, several=True))
    assert "\N{HORIZONTAL ELLIPSIS}" not in lines
    assert "left_arm" in lines


def test_what_is_typed_is_below_and_a_low_window_keeps_it() -> None:
    *_, late, prompt = drawn(look(1, median=12.0), "lose servo=3")
    assert late == "replies later than planned: median 12 us"
    assert prompt.startswith("fault> lose servo=3")
    lines = drawn(look(40), "lose", height=12)
    assert len(lines) < 12
    assert "... and 35 more; enlarge the window to see them" in lines
    assert lines[-1].startswith("fault> lose")


def test_table_is_drawn_again_below_each_printed_line() -> None:
    file = StringIO()
    view = TableView(
        SimulationView("torso", (), {}), Console(file=file, force_terminal=True, width=80, height=20)
    )
    line = "a line that is much wider than the window of eighty columns, so that it must be folded"
    messages = [
        SimulationMessage(happened=line),
        SimulationMessage(fault=line),
        SimulationMessage(error=line),
        SimulationMessage(ports={line: ""}),
    ]
    with view.showing():
        for message in messages:
            view.show_snapshot(look(2), "lose")
            before = file.tell()
            view.show_message(message)
            said = file.getvalue()[before:]
            assert said.index("folded") < said.index("XL430-W250") < said.index("lose")
        view.help()
        before = file.tell()
    assert "XL430-W250" in file.getvalue()[before:]
    assert "fault> " not in file.getvalue()[before:]  # no more input is taken


@pytest.fixture
def keyboard() -> Iterator[tuple[int, TypedLines]]:
    reader, writer = os.pipe()
    yield writer, TypedLines(reader)
    os.close(reader)


@pytest.mark.parametrize(
    ("letters", "lines", "pending"),
    [
        (b"lose servo=1\nreboot servo=2\nno", ["lose servo=1", "reboot servo=2"], "no"),
        (b"overlaod\x7f\x7f\x7foad servo=1\r", ["overload servo=1"], ""),
        (b"rubbish\x15help\n\n  \n", ["help"], ""),
        (b"lo\x1b[A\x1b[1;5Dse\x1bOP \xff\x00\n", ["lose \ufffd"], ""),
        (b"x" * 3000, [], "x" * 1024),
        (b"help", [], "help"),
    ],
)
def test_letters_become_lines_and_an_end_gives_what_was_not_finished(
    keyboard: tuple[int, TypedLines], letters: bytes, lines: list[str], pending: str
) -> None:
    writer, typed = keyboard
    os.write(writer, letters)
    assert typed.read_lines() == lines
    assert (typed.pending, typed.ended) == (pending, False)
    os.close(writer)
    rest = []
    while not typed.ended:
        rest += typed.read_lines()
    assert "".join(rest) == pending


def test_job_in_the_background_leaves_its_terminal_alone(
    keyboard: tuple[int, TypedLines], monkeypatch: pytest.MonkeyPatch
) -> None:
    writer, typed = keyboard
    assert typed.in_foreground  # a pipe may always be read
    for other, foreground in ((1, False), (0, True)):
        monkeypatch.setattr(os, "tcgetpgrp", lambda _, other=other: os.getpgrp() + other)
        assert typed.in_foreground is foreground
    os.close(writer)
