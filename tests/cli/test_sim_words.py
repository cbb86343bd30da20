"""What `dxlrun sim` makes of its words, and what it prints; refusals of words are in refusals.txt."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from tests.kit.commands import Dxlrun

from dxlrun.cli.sim.sim import link_of_each
from dxlrun.cli.sim.sim_inputs import read_faults, servo_bus, with_adapter
from dxlrun.cli.sim.sim_views import PlainView, SimulationView, ending
from dxlrun.errors import InputError
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
