"""`--over PATH=...`: which values it gives, and each mistake with its fix."""

from __future__ import annotations

import math

import pytest

from dxlrun_lab.sweep.ranges import parse_range


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("gains.p=0.5..3x6", (0.5, 1.0, 1.5, 2.0, 2.5, 3.0)),
        ("gains.p=0.1..0.3x3", (0.1, 0.2, 0.3)),  # not 0.30000000000000004
        ("gains.p=1..100x3log", (1, 10, 100)),
        ("gains.p = 1 .. 4 x 4", (1, 2, 3, 4)),
        ("gains.p=0..1x3", (0, 0.5, 1)),
        ("gains.p=-2..2x3", (-2, 0, 2)),
        ("gains.p=1e-3..1e-1x3 log", (0.001, 0.01, 0.1)),
        ("gains.p=1,2,5.5", (1, 2, 5.5)),
        ("gains.p=4", (4,)),
        ("joints.elbow.registers.d=0..10x4", (0, 3, 7, 10)),  # a register is a whole number
        ("limits.acceleration=5 rad/s^2..20 rad/s^2x4", tuple(f"{n} rad/s^2" for n in (5, 10, 15, 20))),
        ("inertia=0.1 kg m^2..0.2 kg m^2x2", ("0.1 kg m^2", "0.2 kg m^2")),
        ("limits.effort=20 %,40 %", ("20 %", "40 %")),
        ("command_interface=effort,pwm", ("effort", "pwm")),
        ("active=true,false", (True, False)),
    ],
)
def test_a_range_is_these_values(text, values):
    found = parse_range(text).values
    assert found == values
    assert [type(value) for value in found] == [type(value) for value in values]


def test_a_range_keeps_its_unit_apart_from_its_numbers():
    found = parse_range("limits.velocity=1 rad/s..3 rad/sx3")
    assert (found.name, found.unit, found.cells) == ("limits.velocity", "rad/s", (1, 2, 3))
    assert parse_range("active=true,false").cells == ("true", "false")
    logarithmic = parse_range("p=2..32x5log")
    assert [math.log2(number) for number in logarithmic.cells] == pytest.approx([1, 2, 3, 4, 5])


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("gains.p", "this names no range; write PATH=LO..HIxN"),
        ("gains.p=", "this names no range"),
        ("=1..2x3", "this names no range"),
        ("gains.p=1..2", "'1..2' has no number of points; write"),
        ("gains.p=1..2x", "'1..2x' has no number of points; write"),
        ("gains.p=1..2x1", "x1 is no number of points; give from 2"),
        ("gains.p=1..2x99999", "x99999 is no number of points; give from 2"),
        ("gains.p=2..1x3", "the range is empty: 2 is not below 1; write"),
        ("gains.p=1..1x3", "the range is empty: 1 is not below 1"),
        ("gains.p=0..1x3log", "a range with log begins above 0, not at 0; begin above 0"),
        ("gains.p=a..1x3", "'a' is no number; write"),
        ("gains.p=..1x3", "'nothing' is no number; write"),
        ("gains.p=nan..infx3", "'nan' is no number"),
        ("gains.p=1 ms..2 sx3", "its ends have different units (ms, s); give both one"),
        ("gains.p=1..2 sx3", "its ends have different units (none, s); give both one"),
        ("gains.p=1 s,2", "its values have different units (none, s); give all one"),
        ("gains.p=1,,2", "'1,,2' has an empty value; write"),
        ("gains.p=1,2,1", "1 is given twice; give each value once"),
        ("gains p=1,2", "'gains p' is no place in a robot file; name keys with dots"),
        ("gains..p=1,2", "'gains..p' is no place in a robot file"),
        ("a.registers.d=0..2x9", "0..2 has fewer than 9 whole numbers; give fewer points"),
    ],
)
def test_a_mistake_is_one_sentence_with_its_fix(text, sentence):
    with pytest.raises(ValueError, match="; ") as refused:
        parse_range(text)
    assert str(refused.value).startswith(sentence)
