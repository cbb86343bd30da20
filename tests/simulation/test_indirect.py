"""Indirect addresses of simulated servos of Protocol 2.0."""

from __future__ import annotations

import pytest

from dxlrun.simulation.wire.protocol2 import ErrorNumber


def test_indirect_data_is_read_and_written_through(line2):
    for index, address in enumerate((132, 133, 134, 135, 65)):
        assert line2.set(f"indirect_address_{index + 1}", address) == 0
    position, led = line2.read_bytes(1, 132, 4), b"\x00"
    assert line2.read_bytes(1, 224, 5) == position + led
    assert line2.write_bytes(1, 228, b"\x01") == 0
    assert line2.get("led") == 1
    assert line2.write_bytes(1, 224, b"\x00") == ErrorNumber.ACCESS  # present position is read-only


def test_a_goal_may_go_through_indirect_data(line2):
    line2.set("torque_enable", 1)
    for index in range(4):
        line2.set(f"indirect_address_{index + 1}", 116 + index)
    assert line2.write_bytes(1, 224, (3000).to_bytes(4, "little")) == 0
    line2.wait(2)
    assert line2.get("present_position") == pytest.approx(3000, abs=3)  # what friction leaves
    assert line2.write_bytes(1, 224, b"\x00\x00") == ErrorNumber.DATA_LENGTH


def test_a_reboot_gives_indirect_data_another_meaning(line2):
    line2.set("indirect_address_1", 132)
    line2.servo().reset()
    assert line2.get("indirect_address_1") == 224
    assert len(line2.read_bytes(1, 224, 1)) == 1
