"""Skips: what may be skipped in CI; with `--strict-skips` others fail a run."""

import re
from collections.abc import Generator

import pytest

ALLOWED = {
    r"DXLRUN_BAM_RECORDINGS": "recordings of real servos, 300 MB",
    r"DXLRUN_LEROBOT_PYTHON": "lerobot has torch with it, 8 GB; a campaign of releases",
    r"/dev/uinput": "the kernel of a container makes no input devices",
    r"no IPv6": "the network of a container",
    r"no real time to give": "the limits of the account",
    r"Python 3\.11|3\.11 only": "packages without wheels for newer interpreters",
}
"""Patterns of reasons, and why each may skip."""

ALLOWED_BUT_FOR_ALL = {
    r"DXLRUN_ROS2_PYTHON": "ROS 2 has an environment of its own, which docs/how-to/ros2.md builds",
    r"no Chromium is installed": "a browser; apt install chromium",
    r"no bundle": "the page's bundle needs npm",
    r"pin has 380 MB": "pinocchio, to compare kinematics with",
    r"needs dxlrun\[release\]": "builds wheels with a compiler of 101 MB",
    r"moto\[server,s3\]": "a server of S3, 200 MB",
    r"zensical": "builds the site",
}
"""The same for what only a run with `--all` has installed."""


def add_options(parser: pytest.Parser) -> None:
    parser.addoption(
        "--strict-skips", action="store_true", help="fail for a skip that tests/kit/skips.py does not allow"
    )


class Skips:
    """Plugin: fails the run for skips that are not allowed."""

    def __init__(self, config: pytest.Config) -> None:
        self._strict: bool = config.getoption("--strict-skips")
        self._allowed = [*ALLOWED, *(() if config.getoption("--all") else ALLOWED_BUT_FOR_ALL)]
        self._found: list[str] = []

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Note a skip that is not allowed."""
        self._note(report)

    def pytest_collectreport(self, report: pytest.CollectReport) -> None:
        """Note a module that is skipped as a whole."""
        self._note(report)

    def _note(self, report: pytest.TestReport | pytest.CollectReport) -> None:
        if not report.skipped or hasattr(report, "wasxfail"):
            return
        reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else str(report.longrepr)
        if not any(re.search(pattern, reason) for pattern in self._allowed):
            self._found.append(f"{report.nodeid}: {reason}")

    @pytest.hookimpl(wrapper=True, trylast=True)
    def pytest_sessionfinish(self, session: pytest.Session) -> Generator[None, None, None]:
        """Fail the run."""
        if self._strict and self._found and not hasattr(session.config, "workerinput"):
            session.exitstatus = session.exitstatus or pytest.ExitCode.TESTS_FAILED
        yield

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        """Name the skips that are not allowed."""
        if self._strict:
            for line in sorted(set(self._found)):
                terminalreporter.write_line(f"not allowed to skip: {line}")
