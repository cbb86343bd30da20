from __future__ import annotations

from dataclasses import dataclass

from dxlrun.control.controllers.claims import claimed_modes, conflicts, conflicts_text
from dxlrun.description.modes import Mode


@dataclass(frozen=True)
class Wants:
    name: str
    joints: tuple[str, ...]
    command: tuple[str, ...] = ("position",)
    into: tuple[str, ...] = ()
    reference: tuple[str, ...] = ("position", "effort")
    device_commands: tuple[str, ...] = ()


def test_each_pair_that_claims_the_same_joints_is_named_once() -> None:
    found = conflicts(
        [Wants("left", ("a", "b", "c")), Wants("right", ("d",)), Wants("whole", tuple("abcde"))]
    )
    assert conflicts_text(found) == (
        "controllers left and whole both command joint a and 2 more; "
        "controllers right and whole both command joint d"
    )


def test_a_reference_is_claimed_by_joint_and_interface() -> None:
    found = conflicts(
        [
            Wants("pid", ("a", "b")),
            Wants("arm", ("a", "b"), into=("pid",)),
            Wants("gravity", ("a", "b"), command=("effort",), into=("pid",)),
            Wants("whole", ("b", "c"), into=("other", "pid")),
        ]
    )
    assert [str(conflict) for conflict in found] == ["controllers arm and whole both command pid/b/position"]


def test_a_command_of_a_device_is_claimed_once() -> None:
    one, two = (Wants(name, (), (), device_commands=("light/led",)) for name in ("one", "two"))
    (found,) = conflicts([one, two, Wants("three", (), (), device_commands=("light/buzzer",))])
    assert (found.holder, found.other) == ("one", "two")
    assert "light/led" in str(found)


def test_a_joint_is_claimed_at_the_one_that_exports_it() -> None:
    lower = [Wants("left", ("a",)), Wants("spare", ("a",), command=()), Wants("right", ("b", "c"))]
    first = Wants("first", ("a", "b"), into=("left", "right"))
    assert not conflicts([*lower, first, Wants("second", ("a", "c"), into=("spare", "right"))])
    (found,) = conflicts([*lower, first, Wants("second", ("a", "b"), into=("spare", "right"))])
    assert found.reference == "right/b/position"


def test_a_chained_controller_leaves_the_servo_to_the_one_below() -> None:
    assert not conflicts([Wants("pid", ("a",)), Wants("arm", ("a",), into=("pid",))])
    assert claimed_modes(
        [Wants("pid", ("a",), command=("effort",)), Wants("arm", ("a",), into=("pid",))]
    ) == {"a": Mode.EFFORT}


def test_a_broadcaster_conflicts_with_no_controller() -> None:
    found = conflicts([Wants("all", ("a",)), Wants("eyes", ("a",), command=())])
    assert (found, conflicts_text(found)) == ((), "")
