"""Lines that go and come back: what keeps them, and what asks for them; on pseudo-terminals behind a link."""

import os
import select
from types import SimpleNamespace

import pytest
from tests.kit.awaited import DEADLINE_S

from dxlwire.exceptions import PortError
from dxlwire.port import reopening
from dxlwire.port.reopening import KeptLines, LineSettings, lasting_name


class Adapter:
    """A pseudo-terminal behind a link, as udev's are."""

    def __init__(self, link):
        self.link = link
        self.master, self._slave = os.openpty()
        self._point()

    def unplug(self):
        os.close(self.master)
        os.close(self._slave)
        self.link.unlink()

    def plug_in(self):
        self.master, self._slave = os.openpty()
        self._point()

    def heard(self):
        assert select.select([self.master], [], [], DEADLINE_S)[0]
        return os.read(self.master, 100)

    def _point(self):
        self.link.symlink_to(os.ttyname(self._slave))


@pytest.fixture
def adapters(tmp_path):
    both = [Adapter(tmp_path / "left"), Adapter(tmp_path / "right")]
    yield both
    for adapter in both:
        adapter.unplug()


@pytest.fixture
def kept(adapters):
    lines = KeptLines([LineSettings(str(adapter.link), 1_000_000, 0) for adapter in adapters])
    yield lines
    lines.close()


def returned(lines):
    assert select.select([lines], [], [], DEADLINE_S)[0]
    return [one.index for one in lines.returned()]


def test_a_line_that_is_back_under_another_name_has_its_old_descriptor(adapters, kept):
    before, opened = list(kept.descriptors), len(os.listdir("/proc/self/fd"))
    adapters[1].unplug()
    assert kept.lost(1)
    assert kept.returned() == []
    adapters[1].plug_in()
    assert returned(kept) == [1]
    assert kept.descriptors == before
    assert len(os.listdir("/proc/self/fd")) == opened
    os.write(kept.descriptors[1], b"right")
    assert adapters[1].heard() == b"right"
    os.write(kept.descriptors[0], b"left")
    assert adapters[0].heard() == b"left"


def test_while_a_line_is_gone_nobody_has_its_old_device_open(adapters, kept):
    adapters[0].unplug()
    kept.lost(0)
    assert os.readlink(f"/proc/self/fd/{kept.descriptors[0]}") == os.devnull
    adapters[0].plug_in()
    assert returned(kept) == [0]


def test_a_line_is_back_soon_after_its_adapter(adapters, kept, monkeypatch):
    pauses = []

    def sleep(pause_s):
        pauses.append(pause_s)
        if sum(pauses) > 10.0 and not adapters[0].link.exists():
            adapters[0].plug_in()

    monkeypatch.setattr(reopening, "time", SimpleNamespace(sleep=sleep))
    adapters[0].unplug()
    kept.lost(0)
    assert returned(kept) == [0]
    assert 10.0 < sum(pauses) <= 10.0 + reopening.LONGEST_PAUSE_S


def test_both_lines_may_be_gone_at_once_and_come_back_in_any_order(adapters, kept):
    for index in (0, 1):
        adapters[index].unplug()
        kept.lost(index)
    adapters[1].plug_in()
    assert returned(kept) == [1]
    adapters[0].plug_in()
    assert returned(kept) == [0]


def test_a_line_that_is_gone_for_long_is_tried_each_two_seconds(adapters, kept, monkeypatch):
    pauses = []

    def pause(seconds):
        pauses.append(seconds)
        if len(pauses) == 9:
            adapters[0].plug_in()

    monkeypatch.setattr("dxlwire.port.reopening.time.sleep", pause)
    adapters[0].unplug()
    kept.lost(0)
    assert returned(kept) == [0]
    assert (max(pauses), pauses[-1]) == (2.0, 2.0)


def test_a_line_that_is_back_is_locked_against_every_other_program(adapters, kept):
    adapters[0].unplug()
    kept.lost(0)
    adapters[0].plug_in()
    returned(kept)
    with pytest.raises(PortError, match="in use"):
        KeptLines([LineSettings(str(adapters[0].link), 1_000_000, 0)])


def test_of_two_lines_of_which_one_is_missing_neither_is_kept(adapters):
    left = str(adapters[0].link)
    with pytest.raises(PortError, match="port /dev/ttyNOPE not found"):
        KeptLines([LineSettings(left, 1_000_000, 0), LineSettings("/dev/ttyNOPE", 1_000_000, 0)])
    KeptLines([LineSettings(left, 1_000_000, 0)]).close()


def test_the_name_by_which_an_adapter_is_found_again(tmp_path):
    device, stranger = tmp_path / "ttyUSB0", tmp_path / "ttyUSB1"
    device.touch()
    (tmp_path / "by-id").mkdir()
    link = tmp_path / "by-id/usb-FTDI_FT9HDA1"
    link.symlink_to(device)
    assert lasting_name(str(device), tmp_path) == str(link)
    assert lasting_name(str(link), tmp_path) == str(link)
    assert lasting_name(str(stranger), tmp_path) == str(stranger)
    assert lasting_name("/dev/pts/7", tmp_path) == ""
