"""Claims: what two controllers may not have both."""

from __future__ import annotations

from typing import Any

from tests.kit.loops import plan_of

from dxlrun.control.controllers.claims import claimed_modes, conflicts, conflicts_text
from dxlrun.plan.loop_plan import ControllerPlan
from dxlwire.modes import Mode


def wants(name: str, joints: Any, command: Any = ("position",), **more: Any) -> ControllerPlan:
    exports = {"reference": ("position", "effort")}
    return plan_of(name, joints=joints, command=command, **exports | more)


def test_each_pair_that_claims_the_same_joints_is_named_once():
    found = conflicts(
        [wants("left", ("a", "b", "c")), wants("right", ("d",)), wants("whole", tuple("abcde"))]
    )
    assert conflicts_text(found) == (
        "controllers left and whole both command joint a and 2 more; "
        "controllers right and whole both command joint d"
    )


def test_a_reference_is_claimed_by_joint_and_interface():
    found = conflicts(
        [
            wants("pid", ("a", "b")),
            wants("arm", ("a", "b"), into=("pid",)),
            wants("gravity", ("a", "b"), command=("effort",), into=("pid",)),
            wants("whole", ("b", "c"), into=("other", "pid")),
        ]
    )
    assert [str(conflict) for conflict in found] == ["controllers arm and whole both command pid/b/position"]


def test_a_command_of_a_device_is_claimed_once():
    one, two = (wants(name, (), (), source_commands=("light/led",)) for name in ("one", "two"))
    (found,) = conflicts([one, two, wants("three", (), (), source_commands=("light/buzzer",))])
    assert (found.holder, found.other) == ("one", "two")
    assert "light/led" in str(found)


def test_a_joint_is_claimed_at_the_one_that_exports_it():
    lower = [wants("left", ("a",)), wants("spare", ("a",), command=()), wants("right", ("b", "c"))]
    first = wants("first", ("a", "b"), into=("left", "right"))
    assert not conflicts([*lower, first, wants("second", ("a", "c"), into=("spare", "right"))])
    (found,) = conflicts([*lower, first, wants("second", ("a", "b"), into=("spare", "right"))])
    assert found.reference == "right/b/position"


def test_a_chained_controller_leaves_the_servo_to_the_one_below():
    assert not conflicts([wants("pid", ("a",)), wants("arm", ("a",), into=("pid",))])
    assert claimed_modes(
        [wants("pid", ("a",), command=("effort",)), wants("arm", ("a",), into=("pid",))]
    ) == {"a": Mode.EFFORT}


def test_a_broadcaster_conflicts_with_no_controller():
    found = conflicts([wants("all", ("a",)), wants("eyes", ("a",), command=())])
    assert (found, conflicts_text(found)) == ((), "")
