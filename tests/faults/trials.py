"""Trials: tests run for each fault, in a process of its own, until one of them fails.

    pytest --cov --cov-context=test --cov-report=    # once: .coverage has the tests that execute each line
    python tests/faults/faults.py --try control.txt

The tests that execute a function of the fault in the process of pytest run; where there are none, those of
its room, and those that name its module. pytest collects them once; for each fault a copy of that process
(fork) gives the functions of the faulty file their new code, and what tests start themselves reads that file.
A fault in C, or outside of functions, has a pytest of its own. A test that fails without the fault too has
not found it, and what takes longer than the limit finds nothing: nobody would wait for it.
"""

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
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from functools import cache, partial
from multiprocessing.connection import Connection
from pathlib import Path
from types import CodeType
from typing import NamedTuple

import pytest
from coverage import CoverageData
from tests.faults import faults
from tests.faults.faults import ROOT, Fault
from tests.kit import selection

LIMIT_S = 60.0
FORK = multiprocessing.get_context("fork")
NOT_LOADED = "not loaded"


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


class Trial(NamedTuple):
    """A fault, and what decides which tests run for it."""

    fault: Fault
    right: str
    """The file without the fault."""
    wrong: str
    """The file with the fault."""
    executing: frozenset[str]
    """Tests that execute a function of the fault in the process of pytest."""

    @property
    def files(self) -> list[str]:
        """The test files that run, most likely ones first."""
        own = tests_of(self.fault.path)
        return [*own, *sorted({name.partition("::")[0] for name in self.executing} - {*own})]

    def chosen(self, items: Sequence[pytest.Item]) -> list[pytest.Item]:
        """Return the tests that run, most likely ones first."""
        own = {*tests_of(self.fault.path)}
        ranks = {file: rank for rank, file in enumerate(self.files)}
        by_file = [(item.nodeid.partition("::")[0], item) for item in items]
        if self.executing:
            chosen = [(file, item) for file, item in by_file if item.nodeid in self.executing]
        else:
            chosen = [(file, item) for file, item in by_file if file in own]
        return [item for _, item in sorted(chosen, key=lambda one: ranks[one[0]])]


def trial_of(fault: Fault, covered: CoverageData) -> Trial:
    right, wrong = faults.texts_of(fault)
    lines: set[int] = set()
    if is_loadable(fault.path, right, wrong):
        codes, changed = ({*functions_of(compile(text, fault.path, "exec"))} for text in (right, wrong))
        kept = {code for _, _, code in changed}
        lines = {line for _, _, code in codes if code not in kept for *_, line in code.co_lines() if line}
    by_line = covered.contexts_by_lineno(str(ROOT / fault.path))
    names = {name.rpartition("|")[0] for line in lines for name in by_line.get(line, ())}
    return Trial(fault, right, wrong, frozenset(names - {""}))


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


def is_loadable(path: str, right: str, wrong: str) -> bool:
    """Return whether a fault is in bodies of Python functions only."""
    return path.endswith(".py") and outside_functions(right) == outside_functions(wrong)


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


class Trials:
    """Plugin: runs the collected tests for each fault, and sends the first that fails."""

    def __init__(self, trials: Sequence[Trial], results: Connection, *, is_present: bool) -> None:
        self._trials = trials
        self._results = results
        self._is_present = is_present

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        """Run the tests in a copy of this process for each fault."""
        for trial in self._trials:
            items = trial.chosen(session.items)
            while True:
                with nullcontext() if self._is_present else faults.applied(trial.fault):
                    found = in_copy(partial(self._failure_of, session, items, trial))
                alone = [item for item in items if item.nodeid in found]
                if self._is_present or not alone or not in_copy(partial(failures, session, alone)):
                    break
                items.remove(alone[0])  # it fails without the fault too
            self._results.send(found)
        return True

    def _failure_of(self, session: pytest.Session, items: Sequence[pytest.Item], trial: Trial) -> list[str]:
        """Return the first test that fails with a fault in this process."""
        path = ROOT / trial.fault.path
        if not self._is_present and not load(path, trial.right, trial.wrong):
            return [NOT_LOADED]
        return failures(session, items)


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


def failures(session: pytest.Session, items: Sequence[pytest.Item]) -> list[str]:
    """Run tests until one fails; return it."""
    failed: list[str] = []

    class Reports:
        def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
            if report.failed:
                failed.append(report.nodeid)

    session.config.pluginmanager.register(Reports())
    for item, following in itertools.zip_longest(items, items[1:]):
        item.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
        if failed:
            session._setupstate.teardown_exact(None)
            break
    return failed


def run_session(trials: Sequence[Trial], results: Connection, *, is_present: bool) -> None:
    """Collect and run the tests of faults in this process, without a word."""
    with open(os.devnull, "w") as nowhere:
        os.dup2(nowhere.fileno(), 1)
        os.dup2(nowhere.fileno(), 2)
    words = ["-q", "-n", "0", "-p", "no:cacheprovider", "--timeout=120"]
    words += ["-W", "ignore::pytest.PytestAssertRewriteWarning"]  # of plugins that this program has imported
    files = dict.fromkeys(file for trial in trials for file in trial.files if (ROOT / file).is_file())
    pytest.main([*words, *files], plugins=[Trials(trials, results, is_present=is_present)])


def results_of(trials: Sequence[Trial], *, is_present: bool) -> Iterator[Fault]:
    """Yield faults with their results."""
    answer, results = FORK.Pipe(duplex=False)
    session = FORK.Process(target=run_session, args=(trials, results), kwargs={"is_present": is_present})
    session.start()
    results.close()
    for trial in trials:
        try:
            found = answer.recv()
        except EOFError:  # pytest ended before its tests: the fault shows when they are collected
            found = ["collection of the tests" if is_present else NOT_LOADED]
        yield trial.fault._replace(result=f"found by: {found[0]}" if found else "not found")
    session.join()


def build() -> None:
    """Compile the C sources again."""
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "-e", "."]
    subprocess.run(command, cwd=ROOT, check=True)


def tried(untried: Sequence[Fault]) -> Iterator[Fault]:
    """Yield faults with their results."""
    covered = CoverageData(str(ROOT / ".coverage"))
    covered.read()
    alone = []
    loadable = []
    for trial in (trial_of(fault, covered) for fault in untried):
        can = is_loadable(trial.fault.path, trial.right, trial.wrong)
        (loadable if can else alone).append(trial)
    for trial, fault in zip(loadable, results_of(loadable, is_present=False), strict=True):
        if fault.result == f"found by: {NOT_LOADED}":
            alone.append(trial)
        else:
            yield fault
    for trial in alone:
        is_compiled = trial.fault.path.endswith(".c")
        try:
            with faults.applied(trial.fault):
                if is_compiled:
                    build()
                yield from results_of([trial], is_present=True)
        finally:
            if is_compiled:
                build()
