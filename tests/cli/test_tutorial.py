"""docs/tutorial: arm.md, controller.md and humanoid.md, typed from top to bottom as a reader does.

A block with a title is saved as that file. A block without a language is what the command above it prints:
`...` stands for words of a line, alone for lines. A run without `--virtual` is a process, until
`dxlrun stop`; LOG is the newest log. How dxlrun is installed is what `.ci/run` does.
"""

import os
import re
import shlex
import subprocess
import sys
from collections.abc import Callable, Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.kit.awaited import DEADLINE_S, until
from tests.kit.pages import page_text, shows

from dxlrun.testing import read_log

ROOT = Path(__file__).parents[2]
Dxlrun = Callable[..., Any]
CODE = "import sys; from dxlrun.cli import main; sys.exit(main())"
STEP = re.compile(r"^```(\w*)(?: title=\"(.+?)\")?\n(.*?)^```$|^    (\S[^\n]*)$", re.MULTILINE | re.DOTALL)
DELAYS = (" lost at ", " delivered no sample ")
"""Signs of a busy machine, which delays replies and samples: the run is then not good."""
PROGRESS = re.compile(r"^\w+: [\d.]+( of [\d.]+)? s, .* skipped\n", re.MULTILINE)
"""Lines that a run in a pipe prints from time to time."""
INSTALLS = (
    "python3 -m venv .venv",
    ".venv/bin/pip install '.[report]'",
    ". .venv/bin/activate",
    "pip install ./plugins/dxlrun_view",
)
STARTS = 3
"""Of a robot: where the machine is busy, its servos may answer too late."""
pytestmark = [pytest.mark.long, pytest.mark.timeout(300)]
"""Robots of whole pages, one after the other, in real time."""


class Reader:
    """Types a page in a folder."""

    def __init__(self, page: str, place: Path, dxlrun: Dxlrun) -> None:
        self.steps, self.place, self.dxlrun = iter(STEP.findall(page_text(page))), place, dxlrun
        self.running: list[subprocess.Popen[str]] = []
        self.printed: list[str | None] = []
        """Outputs that the next blocks of the page show; None for one that a busy machine changed."""
        self.compared = 0

    def until(self, last: str | None = None, *, code: int = 0) -> str:
        """Type on up to a command, or to the end, and return what that printed; `code` is its exit code."""
        for language, title, text, line in self.steps:
            if title:
                (self.place / title).write_text(text)
            elif text and not language:
                printed = self.printed.pop(0)
                assert printed is None or shows(text, printed), f"{text}\n{printed}"
                self.compared += 1
            elif line and line not in INSTALLS:
                said = self._type(line, code if line == last else 0)
                if line == last:
                    return said
        assert last is None, f"the page has no further {last}"
        return ""

    def _type(self, line: str, code: int) -> str:
        command, *words = shlex.split(line.replace("LOG", str(self.log)))
        assert command == "dxlrun", line
        self.printed = []
        if words[0] == "view":
            served = self._started(*words, "--no-browser", "--listen", ":0")
            assert served.stdout is not None
            assert "http://127.0.0.1" in served.stdout.readline()
            served.kill()
        elif words[0].endswith(".yaml") and "--virtual" not in words:
            for _ in range(STARTS):
                robot = self._started(*words)
                until(lambda one=robot: one.poll() is not None or " active" in self.dxlrun("list").out, line)
                if robot.poll() is None:
                    break
            assert robot.poll() is None, robot.stdout and robot.stdout.read()
        else:
            said = self.dxlrun(*words, *(["--once"] if words == ["watch"] else []))
            assert said.code == code, line + said.out + said.err
            self.printed = [PROGRESS.sub("", said.err + said.out)]  # a warning is above the result
            if words == ["stop"]:
                robot = self.running.pop()
                out, _ = robot.communicate(timeout=DEADLINE_S)
                assert robot.returncode == 0 or any(delay in out for delay in DELAYS), out
                self.printed.append(None if robot.returncode else out)
            return said.out + said.err
        return ""

    @property
    def log(self) -> Path | None:
        logs = self.place.glob("logs/*.mcap")
        return max(logs, key=lambda path: path.stat().st_mtime_ns, default=None)

    def _started(self, *words: str) -> subprocess.Popen[str]:
        """Start a command that goes on."""
        command, out = [sys.executable, "-P", "-c", CODE, *words], subprocess.PIPE
        self.running.append(subprocess.Popen(command, text=True, stdout=out, stderr=subprocess.STDOUT))
        return self.running[-1]


@pytest.fixture
def reader(
    dxlrun: Dxlrun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Callable[[str], Reader]]:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setenv("COLUMNS", "200")
    # dxlrun_view as if installed, which would fetch what its page is made of
    info = tmp_path / "installed/dxlrun_view-0.1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Name: dxlrun-view\nVersion: {version('dxlrun')}\n")
    (info / "entry_points.txt").write_text("[dxlrun]\nview = dxlrun_view\n")
    packages = (str(ROOT / "plugins/dxlrun_view/src"), str(info.parent))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(packages))
    readers: list[Reader] = []

    def begin(page: str) -> Reader:
        readers.append(Reader(page, tmp_path, dxlrun))
        return readers[-1]

    yield begin
    for process in [one for each in readers for one in each.running]:
        process.kill()
        print(process.communicate()[0])  # of a failed test, how its robot fared


@pytest.mark.needs("report")
def test_an_arm_in_ten_minutes(reader: Callable[[str], Reader]) -> None:
    page = reader("arm.md")
    page.until("dxlrun check arm.yaml", code=2)
    file = page.place / "arm.yaml"
    file.write_text(file.read_text().replace("120]", "120 deg]"))
    page.until("dxlrun send arm position shoulder=100deg", code=2)
    page.until("dxlrun arm.yaml --virtual --play wave.yaml")
    position = np.degrees(read_log(page.log).cycles["position"])
    assert position[:, 2].max() > 60  # the elbow in the motion, which leaves the base at -44
    assert np.abs(position[-1]).max() < 2  # the pose rest, on_exit
    page.until()
    assert (page.place / "arm.html").read_text().startswith("<!DOCTYPE html>")
    assert page.compared >= 9


@pytest.mark.needs("report")
def test_a_controller_in_ten_lines(reader: Callable[[str], Reader]) -> None:
    page = reader("controller.md")
    assert re.search(
        r"wave +\./wave\.py:Wave +wave\.py [0-9a-f]{12} +position", page.until("dxlrun check head.yaml")
    )
    page.until("dxlrun head.yaml --virtual --duration 10")
    position = np.degrees(read_log(page.log).cycles["position"])
    assert np.ptp(position, axis=0) == pytest.approx([40, 40], abs=2)  # amplitude: 20 deg, both ways
    assert "-> 0.174533 rad" in page.until("dxlrun parameters wave amplitude='10 deg'")
    page.until("dxlrun chasing.yaml --virtual --duration 10")
    assert np.ptp(np.degrees(read_log(page.log).cycles["position"])[500:, 1]) > 15
    page.until()
    assert page.compared >= 6
    assert (page.place / "my_robotics/pyproject.toml").exists()


def test_a_humanoid(reader: Callable[[str], Reader]) -> None:
    page = reader("humanoid.md")
    page.until("dxlrun robots/stand_up.yaml")
    robots = [path.read_text() for path in (page.place / "robots").glob("*.yaml")]
    for excerpt in re.findall(r"```yaml\n\w+:\n(.*?)```", page_text("humanoid.md"), re.DOTALL):
        assert any(excerpt in robot for robot in robots), excerpt
    assert "get_up" in page.until("dxlrun play --list")
    page.until("dxlrun send push play motion=forward --wait")
    assert re.search(r"^curl .* active", page.until("dxlrun list"), re.MULTILINE)
    page.until()
    assert page.compared >= 7


def test_the_class_is_as_short_as_the_title_says() -> None:
    block = page_text("controller.md").partition("class Wave")[2].partition("```")[0]
    assert len([line for line in block.splitlines() if line.strip()]) <= 10
