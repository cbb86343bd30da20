"""Trials: the tests of a room run for each fault, in a process of its own, until one of them fails.

pytest collects the tests of a room once. For each fault a copy of that process (fork) gives the functions of
the faulty file their new code; what tests start themselves reads the faulty file. A fault in C, or outside of
functions, has a pytest of its own. What takes longer than the limit has not found the fault: a test that
nobody waits for finds nothing.
"""

from __future__ import annotations

import ast
import gc
import inspect
import itertools
import multiprocessing
import os
import re
import signal
import subprocess
import sys
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from types import CodeType

import pytest
from tests.faults import faults
from tests.faults.faults import ROOT, Fault
from tests.kit import selection

LIMIT_S = 240.0
FORK = multiprocessing.get_context("fork")
NOT_LOADED = "not loaded"


def tests_of(path: str) -> list[str]:
    """Return the short test files of the room of a product file, and those that name its module elsewhere."""
    module = selection.module_of(path)
    parent, _, name = module.rpartition(".")
    names = re.compile(rf"\b({re.escape(module)}|from {re.escape(parent)} import .*\b{re.escape(name)})\b")
    long = {name for name, _ in selection.long_files()}
    files = [
        file for file in sorted(ROOT.glob("tests/**/test_*.py")) if str(file.relative_to(ROOT)) not in long
    ]
    naming = [file for file in files if names.search(file.read_text("utf-8"))]
    folders = [ROOT / "tests" / folder for folder in selection.tests_of(selection.room_of(module))]
    in_room = [file for folder in folders for file in files if file.is_relative_to(folder)]
    in_room.sort(key=lambda file: file not in naming)
    return [str(file.relative_to(ROOT)) for file in dict.fromkeys([*in_room, *naming])]


def functions_of(code: CodeType) -> Iterator[tuple[str, int, CodeType]]:
    """Yield name, first line and code of each function of a module, and of those inside of functions."""
    for one in code.co_consts:
        if isinstance(one, CodeType):
            yield one.co_qualname, one.co_firstlineno, one
            yield from functions_of(one)


def outside_functions(text: str) -> str:
    """Return a module without the bodies of its functions."""
    tree = ast.parse(text)
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            node.body = []
    return ast.dump(tree)


def is_loadable(fault: Fault) -> bool:
    """Return whether a fault is in bodies of Python functions only."""
    if not fault.path.endswith(".py"):
        return False
    right, wrong = faults.texts_of(fault)
    return outside_functions(right) == outside_functions(wrong)


def load(path: Path, right: str, wrong: str) -> bool:
    """Give the functions of this process the code of a faulty file; False if they cannot have it."""
    rights, wrongs = (
        [*functions_of(compile(text, path, "exec", dont_inherit=True))] for text in (right, wrong)
    )
    if [name for name, _, _ in rights] != [name for name, _, _ in wrongs]:
        return False
    codes = {(name, line): code for (name, line, _), (_, _, code) in zip(rights, wrongs, strict=True)}
    gc.unfreeze()  # get_objects does not list what is frozen
    for function in filter(inspect.isfunction, gc.get_objects()):
        old = function.__code__
        new = codes.get((old.co_qualname, old.co_firstlineno)) if old.co_filename == str(path) else None
        if new is not None:
            if old.co_freevars != new.co_freevars:
                return False
            function.__code__ = new
    return True


class Trial:
    """Plugin: runs the collected tests for each fault, and reports the first that fails."""

    def __init__(self, tried: Sequence[Fault], results: Connection, *, is_present: bool) -> None:
        self._faults = tried
        self._results = results
        self._is_present = is_present

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        """Run the tests in a copy of this process for each fault."""
        by_file = defaultdict(list)
        for item in session.items:
            by_file[item.nodeid.partition("::")[0]].append(item)
        failing: list[str] = []
        if not self._is_present:
            failing = in_copy(partial(failures, session, session.items, most=None), limit_s=4 * LIMIT_S)
        for fault in self._faults:
            passing = [
                item for file in tests_of(fault.path) for item in by_file[file] if item.nodeid not in failing
            ]
            if self._is_present:
                found = in_copy(partial(failures, session, passing, most=1))
            else:
                texts = faults.texts_of(fault)
                with faults.applied(fault):
                    found = in_copy(partial(self._failures_with, session, passing, fault.path, texts))
            self._results.send(found)
        return True

    def _failures_with(
        self, session: pytest.Session, items: Sequence[pytest.Item], path: str, texts: tuple[str, str]
    ) -> list[str]:
        """Load the faulty text of a file, and return the first test that fails."""
        return failures(session, items, most=1) if load(ROOT / path, *texts) else [NOT_LOADED]


def in_copy(function: Callable[[], list[str]], limit_s: float = LIMIT_S) -> list[str]:
    """Return what a function returns in a copy of this process; nothing if it takes too long."""
    answer, question = FORK.Pipe(duplex=False)
    if (copy := os.fork()) == 0:
        os.setpgid(0, 0)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        try:
            question.send(function())
        finally:
            os._exit(0)
    question.close()
    try:
        return answer.recv() if answer.poll(limit_s) else []
    except EOFError:
        return ["pytest died"]
    finally:
        os.kill(copy, signal.SIGINT)  # lets the tests end what they started
        if not answer.poll(20.0):
            os.killpg(copy, signal.SIGKILL)
        os.waitpid(copy, 0)


def failures(session: pytest.Session, items: Sequence[pytest.Item], *, most: int | None) -> list[str]:
    """Run tests, until as many have failed; return those that failed."""
    failed: list[str] = []

    class Reports:
        def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
            if report.failed:
                failed.append(report.nodeid)

    session.config.pluginmanager.register(Reports())
    for item, following in itertools.zip_longest(items, items[1:]):
        item.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
        if len(failed) == most:
            session._setupstate.teardown_exact(None)
            break
    return failed


def run_session(tried: Sequence[Fault], results: Connection, *, is_present: bool) -> None:
    """Collect and run the tests of faults in this process, without a word."""
    with open(os.devnull, "w") as nowhere:
        os.dup2(nowhere.fileno(), 1)
        os.dup2(nowhere.fileno(), 2)
    words = ["-q", "-n", "0", "-p", "no:cacheprovider", "--timeout=120"]
    words += ["-W", "ignore::pytest.PytestAssertRewriteWarning"]  # of plugins that this program has imported
    files = sorted({file for fault in tried for file in tests_of(fault.path)})
    pytest.main([*words, *files], plugins=[Trial(tried, results, is_present=is_present)])


def results_of(group: Sequence[Fault], *, is_present: bool) -> Iterator[Fault]:
    """Yield faults of one room with their results."""
    answer, results = FORK.Pipe(duplex=False)
    session = FORK.Process(target=run_session, args=(group, results), kwargs={"is_present": is_present})
    session.start()
    results.close()
    for fault in group:
        try:
            found = answer.recv()
        except EOFError:  # pytest ended before its tests: the fault shows when they are collected
            found = ["collection of the tests" if is_present else NOT_LOADED]
        yield fault._replace(result=f"found by: {found[0]}" if found else "not found")
    session.join()


def build() -> None:
    """Compile the C sources again."""
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "-e", "."]
    subprocess.run(command, cwd=ROOT, check=True)


def tried(untried: Sequence[Fault]) -> Iterator[Fault]:
    """Yield faults with their results."""
    groups = defaultdict(list)
    alone = []
    for fault in untried:
        room = selection.room_of(selection.module_of(fault.path))
        (groups[room] if is_loadable(fault) else alone).append(fault)
    for group in groups.values():
        for fault in results_of(group, is_present=False):
            if fault.result == f"found by: {NOT_LOADED}":
                alone.append(fault._replace(result=""))
            else:
                yield fault
    for fault in alone:
        is_compiled = fault.path.endswith(".c")
        try:
            with faults.applied(fault):
                if is_compiled:
                    build()
                yield from results_of([fault], is_present=True)
        finally:
            if is_compiled:
                build()
