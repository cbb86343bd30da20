"""The latency timer of an adapter, in a directory that looks like the kernel's; no adapter is here."""

import os
import re

import pytest
from msgspec.structs import replace

from dxlrun.dynamixel.remedies import CHECK, INJECTED, choose_remedy, describe_late_start, late_replies
from dxlrun.errors import PortError, StartUpError
from dxlrun.plan.machine_load import MachineLoad
from dxlrun.testing import VirtualRobot, plan_of
from dxlwire.port.latency_timer import latency_timer, shorten
from dxlwire.port.reopening import KeptLines, LineSettings
from dxlwire.port.serial_open import open_serial

BUSY = MachineLoad(10.0, busy_s=10.0, no_idle_core_s=10.0)
MS = 1_000_000


@pytest.fixture
def line():
    master, slave = os.openpty()
    yield os.ttyname(slave)
    os.close(master)
    os.close(slave)


def timer_of(tmp_path, port, text):
    """Write the file in which the kernel would show the timer of a port's adapter."""
    place = tmp_path / "bus/usb-serial/devices" / os.path.basename(port) / "latency_timer"
    place.parent.mkdir(parents=True)
    place.write_text(text)
    return place


@pytest.fixture
def timer(tmp_path, line):
    return timer_of(tmp_path, line, "16\n")


def shortened(line, most_ns, system):
    with open_serial(line, 1_000_000) as port:
        return shorten(port.fileno(), line, most_ns, system)


def test_a_timer_is_shortened_where_it_is_longer_than_the_robot_file_says(tmp_path, line, timer):
    assert shortened(line, 16 * MS, tmp_path) == ("", "")
    assert timer.read_text() == "16\n"
    assert shortened(line, MS, tmp_path) == (f"{line}: latency timer set from 16 ms to 1 ms", "")
    assert timer.read_text() == "1"


def test_an_adapter_without_a_timer_is_nobodys_fault(tmp_path, line):
    assert latency_timer(line, tmp_path) is None
    assert shortened(line, 0, tmp_path) == ("", "")


@pytest.mark.parametrize("unreadable", ["", "soon", "16 ms"])
def test_a_timer_that_says_no_number_is_none(tmp_path, line, unreadable):
    timer_of(tmp_path, line, unreadable)
    assert latency_timer(line, tmp_path) is None


def test_a_timer_that_this_user_may_not_set_is_one_sentence_with_the_command(
    tmp_path, line, timer, monkeypatch
):
    def forbidden(*_):
        raise PermissionError

    monkeypatch.setattr("pathlib.Path.write_text", forbidden)
    done, wrong = shortened(line, MS, tmp_path)
    assert done == ""
    assert f"{line} delays replies by 16 ms instead of the planned 1 ms; run `echo 1 | sudo tee " in wrong
    assert f"`echo 1 | sudo tee {timer}`" in wrong
    with pytest.raises(PortError, match="sudo tee"):
        KeptLines([LineSettings(line, 1_000_000, MS)], tmp_path)
    with open_serial(line, 1_000_000):
        pass  # a start that was refused let go of it


def test_a_line_is_opened_with_its_timer_set(tmp_path, line, timer):
    lines = KeptLines([LineSettings(line, 1_000_000, MS)], tmp_path)
    assert lines.done == [f"{line}: latency timer set from 16 ms to 1 ms"]
    lines.close()


ROBOT = """\
name: pair
loop: {rate: 20}
buses:
  main:
    {port: sim, protocol: 1.0, baud_rate: 1_000_000, return_delay_time: 100 us,
    simulation: {latency_timer: 16 ms}}
joints:
  pan: {bus: main, id: 3, model: AX-12A, reference: 150 deg, direction: 1}
  tilt: {bus: main, id: 7, model: AX-12A, reference: 150 deg, direction: 1}
"""


def with_a_timer(tmp_path, latency_ms, port="sim"):
    """Return a robot whose simulated adapter keeps replies back for 16 ms, and a plan that expects less."""
    path = tmp_path / "pair.yaml"
    path.write_text(ROBOT)
    plan = plan_of(path, duration_s=0.2)
    robot = VirtualRobot(plan)
    (bus,) = robot.robot.hardware._lines.buses
    assert bus.plan is plan.buses[0]
    bus.plan = replace(bus.plan, latency_ns=latency_ms * MS, port=port)
    return robot


def test_replies_later_than_planned_are_reported_before_any_servo_has_torque(tmp_path):
    robot = with_a_timer(tmp_path, 1, "/dev/ttyUSB0")
    with pytest.raises(StartUpError) as refusal:
        robot.run()
    assert refusal.value.for_replies
    (sentence,) = refusal.value.sentences
    start = (
        r"the loop would miss most replies: (\d+) of \1 replies on bus main were delayed by up to 1[56] ms"
    )
    assert re.match(start, sentence), sentence
    assert sentence.endswith(" (planned for the adapter: 1 ms)"), "nothing shows the cause"
    torque_on = bytes.fromhex("0318")  # a write to Torque Enable (24)
    sent = [entry.data for entry in robot.ledger.entries if entry.direction == "in"]
    assert sent
    assert not any(torque_on in data for data in sent)


@pytest.mark.parametrize("latency_ms", [7, 16])
def test_a_timer_that_the_reads_can_wait_for_is_no_reason_not_to_start(tmp_path, latency_ms):
    robot = with_a_timer(tmp_path, latency_ms)
    robot.run()
    assert robot.record.states.valid.all()


LINK = "/dev/serial/by-id/usb-FTDI"


@pytest.mark.parametrize(
    ("port", "extra_ms", "named"),
    [
        ("/dev/ttyUSB0", 15.9, "devices/ttyUSB0/latency_timer"),
        (LINK, 12.0, f"devices/$(basename $(readlink -f {LINK}))/"),
        ("/dev/ttyUSB0", 18.1, ""),
        ("/dev/ttyUSB0", 11.9, ""),
        ("sim", 16.0, ""),
    ],
)
def test_only_what_looks_like_the_timer_is_called_one(port, extra_ms, named):
    sentence, remedy = late_replies("main", port, extra_ms * MS, MS)
    assert bool(remedy) == bool(named) == ("latency timer" in sentence)
    assert named in remedy


def test_busy_machine_comes_before_a_latency_timer():
    sentence, remedy = late_replies("main", "/dev/ttyUSB0", 15.9 * MS, MS, BUSY)
    assert "latency timer" not in sentence
    assert remedy == "end other programs"


@pytest.mark.parametrize(
    ("port", "load", "remedy"),
    [
        ("/dev/ttyUSB0", MachineLoad(), CHECK),
        ("/dev/ttyUSB0", BUSY, "end other programs"),
        ("sim", MachineLoad(), INJECTED),
        ("sim", BUSY, "end other programs, or use --virtual"),
    ],
)
def test_remedy_is_for_the_machine_first_and_never_for_simulated_parts(port, load, remedy):
    assert choose_remedy(port, CHECK, load=load) == remedy


@pytest.mark.parametrize(("found", "named"), [("16\n", True), ("1\n", False), (None, False)])
def test_late_start_names_the_timer_that_the_kernel_shows(tmp_path, found, named):
    if found is not None:
        timer_of(tmp_path, "ttyUSB7", found)
    sentence = describe_late_start("main", "/dev/ttyUSB7", [15 * MS, 0, 14 * MS], MS, tmp_path)
    assert sentence.startswith(
        "2 of 3 replies on bus main were delayed by up to 15 ms (planned for the adapter: 1 ms)"
    )
    assert ("the adapter's latency timer is 16 ms: shorten it with `echo 1 | sudo tee" in sentence) is named
