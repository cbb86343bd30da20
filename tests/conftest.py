"""Every property draws the same examples at each run; a random search is asked for by its profile.

A find of a fixed run repeats itself: run the test again. A random search prints how to repeat its find:

    python -m pytest --hypothesis-profile=search tests/description
"""

from __future__ import annotations

import gc
import os
import re
import signal
import subprocess
import zlib
from collections.abc import Callable, Generator, Iterator
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple, TypeVar

import pytest
from hypothesis import settings

settings.register_profile("fixed", derandomize=True, print_blob=True)
settings.register_profile("search", derandomize=False, print_blob=True, max_examples=2000)
settings.load_profile("fixed")
gc.set_threshold(50_000, 20, 20)  # as in `dxlrun`: the many tests that are collected are no garbage


SAMPLED = (
    "analysis/playback/test_convert.py",
    "analysis/playback/test_replay_on.py",
    "analysis/replay/test_chains.py",
    "analysis/replay/test_command_line.py",
    "analysis/replay/test_same.py",
    "analysis/replay/test_steered.py",
    "analysis/replay/test_steered_graphs.py",
    "analysis/report/test_page.py",
    "analysis/report/test_plots.py",
    "analysis/season/test_logs.py",
    "analysis/season/test_store.py",
    "analysis/test_injected_causes.py",
    "analysis/test_traffic.py",
    "bench/test_cycle_trace.py",
    "bench/test_exchange.py",
    "bench/test_exchange_command.py",
    "cli/test_bench.py",
    "cli/test_device_tools.py",
    "cli/test_eighty_columns.py",
    "cli/test_examples.py",
    "cli/test_latency.py",
    "cli/test_narrow.py",
    "cli/test_other_systems.py",
    "cli/test_pictures.py",
    "cli/test_recipes.py",
    "cli/test_servo.py",
    "cli/test_sim.py",
    "cli/test_streams.py",
    "cli/test_tutorial.py",
    "control/test_long_runs.py",
    "dynamixel/control_table/test_plugin_models.py",
    "hand/test_terminal.py",
    "lab/characterize/test_command.py",
    "lab/characterize/test_known_servos.py",
    "lab/characterize/test_wrong_data.py",
    "lab/guided/test_live.py",
    "lab/guided/test_procedures.py",
    "lab/identify/test_broken_runs.py",
    "lab/identify/test_command.py",
    "lab/identify/test_published.py",
    "lab/identify/test_recovery.py",
    "lab/sweep/test_command.py",
    "lab/sweep/test_sweep.py",
    "lab/tracking/test_command.py",
    "lab/tracking/test_measurement.py",
    "log/test_readers.py",
    "mechanics/test_coupled_runs.py",
    "phidget/tests/test_spatial.py",
    "plugins/controllers/test_ilc_controller.py",
    "plugins/test_docs.py",
    "plugins/test_example.py",
    "robots/test_arms.py",
    "robots/test_feed_forward.py",
    "robots/test_learning.py",
    "robots/test_mechanics.py",
    "robots/test_orientation.py",
    "robots/test_stand_up.py",
    "robots/test_steered_chains.py",
    "robots/test_steered_examples.py",
    "robots/test_thesis_motions.py",
    "run/test_every_model.py",
    "run/test_new_log.py",
    "simulation/test_recorded_bus.py",
    "teleop/test_drive.py",
    "view/test_command.py",
)
"""Runs through all processes, commands of pages, and experiments: some seconds each; CI runs a sample.

No test of how a run ends is among them, nor of what the network is refused: those of safety always run.
"""
SHARE = int(os.environ.get("DXLRUN_LONG", "9"))


def commit() -> str:
    """Return the commit of this tree, so that each one draws another sample; empty outside a clone."""
    asked = ["git", "-C", str(Path(__file__).parent), "rev-parse", "--short=12", "HEAD"]
    try:
        return subprocess.run(asked, capture_output=True, text=True, check=False).stdout.strip()
    except OSError:  # git is not installed
        return ""


SEED = os.environ.get("DXLRUN_LONG_SEED") or commit()


def pytest_report_header() -> str:
    """Tell how to repeat the sample."""
    return f"long tests: one in {SHARE} (DXLRUN_LONG={SHARE}), drawn by DXLRUN_LONG_SEED={SEED}"


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out long tests that are not in the sample: one in `DXLRUN_LONG` is, 1 runs them all."""

    def sampled(item: pytest.Item) -> bool:
        long = item.path.as_posix().endswith(SAMPLED)
        return not long or zlib.crc32(f"{SEED} {item.nodeid}".encode()) % SHARE == 0

    left_out = [item for item in items if not sampled(item)]
    if left_out and len({item.path for item in items}) > 1:  # a file that is named is run as a whole
        config.hook.pytest_deselected(items=left_out)
        items[:] = [item for item in items if sampled(item)]


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """Use all cores for the whole suite, and this process alone for what is named."""
    whole = config.args_source is not pytest.Config.ArgsSource.ARGS
    return (os.cpu_count() or 1) if whole else 0


EXTRAS = {
    "bokeh": "report",
    "duckdb": "logs",
    "fsspec": "store",
    "matplotlib": "report",
    "mujoco": "physics",
    "pyarrow": "logs",
    "scipy": "identify",
    "twine": "release",
    "websockets": "foxglove",
    "ziglang": "release",
    **dict.fromkeys(
        ("Phidget22", "ahrs", "foxglove", "pinocchio", "pymcap_cli", "pypot", "rerun"),
        "foreign",
    ),
}
"""What the test extra leaves out: which extra of dxlrun brings which module."""
MISSING = {module for module in EXTRAS if find_spec(module) is None}


def missing_extra(text: str) -> str:
    """Return the extra that a failure lacks: of a module that is not found, or as dxlrun itself words it."""
    modules = re.findall(r"No module named '(\w+)", text)
    asked = re.findall(r"dxlrun\[(\w+)\]", text)
    absent = {EXTRAS[module] for module in MISSING}
    return next((EXTRAS[module] for module in modules if module in MISSING), "") or next(
        (extra for extra in asked if extra in absent or (extra == "sweep" and "logs" in absent)), ""
    )


Report = TypeVar("Report", pytest.TestReport, pytest.CollectReport)


def not_run(report: Report, where: pytest.Item | pytest.Collector) -> Report:
    """Make a skip of a failure for want of an extra: CI installs them all."""
    if MISSING and report.failed:
        text = report.longreprtext + "".join(content for _, content in report.sections)
        if extra := missing_extra(text):
            report.outcome = "skipped"
            report.longrepr = (str(where.path), 0, f"needs dxlrun[{extra}]")
    return report


class Extras:
    """Skips failures for want of an extra; a plugin, as hooks of this file miss those of other conftests."""

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(
        self, item: pytest.Item
    ) -> Generator[None, pytest.TestReport, pytest.TestReport]:
        return not_run((yield), item)

    @pytest.hookimpl(wrapper=True)
    def pytest_make_collect_report(
        self, collector: pytest.Collector
    ) -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
        return not_run((yield), collector)

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        """Name in one line what was not run for want of extras."""
        lacking: dict[str, set[str]] = {}
        for report in terminalreporter.stats.get("skipped", []):
            path, _, reason = report.longrepr if isinstance(report.longrepr, tuple) else ("", 0, "")
            if extra := missing_extra(reason):
                lacking.setdefault(f"dxlrun[{extra}]", set()).add(Path(path).stem.removeprefix("test_"))
        if lacking:
            parts = (f"{', '.join(sorted(files))} needs {extra}" for extra, files in sorted(lacking.items()))
            terminalreporter.write_line(f"not run: {'; '.join(parts)}")


def pytest_configure(config: pytest.Config) -> None:
    config.pluginmanager.register(Extras())
    # a shell ignores Ctrl-C for what it starts in the background, and what that starts inherits it
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_finish() -> None:
    """Take the tests out of the collector's sight: a full collection would look at them all again."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def _no_state_of_a_user(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Let controllers keep what they learn in a directory of the tests, also those of processes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_STATE_HOME", str(tmp_path_factory.mktemp("state")))
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
