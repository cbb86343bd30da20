"""Items of a control table: units, ticks and bytes; and what is wrong with a data file."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import rustypot

import dxlwire.control_table
from dxlwire.control_table import ControlItem, decoded, find_table, read_control_table

AX = find_table("AX-12A")
AX_TEXT = (Path(dxlwire.control_table.__file__).parent / "tables/protocol1/AX-12A.toml").read_text("utf-8")


def test_the_model_number_is_that_of_a_foreign_list() -> None:
    assert AX.model_number in rustypot.AxPyController.models().values()
    assert AX.items["model_number"].initial == AX.model_number


def test_units_are_exact_and_not_the_rounded_ones_of_the_manual() -> None:
    assert math.degrees(AX.rad_per_tick) == pytest.approx(300 / 1023, rel=1e-15)
    assert math.degrees(AX.rad_per_tick * AX.max_tick) == pytest.approx(300, rel=1e-15)
    assert AX.rad_s_per_tick == pytest.approx(0.111 * 2 * math.pi / 60, rel=1e-15)
    assert AX.max_speed == pytest.approx(59 * 2 * math.pi / 60, rel=1e-15)
    rpm = AX.max_speed_tick * AX.rad_s_per_tick * 60 / (2 * math.pi)
    assert round(rpm) == 114  # e-Manual, Moving Speed (32): "If it is 1023, it is about 114rpm"
    assert AX.effort_per_tick == 1 / 1023
    units = {
        "present_voltage": ("V", 0.1),
        "present_temperature": ("degC", 1.0),
        "return_delay_time": ("s", 2e-6),
        "goal_position": ("rad", AX.rad_per_tick),
        "torque_enable": ("", 1.0),
    }
    assert {name: (AX.items[name].unit, AX.items[name].scale) for name in units} == units


def test_a_zero_with_direction_is_zero() -> None:
    assert AX.items["present_load"].decode(b"\x00\x04") == 0  # e-Manual: "1024 is equal to 0"


@pytest.mark.parametrize(("name", "ticks"), [("goal_position", -1), ("id", 256), ("present_speed", 1024)])
def test_a_value_that_does_not_fit_is_refused_by_name(name: str, ticks: int) -> None:
    with pytest.raises(ValueError, match=name):
        AX.items[name].encode(ticks)


def test_only_items_that_lie_whole_in_the_bytes_are_decoded() -> None:
    items = find_table("XM430-W350", 2.0).items
    assert decoded(items.values(), 80, b"\1\0\2\0\3") == {"position_d_gain": 1, "position_i_gain": 2}
    assert decoded([items["position_d_gain"]], 81, b"\0\0\0") == {}


def test_a_reply_of_the_wrong_length_is_refused() -> None:
    with pytest.raises(ValueError, match="2 bytes are needed, 1 were given"):
        AX.items["goal_position"].decode(b"\x00")


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ("address = 3,", "address = 2,", "id: address 2 overlaps the previous item"),
        ("maximum = 253", "maximum = 256", "id: 0..256 does not fit"),
        ("initial = 250", "initial = 255", "return_delay_time: the initial value 255"),
        ('"unsigned"', '"gray"', "model_number: encoding: Invalid enum value 'gray'; known are unsigned"),
        ("address = 5,", 'address = "5",', "return_delay_time: address: Expected `int`, got `str`"),
        ("size = 2", "size = 3", "model_number: the size must be 1, 2 or 4, not 3"),
        ("59 rpm", "59 turns", "the unit is not one of"),
    ],
)
def test_a_broken_data_file_is_refused(old: str, new: str, complaint: str) -> None:
    assert old in AX_TEXT
    with pytest.raises(ValueError, match=complaint):
        read_control_table(AX_TEXT.replace(old, new, 1))


def test_items_of_devices_have_integers_bytes_and_values() -> None:
    meters = "sign_magnitude", "m", 0.5, ""
    signed = ControlItem("x", 0, 2, "RW", "RAM", -1023, 1023, None, *meters, offset=3.0)
    assert signed.wire_bytes(-5) == b"\x05\x04"
    assert (signed.integer(b"\x05\x04"), signed.value(b"\x05\x04")) == (-5, 0.5)
    button = ControlItem("b", 0, 1, "R", "RAM", 0, 255, None, "unsigned", "", 1.0, "", bit=2)
    assert [(button.integer(data), button.value(data)) for data in (b"\x04", b"\xfb")] == [(1, 1.0), (0, 0.0)]
    real = ControlItem("f", 0, 4, "RW", "RAM", 0, 2**32 - 1, None, "float32", "m", 2.0, "")
    assert (real.integer(b"\0\0\x80\x3e"), real.value(b"\0\0\x80\x3e")) == (0x3E800000, 0.5)
