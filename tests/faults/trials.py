"""Trials: tests run for each fault, in a pytest of its own, until one of them fails.

    pytest --cov --cov-context=test --cov-report=    # once: .coverage has the tests that execute each line
    python tests/faults/faults.py --try control.txt

The tests that execute the function of the fault in the process of pytest run; where there are none, those of
its room, and those that name its module. A test that fails without the fault too, or
takes longer than the limit, has not found it.
"""

import ast
import multiprocessing
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from multiprocessing.connection import Connection
from pathlib import Path

import pytest
from coverage import CoverageData
from tests.faults import faults
from tests.faults.faults import ROOT, Fault
from tests.kit import selection
from tests.kit.nested import forget_outer_pytest

LIMIT_S = 120.0
FORK = multiprocessing.get_context("fork")
WORDS = ["-q", "-x", "-n", "0", "-p", "no:cacheprovider", "--timeout=120"]
WORDS += ["-W", "ignore::pytest.PytestAssertRewriteWarning"]  # of plugins that this program has imported


def tests_of(path: str) -> list[str]:
    """Return the short test files of the room of a product file, and those that name its module elsewhere."""
    module = selection.module_of(path)
    parent, _, name = module.rpartition(".")
    names = re.compile(rf"\b({re.escape(module)}|from {re.escape(parent)} import .*\b{re.escape(name)})\b")
    folders = [ROOT / "tests" / folder for folder in selection.tests_of(selection.room_of(module))]
    files = short_files()
    in_room = [file for folder in folders for file in files if file.is_relative_to(folder)]
    naming = [file for file, text in files.items() if names.search(text)]
    in_room.sort(key=lambda file: file not in naming)
    return [str(file.relative_to(ROOT)) for file in dict.fromkeys([*in_room, *naming])]


@cache
def short_files() -> dict[Path, str]:
    """Return the files of short tests with their texts."""
    long = {name for name, _ in selection.long_files()}
    files = sorted(ROOT.glob("tests/**/test_*.py"))
    return {file: file.read_text("utf-8") for file in files if str(file.relative_to(ROOT)) not in long}


def tests_executing(fault: Fault, covered: CoverageData) -> list[str]:
    """Return the tests that execute the function of a fault in the process of pytest, those of its room
    first."""
    if not fault.path.endswith(".py"):
        return []
    text, _ = faults.texts_of(fault)
    first = text[: text.index(f"{fault.old}\n")].count("\n") + 1
    around = [
        node
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.FunctionDef) and node.lineno <= first <= (node.end_lineno or 0)
    ]
    function = max(around, key=lambda node: node.lineno, default=None)
    lines = range(function.body[0].lineno, (function.end_lineno or 0) + 1) if function else ()
    by_line = covered.contexts_by_lineno(str(faults.ROOT / fault.path))
    names = {name.rpartition("|")[0] for line in lines for name in by_line.get(line, ())}
    own = {*tests_of(fault.path)}
    return sorted(names - {""}, key=lambda name: (name.partition("::")[0] not in own, name))


def first_failure(tests: Sequence[str], *, omitted: Sequence[str] = ()) -> str:
    """Run tests until one fails; return it, and nothing where none fails within the limit."""
    answer, question = FORK.Pipe(duplex=False)
    session = FORK.Process(target=run_session, args=(tests, omitted, question))
    session.start()
    question.close()
    try:
        if answer.poll(LIMIT_S):
            return str(answer.recv())
        os.kill(session.pid or 0, signal.SIGINT)  # lets the tests end what they started
        session.join(20.0)
        session.kill()
        return ""
    except EOFError:
        return "pytest died"
    finally:
        session.join()


class FirstFailure:
    """Plugin: has the first test or file that failed."""

    name = ""

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed:
            self.name = self.name or report.nodeid

    def pytest_collectreport(self, report: pytest.CollectReport) -> None:
        if report.failed:
            self.name = self.name or report.nodeid


def run_session(tests: Sequence[str], omitted: Sequence[str], question: Connection) -> None:
    """Run tests in this process, without a word, and send what failed first."""
    sys.dont_write_bytecode = True  # it counts for each text of a file that has its size and second
    signal.signal(signal.SIGINT, signal.default_int_handler)
    with open(os.devnull, "w") as nowhere:
        os.dup2(nowhere.fileno(), 1)
        os.dup2(nowhere.fileno(), 2)
    failure = FirstFailure()
    with pytest.MonkeyPatch.context() as patch:
        forget_outer_pytest(patch)
        pytest.main([*WORDS, *tests, *(f"--deselect={test}" for test in omitted)], plugins=[failure])
    question.send(failure.name)


@contextmanager
def installed(fault: Fault) -> Iterator[None]:
    """Apply a fault, and compile C sources again, before and at the end."""
    is_compiled = fault.path.endswith(".c")
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "-e", "."]
    try:
        with faults.applied(fault):
            if is_compiled:
                subprocess.run(command, cwd=ROOT, check=True)
            yield
    finally:
        if is_compiled:
            subprocess.run(command, cwd=ROOT, check=True)


def result_of(fault: Fault, tests: Sequence[str]) -> str:
    """Return which of the tests finds a fault."""
    failing: list[str] = []
    while True:
        with installed(fault):
            found = first_failure(tests, omitted=failing)
        if "::" not in found or not first_failure([found]):
            return f"found by: {found}" if found else "not found"
        failing.append(found)  # it fails without the fault too


def tried(untried: Sequence[Fault]) -> Iterator[Fault]:
    """Yield faults with their results."""
    covered = CoverageData(str(ROOT / ".coverage"))
    covered.read()
    for fault in untried:
        tests = tests_executing(fault, covered) or tests_of(fault.path)
        yield fault._replace(result=result_of(fault, tests))
