"""The words of `dxlrun sim`, its live table, and the letters that are typed below it."""

import math
import os
from collections.abc import Iterator
from io import StringIO
from pathlib import Path

import pytest
from msgspec.structs import replace
from rich.console import Console
from tests.kit.commands import Dxlrun

from dxlrun.cli.sim.sim import link_of_each
from dxlrun.cli.sim.sim_inputs import read_faults, servo_bus, with_adapter
from dxlrun.cli.sim.sim_views import PlainView, SimulationView, TableView, ending, page
from dxlrun.errors import InputError
from dxlrun.run.simulation_front import TypedLines
from dxlsim.messages import ServoLook, SimulationMessage
from dxlsim.simulation_plan import BusConfig, ServoConfig

BUS = BusConfig("main", 57_600, (ServoConfig(1, "XL430-W250", 0.0),), 2.0)


def test_servos_need_no_robot_file() -> None:
    bus = servo_bus(["XL430-W250:1-3", "XM430-W350:11,9"], None, None)
    xl, xm = "XL430-W250", "XM430-W350"
    assert [(one.servo_id, one.model) for one in bus.servos] == [(1, xl), (2, xl), (3, xl), (11, xm), (9, xm)]
    assert bus.servos[0].position == pytest.approx(math.pi, abs=0.001)  # the middle, where it is mounted


@pytest.mark.parametrize(
    ("words", "rate", "protocol", "found"),
    [
        ("AX-12A:1", None, None, ("AX-12A", 1.0, 1_000_000)),  # without a rate it is that of a new servo
        ("RX-28:1", None, None, ("RX-28", 1.0, 57_600)),
        ("YM070-210-M001:1", None, None, ("YM070-210-M001", 2.0, 57_600)),
        ("AX-12A:1", 333_333, None, ("AX-12A", 1.0, 333_333)),  # Protocol 1.0 has rates by its formula
        ("XL-430:1", None, None, ("XL430-W250", 2.0, 57_600)),
        ("AX12:1", None, None, ("AX-12A", 1.0, 1_000_000)),
        ("MX-28:1", None, 1.0, ("MX-28", 1.0, 57_600)),
        ("MX-28:1", None, 2.0, ("MX-28", 2.0, 57_600)),
        ("MX-28:1 XM430-W350:2", 1_000_000, None, ("MX-28", 2.0, 1_000_000)),
    ],
)
def test_model_and_protocol_of_servos_are_found(
    words: str, rate: int | None, protocol: float | None, found: tuple[str, float, int]
) -> None:
    bus = servo_bus(words.split(), rate, protocol)
    assert (bus.servos[0].model, bus.protocol, bus.baud_rate) == found


def test_faults_come_from_the_line_and_from_a_file(dxlrun: Dxlrun, tmp_path: Path) -> None:
    file = tmp_path / "faults.txt"
    file.write_text("# a day\n\nsilence servo=2 at=2s for=1s   # a loose plug\n  overload servo=1 at=3s\n")
    read = read_faults(["lose servo=1 at=1s"], file)
    assert [str(fault).split()[0] for fault in read] == ["lose", "silence", "overload"]
    file.write_text("lose servo=1\n  lose servo=one\nexplode\n")
    alone = dxlrun("sim", "--servo", "AX-12A:1", "--faults", file)
    both = dxlrun("sim", "--servo", "AX-12A:1", "--faults", file, "--fault", "lose")
    assert [line.split(" ")[0] for line in alone.errors] == [f"{file}:2:3:", f"{file}:3:1:"]
    assert (alone.code, both.code, len(both.errors)) == (2, 2, 3)


def test_options_replace_the_adapter_of_the_robot_file() -> None:
    bus = with_adapter(BUS, {"latency_timer_ns": 4_000_000, "split": "random", "echo": True}, "slot", 7)
    found = bus.adapter
    assert (found.latency_timer_ns, found.split, found.echo) == (4_000_000, "random", True)
    assert (found.seed, found.absent) == (7, "slot")
    assert with_adapter(bus, {"split": None}, None, 7) == bus


def test_one_bus_has_the_link_and_several_have_its_name_and_theirs(tmp_path: Path) -> None:
    other, link = BusConfig("arm", 57_600, (), 2.0), tmp_path / "robot"
    assert link_of_each([BUS], link) == {"main": link}
    assert link_of_each([BUS, other], link) == {
        "main": tmp_path / "robot.main",
        "arm": tmp_path / "robot.arm",
    }
    assert link_of_each([BUS], None) == {}
    link.symlink_to("/dev/pts/nowhere")
    assert link_of_each([BUS], link) == {"main": link}
    (tmp_path / "file").write_text("precious")
    with pytest.raises(InputError, match="exists and is not a link"):
        link_of_each([BUS], tmp_path / "file")


def test_link_of_a_simulation_that_runs_is_not_taken_over(tmp_path: Path) -> None:
    """A second simulation must not replace the link of the first, and remove it when it ends."""
    link, (terminal, device) = tmp_path / "robot", os.openpty()
    link.symlink_to(os.ttyname(device))
    try:
        with pytest.raises(InputError, match="leads to a simulation that runs; end that one"):
            link_of_each([BUS], link)
        os.utime(link, (0, 0), follow_symlinks=False)  # the terminal is younger than the link
        assert link_of_each([BUS], link) == {"main": link}
    finally:
        os.close(terminal)
        os.close(device)


def test_ports_are_printed_once(capsys: pytest.CaptureFixture[str]) -> None:
    servos = tuple(ServoConfig(each, "AX-12A", 0.0) for each in (1, 2, 3, 7))
    link = Path("/tmp/robot")  # noqa: S108
    shown = SimulationView(
        "torso", (BusConfig("main", 1_000_000, servos),), {"main": link}, "dxlrun torso.yaml"
    )
    view = PlainView(shown)
    view.opened({"main": "/dev/pts/7"}, "core 1")
    for port in ("", "/dev/pts/9"):
        view.show_message(SimulationMessage({"main": port}))
    view.show_message(SimulationMessage(happened="lose servo=1"))
    assert capsys.readouterr().out.splitlines() == [
        "torso: 4 servos simulated on 1 bus; Ctrl-C ends it, `help` lists faults to type",
        "  main: /tmp/robot (/dev/pts/7), 1000000 bit/s, Protocol 1.0, AX-12A 1-3, 7",
        "  in real time: core 1",
        "next: dxlrun torso.yaml port:=/tmp/robot",
        "main: no adapter, no port",
        "main: the adapter is back as /dev/pts/9, and /tmp/robot leads to it",
        "fault: lose servo=1",
    ]


def test_last_line_has_the_counts() -> None:
    servo = ServoLook("main", 1, "AX-12A", True, None, 0.0, 25.0, 12.0, 0, heard=1, answered=0)
    look = SimulationMessage(servos=(servo,), lateness_us={"median": 12.3, "p99": 80.0})
    assert ending("torso", 2.04, look) == (
        "torso: ended after 2.0 s. 1 packet received, 0 answered; "
        "replies later than planned: median 12 us, p99 80 us"
    )
    recorded = "torso: ended after 2.0 s. Instructions were answered as recorded"
    assert ending("torso", 2.04, SimulationMessage()) == recorded


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
