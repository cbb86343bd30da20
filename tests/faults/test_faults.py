"""Faults: a block of the lists has its parts, and is applied only where it fits; trials of them."""

from pathlib import Path

import pytest
from coverage import CoverageData
from tests.faults import faults, trials
from tests.faults.faults import Fault

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
    assert trials.tests_of(path)[0].startswith(first)


def test_tests_elsewhere_that_name_the_module_belong_to_a_fault() -> None:
    files = trials.tests_of("runtime/dxlrun/control/loop.py")
    assert "tests/control/test_loop.py" in files
    assert any(not file.startswith(("tests/control/", "tests/run/")) for file in files)
    assert len(files) == len(set(files))


def test_fault_is_taken_back_however_its_tests_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(faults, "ROOT", tmp_path)
    product = tmp_path / "product.py"
    product.write_text("a = 1\nb = 2\n")
    fault = Fault("product.py", "b is wrong", "b = 2", "b = 3", "")

    def interrupted() -> None:
        with faults.applied(fault):
            assert product.read_text() == "a = 1\nb = 3\n"
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert product.read_text() == "a = 1\nb = 2\n"


PRODUCT = """limit = 1

class Joint:
    def goal(self):
        return limit

    def counter(self):
        def count():
            return limit + 1
        return count
"""


@pytest.mark.parametrize(
    ("fault", "found"),
    [
        ("        return limit", ["goal[a|b]"]),
        ("            return limit + 1", ["count"]),
        ("        return count", ["count", "counter"]),
        ("limit = 1", []),
    ],
)
def test_tests_that_execute_a_faulty_function_are_those_of_coverage(
    fault: str, found: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(faults, "ROOT", tmp_path)
    (tmp_path / "product.py").write_text(PRODUCT)
    covered = CoverageData(no_disk=True)
    for line, name in ((5, "goal[a|b]|run"), (8, "counter|setup"), (9, "count|run"), (1, "")):
        covered.set_context(f"tests/test_x.py::{name}" if name else "")
        covered.add_lines({str(tmp_path / "product.py"): [line]})
    names = trials.tests_executing(Fault("product.py", "it is wrong", fault, "", ""), covered)
    assert names == [f"tests/test_x.py::{one}" for one in found]


TESTS = """
import signal, product

def test_without_the_fault_too():
    assert product.limit == 2

def test_limit():
    if product.limit == 2:
        signal.pause()
    assert product.limit == 1
"""


@pytest.mark.parametrize(
    ("new", "limit_s", "result"),
    [(0, 600.0, "found by: test_product.py::test_limit"), (2, 0.5, "not found")],
)
def test_failure_counts_that_is_due_to_the_fault_and_comes_in_time(
    new: int, limit_s: float, result: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(faults, "ROOT", tmp_path)
    monkeypatch.setattr(trials, "LIMIT_S", limit_s)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "product.py").write_text("limit = 1\n")
    (tmp_path / "test_product.py").write_text(TESTS)
    fault = Fault("product.py", "it is wrong", "limit = 1", f"limit = {new}", "")
    assert trials.result_of(fault, ["test_product.py"]) == result
