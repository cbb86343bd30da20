"""Links to the terminals of simulated buses."""

from __future__ import annotations

import os

import pytest

from dxlrun.simulation.pseudo_terminal import DeviceLink


def test_a_link_never_replaces_a_file_and_is_removed_only_where_it_was_put(tmp_path):
    file, link = tmp_path / "file", tmp_path / "link"
    file.write_text("mine")
    with pytest.raises(FileExistsError, match="is no link"):
        DeviceLink(file).point("/dev/null")
    one, other = DeviceLink(link), DeviceLink(link)
    one.point("/dev/null")
    other.point("/dev/zero")
    one.remove()
    assert os.readlink(link) == "/dev/zero"
    other.remove()
    assert os.listdir(tmp_path) == ["file"]
