"""Every property draws the same examples at each run; a random search is asked for by its profile.

A find of a fixed run repeats itself: run the test again. A random search prints how to repeat its find:

    python -m pytest --hypothesis-profile=search tests/description
"""

import gc
import os
import re
import signal
from collections.abc import Callable, Generator, Iterator
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple, TypeVar

import pytest
import pytest_timeout
from hypothesis import settings
from tests.kit import campaigns, selection, skips

settings.register_profile("fixed", derandomize=True, print_blob=True)
settings.register_profile("search", derandomize=False, print_blob=True, max_examples=2000)
settings.load_profile("fixed")
# each process that a test starts would compile all that it imports: a run takes 4 s of a processor, not 1.5 s
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
# with two threads for each process numpy waits for cores that others have, at 70 times the processor time
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
gc.set_threshold(50_000, 20, 20)  # as in `dxlrun`: the many tests that are collected are no garbage


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """Use all cores for the whole suite, and this process alone for what is named.

    Tests wait for robots in real time for a third of their time, long ones for half of it: three workers fill
    two cores, or four of them with `--all`.
    """
    whole = config.args_source is not pytest.Config.ArgsSource.ARGS
    return (os.cpu_count() or 1) * (4 if config.getoption("--all") else 3) // 2 if whole else 0


EXTRAS: dict[str, tuple[str, ...]] = {
    "report": ("bokeh", "matplotlib"),
    "logs": ("duckdb", "pyarrow"),
    "store": ("fsspec", "s3fs"),
    "physics": ("mujoco",),
    "identify": ("scipy", "matplotlib"),
    "foxglove": ("websockets",),
    "network": ("cryptography",),
    "release": ("twine", "ziglang"),
    "foreign": ("Phidget22", "ahrs", "foxglove", "pinocchio", "pymcap_cli", "pypot", "rerun"),
}
"""Extras that the extra `test` does not have, each with its modules."""
MISSING = {module for modules in EXTRAS.values() for module in modules if find_spec(module) is None}


def extra_of(error: BaseException | None) -> str:
    """Return the extra whose missing module an import did not find; empty where that is not the error."""
    root = (getattr(error, "name", None) or "").partition(".")[0]
    if not isinstance(error, ImportError) or root not in MISSING:
        return ""
    return next(extra for extra, modules in EXTRAS.items() if root in modules)


def is_own_import(excinfo: pytest.ExceptionInfo[BaseException], item: pytest.Item) -> bool:
    """Check whether an import statement of the tests raised an error, not a function that they called.

    Behind the last frame of the tests there is then nothing but the code of modules.
    """
    frames = list(excinfo.traceback)
    tests = [index for index, frame in enumerate(frames) if _is_of_tests(Path(frame.path), item)]
    return bool(tests) and all(frame.name == "<module>" for frame in frames[tests[-1] + 1 :])


def _is_of_tests(path: Path, item: pytest.Item) -> bool:
    return path == item.path or path.is_relative_to(Path(__file__).parent)


Report = TypeVar("Report", pytest.TestReport, pytest.CollectReport)


def skip(report: Report, where: pytest.Item | pytest.Collector, extra: str) -> Report:
    """Make a skip of a failure whose error is a missing extra: CI installs them all."""
    if extra and report.failed:
        report.outcome = "skipped"
        report.longrepr = (str(where.path), 0, f"needs dxlrun[{extra}]")
    return report


def named_extra(reason: str) -> str:
    """Return the extra that the reason of a skip names, ours or that of `pytest.importorskip`; else empty."""
    if needed := re.search(r"needs dxlrun\[(\w+)\]", reason):
        return needed[1]
    module = re.search(r"No module named '([\w.]+)'", reason)
    return extra_of(ModuleNotFoundError(name=module[1])) if module else ""


class Extras:
    """Skips what lacks an extra; a plugin, as hooks of this file miss those of other conftests.

    That is what imports a missing module itself, and what is marked with its extra, as tests of commands are:
    `pytest.mark.needs("report")`. A failure of any other kind stays one, whatever its text has.
    """

    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        for item in items:
            for mark in item.iter_markers("needs"):
                if not MISSING.isdisjoint(EXTRAS[mark.args[0]]):
                    item.add_marker(pytest.mark.skip(reason=f"needs dxlrun[{mark.args[0]}]"))

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(
        self, item: pytest.Item, call: pytest.CallInfo[None]
    ) -> Generator[None, pytest.TestReport, pytest.TestReport]:
        report = yield
        error = call.excinfo
        return skip(
            report, item, extra_of(error.value) if error is not None and is_own_import(error, item) else ""
        )

    @pytest.hookimpl(wrapper=True)
    def pytest_make_collect_report(
        self, collector: pytest.Collector
    ) -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
        report = yield
        call = getattr(report, "call", None)  # pytest keeps it in a report of a failure
        if call is None or call.excinfo is None:
            return report
        error = call.excinfo.value  # its cause is the import's error
        return skip(report, collector, extra_of(getattr(error, "cause", None) or error.__cause__))

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        """Name in one line what was not run for want of extras."""
        absent: dict[str, set[str]] = {}
        for report in terminalreporter.stats.get("skipped", []):
            path, _, reason = report.longrepr if isinstance(report.longrepr, tuple) else ("", 0, "")
            if extra := named_extra(reason):
                absent.setdefault(f"dxlrun[{extra}]", set()).add(Path(path).stem.removeprefix("test_"))
        if absent:
            parts = (f"{', '.join(sorted(files))} needs {extra}" for extra, files in sorted(absent.items()))
            terminalreporter.write_line(f"not run: {'; '.join(parts)}")


def pytest_addoption(parser: pytest.Parser) -> None:
    campaigns.add_options(parser)
    selection.add_options(parser)
    skips.add_options(parser)


def pytest_configure(config: pytest.Config) -> None:
    config.pluginmanager.register(Extras())
    config.pluginmanager.register(campaigns.Campaigns(config))
    config.pluginmanager.register(selection.Selection(config))
    config.pluginmanager.register(skips.Skips(config))
    # a shell ignores Ctrl-C for what it starts in the background, and what that starts inherits it
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.hookimpl(optionalhook=True, tryfirst=True)
def pytest_timeout_set_timer(item: pytest.Item, settings: pytest_timeout.Settings) -> object:
    """Give a test longer on a busy machine: its limit is there to end a hang."""
    busy = max(1.0, os.getloadavg()[0] / (os.cpu_count() or 1))
    longer = settings._replace(timeout=settings.timeout * busy)
    return pytest_timeout.pytest_timeout_set_timer(item, longer)


def pytest_collection_finish() -> None:
    """Remove the tests from the collector's sight: a full collection would look at them all again."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def _no_state_of_a_user(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Have a directory for what controllers learn, and one for the sockets of robots; processes inherit both.

    Else a test finds the robot of another worker, or of another person, that has the same name.
    """
    with pytest.MonkeyPatch.context() as patch:
        for name in ("STATE_HOME", "RUNTIME_DIR"):
            patch.setenv(f"XDG_{name}", str(tmp_path_factory.mktemp(name.lower())))
        yield


class Listening(NamedTuple):
    """What a process and its descendants listen on."""

    network: list[str]
    """Addresses of TCP and UDP, as /proc/net has them"""
    unix: list[str]
    """Paths; those of abstract sockets, which have no mode, begin with @"""


def _with_descendants(pid: int) -> Iterator[int]:
    yield pid
    with suppress(OSError):
        for task in Path(f"/proc/{pid}/task").iterdir():
            for child in (task / "children").read_text().split():
                yield from _with_descendants(int(child))


def listening(pid: int) -> Listening:
    """Return what a process and its descendants listen on, from /proc/PID/fd and /proc/net (proc(5))."""
    inodes = set()
    for one in _with_descendants(pid):
        with suppress(OSError):
            for link in Path(f"/proc/{one}/fd").iterdir():
                with suppress(OSError):
                    inodes.add(os.readlink(link).removeprefix("socket:[").removesuffix("]"))
    network, unix = [], []
    for name in ("tcp", "tcp6", "udp", "udp6"):
        for line in Path(f"/proc/net/{name}").read_text().splitlines()[1:]:
            words = line.split()
            if words[9] in inodes and (words[3] == "0A" or name.startswith("udp")):
                network.append(f"{name} {words[1]}")
    for line in Path("/proc/net/unix").read_text().splitlines()[1:]:
        words = line.split()
        if words[6] in inodes and int(words[3], 16) & 0x10000:  # __SO_ACCEPTCON
            unix.append(words[7] if len(words) > 7 else "")
    return Listening(network, unix)


@pytest.fixture(name="listening")
def _listening() -> Callable[[int], Listening]:
    return listening


@pytest.fixture
def no_memory_left(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Close the descriptors of shared memory that a test leaves open: a process has some hundred of them.

    Only those that were made here: a mapping has a descriptor of its own, which it closes itself.
    """
    made: list[tuple[int, int]] = []
    create = os.memfd_create

    def recorded(name: str, flags: int = os.MFD_CLOEXEC) -> int:
        descriptor = create(name, flags)
        made.append((descriptor, os.fstat(descriptor).st_ino))
        return descriptor

    monkeypatch.setattr(os, "memfd_create", recorded)
    yield
    for descriptor, inode in made:
        with suppress(OSError):  # the test has closed it
            if os.fstat(descriptor).st_ino == inode:
                os.close(descriptor)


@pytest.fixture
def dxlrun(capsys: pytest.CaptureFixture[str]) -> Callable[..., object]:
    """Run a command line in this process."""
    from tests.kit.commands import command_line  # this file is also used without the kit

    return command_line(capsys)
