"""Faults: a block of the lists has its parts, and is applied only where it fits."""

from __future__ import annotations

import pytest
from tests.faults import faults

BLOCK = """runtime/dxlrun/errors.py: nothing is missing
-     if not missing:
+     if missing:
found by: tests/test_errors.py::test_missing
"""


def test_block_has_its_parts() -> None:
    (fault,) = faults.parsed(BLOCK)
    assert fault == (
        "runtime/dxlrun/errors.py",
        "nothing is missing",
        "    if not missing:",
        "    if missing:",
        "found by: tests/test_errors.py::test_missing",
    )
    assert fault.text() + "\n" == BLOCK
    assert [*faults.problems(fault)] == []


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"path": "runtime/none.py"}, "is not a file"),
        ({"old": "    if nobody wrote this:"}, "occur 0 times"),
        ({"new": "    if not missing:"}, "changes nothing"),
    ],
)
def test_fault_that_cannot_be_applied_is_named(change: dict[str, str], problem: str) -> None:
    (fault,) = faults.parsed(BLOCK)
    assert problem in "".join(faults.problems(fault._replace(**change)))


def test_room_has_its_tests() -> None:
    assert faults.tests_of("runtime/dxlwire/packets.py") == ("tests/dxlwire", "tests/dynamixel")
    assert faults.tests_of("runtime/dxlrun/features/sensors/check.py") == ("tests/sensors", "tests/features")
    assert faults.tests_of("runtime/dxlrun/control/loop.py") == ("tests/control",)
    assert faults.tests_of("plugins/dxlrun_lab/stress.py") == ("tests/lab",)
