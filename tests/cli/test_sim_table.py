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


def look(count: int, **changes: float) -> SimulationMessage:
    servos = [
        ServoLook(
            bus="main",
            id=each,
            model="XL430-W250",
            torque=each == 1,
            goal=None if each == 2 else math.pi,
            present=math.pi / 2,
            temperature=31.4,
            voltage=11.94,
            error=0x20 if each == 2 else 0,
            heard=100 + each,
            answered=each,
        )
        for each in range(1, count + 1)
    ]
    return SimulationMessage(servos=tuple(servos), lateness_us=changes)


def drawn(shown: SimulationMessage, typed: str = "", height: int = 24, *, several: bool = False) -> list[str]:
    file = StringIO()
    Console(file=file, width=100, height=height).print(page(shown, typed, 100, height, several=several))
    return [line.rstrip() for line in file.getvalue().splitlines()]


def test_a_row_has_the_state_of_a_servo():
    head, _, first, second, *_ = drawn(look(2))

    assert head.split() == [
        *("ID", "model", "torque", "goal", "deg", "present", "deg", "degC", "V", "errors", "asked", "replies")
    ]
    assert first.split() == ["1", "XL430-W250", "on", "180.0", "90.0", "31", "11.9", "-", "101", "1"]
    assert second.split() == ["2", "XL430-W250", "limp", "-", "90.0", "31", "11.9", "0x20", "102", "2"]


def test_eighty_columns_hold_it_whole():
    named = replace(look(1).servos[0], bus="left_arm", model="YM070-210-M001", heard=123456, answered=123456)
    file = StringIO()
    Console(file=file, width=80).print(page(SimulationMessage(servos=(named,)), "", 80, 24, several=True))

    assert "\N{HORIZONTAL ELLIPSIS}" not in file.getvalue()
    assert "left_arm" in file.getvalue()


def test_buses_are_named_where_there_are_several():
    assert drawn(look(1), several=True)[2].split()[:3] == ["main", "1", "XL430-W250"]


def test_what_is_typed_stands_below():
    *_, late, prompt = drawn(look(1, median=12.0), "lose servo=3")

    assert late == "replies later than planned: median 12 us"
    assert prompt.startswith("fault> lose servo=3")


def test_a_low_window_keeps_the_prompt():
    lines = drawn(look(40), "lose", height=12)

    assert len(lines) < 12
    assert "... and 35 more; enlarge the window to see them" in lines
    assert lines[-1].startswith("fault> lose")


def test_the_table_is_drawn_again_below_each_printed_line():
    file = StringIO()
    console = Console(file=file, force_terminal=True, width=80, height=20)
    view = TableView(SimulationView("torso", (), {}), console)
    with view.showing():
        line = "a line that is much wider than the window of eighty columns, so that it must be folded"
        for told in ({"happened": line}, {"fault": line}, {"error": line}, {"ports": {line: ""}}):
            view.show_snapshot(look(2), "lose")
            file.seek(0)
            file.truncate()
            view.show_message(SimulationMessage(**told))
            said = file.getvalue()
            assert said.index("folded") < said.index("XL430-W250") < said.index("lose")
        view.help()
        file.seek(0)
        file.truncate()
    assert "XL430-W250" in file.getvalue()
    assert "fault> " not in file.getvalue()  # no more input is taken


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
    ],
)
def test_letters_become_lines(keyboard, letters, lines, pending):
    writer, typed = keyboard
    os.write(writer, letters)

    assert typed.read_lines() == lines
    assert (typed.pending, typed.ended) == (pending, False)
    os.close(writer)


def test_a_job_in_the_background_leaves_its_terminal_alone(keyboard, monkeypatch):
    _, typed = keyboard
    assert typed.in_foreground  # a pipe may always be read

    monkeypatch.setattr(os, "tcgetpgrp", lambda _: os.getpgrp() + 1)
    assert not typed.in_foreground
    monkeypatch.setattr(os, "tcgetpgrp", lambda _: os.getpgrp())
    assert typed.in_foreground


def test_an_end_gives_what_was_not_finished(keyboard):
    writer, typed = keyboard
    os.write(writer, b"help")
    os.close(writer)

    assert typed.read_lines() == []
    assert typed.read_lines() == ["help"]
    assert typed.ended
