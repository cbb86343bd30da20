"""A log, a running robot, and pages that are served."""

import ssl
from importlib.resources import files
from pathlib import Path

import pytest
from tests.kit.browser import CHROMIUM, Browser
from tests.kit.torso import Run
from tests.view.served import Served

from dxlrun.log import log_writer
from dxlrun.testing import simulated_robot
from dxlrun_view.live_robot import LiveRobot
from dxlrun_view.recorded_robot import RecordedRobot
from dxlrun_view.shown import ViewSource

ROBOTS = Path(__file__).resolve().parents[2] / "robots"


@pytest.fixture(scope="session")
def log(tmp_path_factory):
    """The log of 12 s of the torso with an IMU, whose arms and head move."""
    path = tmp_path_factory.mktemp("run") / "run.mcap"
    play = [ROBOTS / "motions/three_parts.yaml"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(log_writer, "CHUNK_BYTES", 1 << 14)  # so that it has many slices
        simulated_robot(ROBOTS / "bioloid_torso_imu.yaml", play=play, duration_s=12, log=path).run()
    return path


@pytest.fixture(scope="session")
def recorded(log):
    return RecordedRobot(log)


@pytest.fixture(scope="session")
def run(tmp_path_factory):
    """A torso that runs until the last test of this process; `live` alone lets a test find it."""
    one = Run(tmp_path_factory.mktemp("live"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_RUNTIME_DIR", str(one.place))
        one.start()
    yield one
    one.end()


@pytest.fixture
def live(run, monkeypatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(run.place))
    robot = LiveRobot("bioloid_torso_imu")
    yield robot
    robot.close()


@pytest.fixture(scope="session")
def chromium(tmp_path_factory):
    if CHROMIUM is None:
        pytest.skip("no Chromium is installed; apt install chromium")
    if not files("dxlrun_view").joinpath("page", "build", "page.js").is_file():
        pytest.skip("the page has no bundle; pip install plugins/dxlrun_view")
    place = tmp_path_factory.mktemp("browser")
    one = Browser(place, "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
    yield one
    one.close()


@pytest.fixture
def browser(chromium):
    """A browser in which no page of an earlier test is left that complains."""
    chromium.open("about:blank")
    chromium.events.clear()
    return chromium


@pytest.fixture
def serve():
    served: list[Served] = []

    def make(source: ViewSource, *, control: bool = False, tls: ssl.SSLContext | None = None) -> Served:
        served.append(Served(source, control=control, tls=tls))
        return served[-1]

    yield make
    for one in served:
        one.close()
