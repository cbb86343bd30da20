"""Faults: a block of the lists has its parts, and is applied only where it fits."""

from __future__ import annotations

from pathlib import Path

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


@pytest.mark.parametrize(
    ("path", "first"),
    [
        ("runtime/dxlwire/exceptions.py", "tests/dxlwire/"),
        ("runtime/dxlrun/features/sensors/check.py", "tests/sensors/"),
        ("runtime/dxlrun/features/mechanics/drives.py", "tests/mechanics/"),
        ("runtime/dxlrun/control/gate.c", "tests/control/test_gate"),
        ("runtime/dxlrun/plan/robot_plan.py", "tests/compile/"),
        ("plugins/dxlrun_controllers/pid_controller.py", "tests/plugins/"),
        ("plugins/dxlrun_lab/stress.py", "tests/lab/"),
    ],
)
def test_room_has_its_tests(path: str, first: str) -> None:
    assert faults.tests_of(path)[0].startswith(first)


@pytest.mark.parametrize("ends", ["", "tests/x.py::test_it", "interrupt"])
def test_fault_is_taken_back_however_its_tests_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ends: str
) -> None:
    monkeypatch.setattr(faults, "ROOT", tmp_path)
    product = tmp_path / "product.py"
    product.write_text("a = 1\nb = 2\n")
    seen: list[str] = []

    def tests(_: object) -> str:
        seen.append(product.read_text())
        if ends == "interrupt":
            raise KeyboardInterrupt
        return ends

    monkeypatch.setattr(faults, "run_tests", tests)
    monkeypatch.setattr(faults, "tests_of", lambda _: [])
    fault = faults.Fault("product.py", "b is wrong", "b = 2", "b = 3", "")
    if ends == "interrupt":
        with pytest.raises(KeyboardInterrupt):
            faults.tried(fault, deep=False)
    else:
        result = faults.tried(fault, deep=False).result
        assert result == (f"found by: {ends}" if ends else "not found")
    assert seen == ["a = 1\nb = 3\n"]
    assert product.read_text() == "a = 1\nb = 2\n"
