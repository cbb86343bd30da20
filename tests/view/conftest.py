"""A log, a running robot, and pages that are served."""

from __future__ import annotations

import ssl
import subprocess
import sys
from collections.abc import Callable, Iterator
from importlib.resources import files
from pathlib import Path

import pytest
from tests.kit.awaited import DEADLINE_S
from tests.kit.browser import CHROMIUM, Browser
from tests.kit.torso import Run
from tests.view.served import Served

from dxlrun_view.live_robot import LiveRobot
from dxlrun_view.recorded_robot import RecordedRobot
from dxlrun_view.shown import ViewSource

ROBOTS = Path(__file__).resolve().parents[2] / "robots"


@pytest.fixture(scope="session")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The log of 12 s of the torso with an IMU, whose arms and head move."""
    place = tmp_path_factory.mktemp("run")
    words = [ROBOTS / "bioloid_torso_imu.yaml", "--play", ROBOTS / "motions/three_parts.yaml"]
    command = [
        sys.executable,
        "-c",
        "from dxlrun.cli import main; main()",
        *map(str, words),
        "--virtual",
        "--duration",
        "12",
    ]
    done = subprocess.run(command, cwd=place, capture_output=True, text=True, timeout=DEADLINE_S, check=False)
    assert done.returncode == 0, done.stderr
    (found,) = (place / "logs").glob("*.mcap")
    return found


@pytest.fixture(scope="session")
def recorded(log: Path) -> RecordedRobot:
    return RecordedRobot(log)


@pytest.fixture(scope="package")
def run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Run]:
    one = Run(tmp_path_factory.mktemp("live"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_RUNTIME_DIR", str(one.place))
        one.start()
        yield one
        one.end()


@pytest.fixture
def live(run: Run) -> Iterator[LiveRobot]:
    robot = LiveRobot("bioloid_torso_imu")
    yield robot
    robot.close()


@pytest.fixture(scope="package")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    if CHROMIUM is None:
        pytest.skip("no Chromium is installed; apt install chromium")
    if not files("dxlrun_view").joinpath("page", "build", "page.js").is_file():
        pytest.skip("the page has no bundle; pip install plugins/dxlrun_view")
    place = tmp_path_factory.mktemp("browser")
    one = Browser(place, "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
    yield one
    one.close()


@pytest.fixture
def serve() -> Iterator[Callable[..., Served]]:
    served: list[Served] = []

    def make(source: ViewSource, *, control: bool = False, tls: ssl.SSLContext | None = None) -> Served:
        served.append(Served(source, control=control, tls=tls))
        return served[-1]

    yield make
    for one in served:
        one.close()
