"""The latency timer of an adapter, in a directory that looks like the kernel's; no adapter is here."""

import os

import pytest

from dxlrun.dynamixel.latency_timer import latency_timer, shorten
from dxlrun.dynamixel.reopening import KeptLines, Wanted
from dxlrun.dynamixel.serial_open import open_serial
from dxlrun.errors import PortError

MS = 1_000_000


@pytest.fixture
def line():
    master, slave = os.openpty()
    yield os.ttyname(slave)
    os.close(master)
    os.close(slave)


@pytest.fixture
def timer(tmp_path, line):
    """Return the file in which the kernel would show the timer of the line's adapter, which is 16 ms."""
    place = tmp_path / "bus/usb-serial/devices" / os.path.basename(line) / "latency_timer"
    place.parent.mkdir(parents=True)
    place.write_text("16\n")
    return place


def shortened(line, most_ns, system):
    with open_serial(line, 1_000_000) as port:
        return shorten(port, line, most_ns, system)


def test_a_timer_that_is_longer_than_the_robot_file_says_is_shortened(tmp_path, line, timer):
    assert shortened(line, MS, tmp_path) == (f"{line}: latency timer set from 16 ms to 1 ms", "")
    assert timer.read_text() == "1"


def test_a_timer_that_is_as_short_as_the_robot_file_says_is_left_alone(tmp_path, line, timer):
    assert shortened(line, 16 * MS, tmp_path) == ("", "")
    assert timer.read_text() == "16\n"


def test_an_adapter_without_a_timer_is_nobodys_fault(tmp_path, line):
    assert latency_timer(line, tmp_path) is None
    assert shortened(line, 0, tmp_path) == ("", "")


@pytest.mark.parametrize("unreadable", ["", "soon", "16 ms"])
def test_a_timer_that_says_no_number_is_none(tmp_path, line, timer, unreadable):
    timer.write_text(unreadable)
    assert latency_timer(line, tmp_path) is None


def test_a_timer_that_this_user_may_not_set_is_one_sentence_with_the_command(
    tmp_path, line, timer, monkeypatch
):
    def forbidden(*_):
        raise PermissionError

    monkeypatch.setattr("pathlib.Path.write_text", forbidden)
    done, wrong = shortened(line, MS, tmp_path)
    assert done == ""
    assert f"{line} keeps replies back for 16 ms, and the robot file says adapter: {{latency: 1 ms}}" in wrong
    assert f"`echo 1 | sudo tee {timer}`" in wrong
    with pytest.raises(PortError, match="sudo tee"):
        KeptLines([Wanted(line, 1_000_000, MS)], tmp_path)
    with open_serial(line, 1_000_000):
        pass  # a start that was refused let go of it


def test_a_line_is_opened_with_its_timer_set(tmp_path, line, timer):
    lines = KeptLines([Wanted(line, 1_000_000, MS)], tmp_path)
    assert lines.done == [f"{line}: latency timer set from 16 ms to 1 ms"]
    lines.close()
