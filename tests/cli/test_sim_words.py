"""What `dxlrun sim` makes of its words, before anything starts."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from dxlrun.cli.sim.sim import link_of_each
from dxlrun.cli.sim.sim_inputs import read_faults, servo_bus, with_adapter
from dxlrun.cli.sim.sim_views import PlainView, SimulationView, ending
from dxlrun.errors import InputError
from dxlsim.messages import ServoLook, SimulationMessage
from dxlsim.simulation_plan import BusConfig, ServoConfig

BUS = BusConfig("main", 57_600, (ServoConfig(1, "XL430-W250", 0.0),), 2.0)


def test_servos_need_no_robot_file():
    bus = servo_bus(["XL430-W250:1-3", "XM430-W350:11,9"], None, None)

    assert [(servo.servo_id, servo.model) for servo in bus.servos] == [
        *((each, "XL430-W250") for each in (1, 2, 3)),
        *((each, "XM430-W350") for each in (11, 9)),
    ]
    assert (bus.baud_rate, bus.protocol) == (57_600, 2.0)
    assert bus.servos[0].position == pytest.approx(math.pi, abs=0.001)  # the middle, where it is mounted


@pytest.mark.parametrize(
    ("word", "rate"), [("AX-12A:1", 1_000_000), ("RX-28:1", 57_600), ("YM070-210-M001:1", 57_600)]
)
def test_without_a_baud_rate_it_is_that_of_a_new_servo(word, rate):
    assert servo_bus([word], None, None).baud_rate == rate


def test_protocol_1_has_rates_by_its_formula():
    assert servo_bus(["AX-12A:1"], 333_333, None).baud_rate == 333_333


@pytest.mark.parametrize(("word", "model"), [("XL-430:1", "XL430-W250"), ("AX12:1", "AX-12A")])
def test_a_model_is_understood_by_other_names(word, model):
    assert servo_bus([word], None, None).servos[0].model == model


def test_a_name_with_two_firmwares_follows_the_protocol():
    assert servo_bus(["MX-28:1"], None, 1.0).protocol == 1.0
    assert servo_bus(["MX-28:1"], None, 2.0).protocol == 2.0
    assert servo_bus(["MX-28:1", "XM430-W350:2"], 1_000_000, None).protocol == 2.0


def test_faults_come_from_the_line_and_from_a_file(tmp_path):
    file = tmp_path / "faults.txt"
    file.write_text(
        "# a bad day\n\nsilence servo=2 at=2s for=1s   # a loose plug\n  overload servo=1 at=3s\n"
    )

    read = read_faults(["lose servo=1 at=1s"], file)

    assert [str(fault).split()[0] for fault in read] == ["lose", "silence", "overload"]


def test_every_wrong_fault_is_reported_with_its_place(dxlrun, tmp_path):
    file = tmp_path / "faults.txt"
    file.write_text("lose servo=1\n  lose servo=one\nexplode\n")

    alone = dxlrun("sim", "--servo", "AX-12A:1", "--faults", file)
    both = dxlrun("sim", "--servo", "AX-12A:1", "--faults", file, "--fault", "lose")

    assert [line.split(" ")[0] for line in alone.errors] == [f"{file}:2:3:", f"{file}:3:1:"]
    assert (alone.code, both.code) == (2, 2)
    assert len(both.errors) == 3


def test_options_replace_the_robot_files_adapter():
    bus = with_adapter(BUS, {"latency_timer_ns": 4_000_000, "split": "random", "echo": True}, "slot", 7)

    assert (bus.adapter.latency_timer_ns, bus.adapter.split, bus.adapter.echo) == (4_000_000, "random", True)
    assert (bus.adapter.seed, bus.adapter.absent) == (7, "slot")
    assert with_adapter(bus, {"split": None}, None, 7) == bus


def test_one_bus_has_the_link_itself_and_several_have_its_name_and_theirs(tmp_path):
    other = BusConfig("arm", 57_600, (), 2.0)

    assert link_of_each([BUS], tmp_path / "robot") == {"main": tmp_path / "robot"}
    assert link_of_each([BUS, other], tmp_path / "robot") == {
        "main": tmp_path / "robot.main",
        "arm": tmp_path / "robot.arm",
    }
    assert link_of_each([BUS], None) == {}


def test_what_is_no_link_is_never_replaced(tmp_path):
    (tmp_path / "file").write_text("precious")
    (tmp_path / "dangling").symlink_to("/dev/pts/nowhere")

    with pytest.raises(InputError, match="exists and is not a link"):
        link_of_each([BUS], tmp_path / "file")
    assert link_of_each([BUS], tmp_path / "dangling") == {"main": tmp_path / "dangling"}


def test_the_ports_are_printed_once(capsys):
    servos = tuple(ServoConfig(each, "AX-12A", 0.0) for each in (1, 2, 3, 7))
    bus = BusConfig("main", 1_000_000, servos)
    view = PlainView(SimulationView("torso", (bus,), {"main": Path("/tmp/robot")}, "dxlrun torso.yaml"))  # noqa: S108

    view.opened({"main": "/dev/pts/7"}, "core 1")
    view.show_message(SimulationMessage({"main": ""}))
    view.show_message(SimulationMessage({"main": "/dev/pts/9"}))
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


def test_the_last_line_has_the_counts():
    servo = ServoLook("main", 1, "AX-12A", True, None, 0.0, 25.0, 12.0, 0, heard=1, answered=0)
    look = SimulationMessage(servos=(servo,), lateness_us={"median": 12.3, "p99": 80.0})

    assert ending("torso", 2.04, look) == (
        "torso: ended after 2.0 s. 1 packet received, 0 answered; "
        "replies later than planned: median 12 us, p99 80 us"
    )
    assert (
        ending("torso", 2.04, SimulationMessage())
        == "torso: ended after 2.0 s. Instructions were answered as recorded"
    )
