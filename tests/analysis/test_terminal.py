"""Analysis: what a terminal shows, however narrow it is."""

from __future__ import annotations

import io
from collections.abc import Callable
from typing import Any

import pytest
from rich.console import Console
from tests.kit.made_logs import Cycle, Said, Wire

from dxlrun.channels.event_records import EventCode, Severity
from dxlrun.output.terminal import show_parts
from dxlrun.output.text_table import Table
from dxlrun_analysis.parts.part import Report
from dxlrun_analysis.report import analyze_log, parts
from dxlwire.packets import PacketKind

Make = Callable[..., Any]


def lines(report: Report, width: int) -> list[str]:
    file = io.StringIO()
    console = Console(file=file, width=width, force_terminal=True, color_system=None)
    show_parts(*(part for part in parts(report) if isinstance(part, Table)), console=console)
    return file.getvalue().splitlines()


@pytest.fixture
def report(write: Make) -> Report:
    ask, answer = bytes.fromhex("ffff0504022406ca"), bytes.fromhex("ffff05080000020000000000f0")
    packets = [Wire(PacketKind.INSTRUCTION, 5, 0, ask), Wire(PacketKind.STATUS, 5, 640, answer)]
    text = "torque is on: " + ", ".join(f"joint_number_{number}" for number in range(30))
    events = [
        Said(EventCode.TORQUE_ON, Severity.INFO, text),
        Said(EventCode.READ_LOST, Severity.WARNING, "head (ID 21) did not answer"),
    ]
    return analyze_log(write([Cycle(0), Cycle(1, position=0.25)], packets, events))


@pytest.mark.parametrize("width", [80, 100, 200])
def test_no_line_is_longer_than_the_terminal_or_than_reads_well(report: Report, width: int) -> None:
    assert max(len(line) for line in lines(report, width)) <= min(width, 120)


def test_a_narrow_terminal_shows_each_servo_on_one_line(report: Report) -> None:
    (servo,) = (line for line in lines(report, 60) if line.startswith("main 5"))
    assert servo.split() == ["main", "5", "left_elbow_joint", "1", "0", "0", "640", "us", "640", "us"]


def test_a_wide_terminal_shows_the_details(report: Report) -> None:
    assert any("instructions" in line and "slowest" in line for line in lines(report, 120))
    assert not any("instructions" in line and "slowest" in line for line in lines(report, 60))


def test_an_event_has_its_source_once(report: Report) -> None:
    text = "\n".join(lines(report, 120))
    assert "head (ID 21) did not answer" in text
    assert "head: head (ID 21)" not in text
