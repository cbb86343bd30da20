"""Faults: a block of the lists has its parts, and is applied only where it fits."""

import gc
import time
from pathlib import Path

import pytest
from coverage import CoverageData
from tests.faults import faults, trials
from tests.faults.faults import Fault
from tests.kit.loaded import loaded

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


PRODUCT = """class Joint:
    def __init__(self):
        self.angle = 1

    @property
    def goal(self):
        return self.angle

    @goal.setter
    def goal(self, goal):
        self.angle = goal

def counter():
    number = 0
    def count():
        nonlocal number
        number += 1
        return number
    return count
"""


@pytest.mark.parametrize(
    ("old", "new", "goals", "counts"),
    [
        ("self.angle = goal", "self.angle = -goal", (1, -5), (1, 2)),
        ("return self.angle", "return 2 * self.angle", (2, 10), (1, 2)),
        ("number += 1", "number += 3", (1, 5), (1, 4)),  # what counted before goes on with its own number
    ],
)
def test_functions_that_are_in_use_get_the_fault(
    tmp_path: Path, old: str, new: str, goals: tuple[int, int], counts: tuple[int, int]
) -> None:
    path = tmp_path / "product.py"
    path.write_text(PRODUCT)
    product = loaded(path)
    joint, count = product.Joint(), product.counter()
    seen = [count()]
    gc.freeze()  # as commands do
    assert trials.load(path, PRODUCT, PRODUCT.replace(old, new))
    before, joint.goal = joint.goal, 5
    assert (before, joint.goal) == goals
    assert (*seen, count()) == counts


@pytest.mark.parametrize(
    ("old", "new", "can"),
    [
        ("number = 0", "number = 1", True),
        ("class Joint:", "class Joint(Exception):", False),
        ("def goal(self, goal):", "def goal(self, goal=0):", False),
    ],
)
def test_fault_outside_of_functions_needs_a_pytest_of_its_own(old: str, new: str, can: bool) -> None:
    assert trials.is_loadable("product.py", PRODUCT, PRODUCT.replace(old, new)) is can


def test_tests_that_execute_a_faulty_function_are_those_of_coverage(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(faults, "ROOT", tmp_path)
    monkeypatch.setattr(trials, "ROOT", tmp_path)
    (tmp_path / "product.py").write_text(PRODUCT)
    covered = CoverageData(no_disk=True)
    for line, name in ((7, "goal[a|b]|run"), (11, "angle|setup"), (17, "count|run"), (1, "")):
        covered.set_context(f"tests/test_x.py::{name}" if name else "")
        covered.add_lines({str(tmp_path / "product.py"): [line]})
    fault = Fault("product.py", "it counts twice", "        number += 1", "        number += 2", "")
    assert trials.trial_of(fault, covered).executing == {"tests/test_x.py::count"}
    fault = Fault("product.py", "the angle", "        return self.angle", "        return 0", "")
    assert trials.trial_of(fault, covered).executing == {"tests/test_x.py::goal[a|b]"}


def test_what_takes_too_long_finds_nothing() -> None:
    def last_word() -> list[str]:
        time.sleep(60.0)
        return ["late"]

    assert trials.in_copy(lambda: ["tests/x.py::test_it"]) == ["tests/x.py::test_it"]
    assert trials.in_copy(last_word, limit_s=0.2) == []
