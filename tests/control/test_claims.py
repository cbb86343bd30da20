from __future__ import annotations

from dataclasses import dataclass

from dxlrun.control.controllers.claims import conflicts, conflicts_text


@dataclass(frozen=True)
class Wants:
    name: str
    joints: tuple[str, ...]
    command: tuple[str, ...] = ("position",)


def test_each_pair_that_claims_the_same_joints_is_named_once() -> None:
    found = conflicts(
        [Wants("left", ("a", "b", "c")), Wants("right", ("d",)), Wants("whole", tuple("abcde"))]
    )
    assert conflicts_text(found) == (
        "controllers left and whole both command joint a and 2 more; "
        "controllers right and whole both command joint d"
    )


def test_a_broadcaster_conflicts_with_no_controller() -> None:
    found = conflicts([Wants("all", ("a",)), Wants("eyes", ("a",), command=())])
    assert (found, conflicts_text(found)) == ((), "")
