"""Units of joints: texts of positions and speeds, and the kind of joint that has a quantity."""

from __future__ import annotations

import msgspec
import pytest

from dxlwire.joint_unit import LINEAR, ROTARY, JointUnit


def test_texts_are_in_the_unit_that_people_read() -> None:
    assert (ROTARY.text(0.5), LINEAR.text(0.0123456)) == ("28.65 deg", "12.35 mm")
    assert (ROTARY.text(0.5, trim=True), LINEAR.text(0.03, trim=True)) == ("28.65 deg", "30 mm")
    assert (ROTARY.text(0.5, digits=0), LINEAR.text(0.0123, digits=1)) == ("29 deg", "12.3 mm")
    assert (ROTARY.speed_text(0.5), LINEAR.speed_text(0.5)) == ("28.65 deg/s", "500.00 mm/s")
    assert (ROTARY.exact_text(0.5), LINEAR.exact_text(0.0123456)) == ("28.6479 deg", "12.3456 mm")


def test_numbers_have_no_sign_before_zero() -> None:
    signed = [ROTARY.number(value, signed=True) for value in (0.5, -0.5, 0.0, -1e-9)]
    assert signed == ["+28.65", "-28.65", "0", "0"]
    assert [LINEAR.number(value, digits=0) for value in (0.1, -1e-9)] == ["100", "0"]


@pytest.mark.parametrize("unit", JointUnit)
def test_a_unit_is_found_by_each_of_its_quantities(unit: JointUnit) -> None:
    quantities = (unit.si, unit.speed, unit.acceleration, unit.effort_unit("Nm"))
    assert [JointUnit.find_by_quantity(one) for one in quantities] == [unit] * 4
    assert [unit.effort_unit(measured) for measured in ("A", "1")] == ["A", "1"]


def test_no_joint_has_a_quantity_of_another_unit() -> None:
    with pytest.raises(LookupError, match="A is not a unit of a joint"):
        JointUnit.find_by_quantity("A")


def test_plans_name_a_unit() -> None:
    assert msgspec.json.encode([ROTARY, LINEAR]) == b'["rad","m"]'
    assert msgspec.json.decode(b'"m"', type=JointUnit) is LINEAR
