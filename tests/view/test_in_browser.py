"""The page in Chromium: what clicks do, to the servos too; the robot moves, curves advance, a log plays."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from importlib.resources import files
from pathlib import Path

import pytest
from tests.kit.awaited import until
from tests.kit.browser import CHROMIUM, Browser
from tests.kit.torso import GOAL_POSITION, JOINT, SERVO, TORQUE_ENABLE, Run
from tests.view.served import Served

from dxlrun_view.live import LiveRobot
from dxlrun_view.recorded import RecordedRobot

Serve = Callable[..., Served]
BUNDLE = files("dxlrun_view").joinpath("page", "build", "page.js")
pytestmark = [
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed; apt install chromium"),
    pytest.mark.skipif(
        not BUNDLE.is_file(), reason="the page has no bundle; pip install plugins/dxlrun_view"
    ),
]


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    one = Browser(
        tmp_path_factory.mktemp("browser"), "--use-angle=swiftshader", "--enable-unsafe-swiftshader"
    )
    yield one
    one.close()


def errors(browser: Browser) -> list[object]:
    """Return what the page complained about; that the server of the page before has ended is none."""
    kinds = ("Runtime.exceptionThrown", "Log.entryAdded")
    found = [event["params"] for event in browser.events if event.get("method") in kinds]
    browser.events.clear()
    return [one for one in found if "ERR_CONNECTION_REFUSED" not in str(one)]


def test_a_log_plays_and_jumps(recorded: RecordedRobot, serve: Serve, browser: Browser) -> None:
    browser.open(serve(recorded).address)
    browser.until("window.looked > 3 && !!document.querySelector('.legend b')?.textContent")
    assert browser.value("document.querySelector('#robot').textContent") == "bioloid_torso_imu"
    assert browser.value("document.querySelectorAll('#joints tbody tr').length") == 8
    assert browser.value("document.querySelector('#stop').hidden")
    before = browser.picture("#scene")
    move = "(time => { const input = document.querySelector('#time'); input.value = time; input.oninput(); })"
    looked = browser.value(f"{move}(8), window.looked")
    browser.until(f"window.looked > {looked + 3}")
    moved = browser.differing(before, browser.picture("#scene"))
    assert 0.01 < moved < 0.6
    assert browser.value("document.querySelector('#now').textContent").startswith("8.00 of ")
    legend = "parseFloat(document.querySelector('.legend b').textContent)"
    table = "parseFloat(document.querySelectorAll('#joints tbody tr')[0].cells[2].textContent)"
    assert abs(browser.value(f"{legend} - {table}")) < 1.0, "the legend has the value of another time"
    browser.value("document.querySelector('#speed').value = '4', document.querySelector('#play').click()")
    browser.until("parseFloat(document.querySelector('#now').textContent) > 9.5")
    browser.value("document.querySelector('[data-tab=events]').click()")
    browser.value("[...document.querySelectorAll('#events li')].at(-1).click()")
    browser.until("parseFloat(document.querySelector('#now').textContent) < 2")
    assert errors(browser) == []


def looks(browser: Browser, more: int) -> None:
    """Wait until the page has drawn some times more."""
    browser.until(f"window.looked > {browser.value('window.looked') + more}")


def test_switch_slider_and_stop_reach_the_servos(
    live: LiveRobot, run: Run, serve: Serve, browser: Browser
) -> None:
    browser.open(serve(live, control=True).address)
    browser.until("document.querySelector('.legend b')?.textContent")
    browser.click("[data-tab=controllers]")
    browser.click("[aria-label='deactivate right_arm']")
    browser.until("!!document.querySelector('[aria-label=\"activate right_arm\"]')")
    assert not live.shown().info.controllers[3].active
    browser.click("[aria-label='activate right_arm']")
    browser.until("!!document.querySelector('[aria-label=\"deactivate right_arm\"]')")

    browser.click("[data-tab=joints]")
    browser.click(f"[title^={JOINT}]")  # its curves
    browser.until("document.querySelectorAll('.legend b').length === 4")
    looks(browser, 5)
    still, curves = browser.picture("#scene"), browser.picture("#charts")
    name = f"[aria-label='goal of {JOINT}']"
    slider = f'document.querySelector("{name}")'
    span = browser.value(f"{slider}.max - {slider}.min")
    share = browser.value(f"({slider}.value - {slider}.min) / {span}")
    left, top, width, height = browser.place(name)
    track, middle = width - height, top + height / 2  # the thumb is as wide as it is high
    thumb = left + height / 2 + track * share
    browser.drag((thumb, middle), (thumb + 0.2 * track, middle))
    ticks = 0.2 * span * 1023 / math.radians(300)
    until(lambda: abs(abs(run.written(GOAL_POSITION)[SERVO] - 512) - ticks) < 0.1 * ticks)
    looks(browser, 20)
    moved, advanced = (
        browser.differing(before, browser.picture(part))
        for before, part in ((still, "#scene"), (curves, "#charts"))
    )
    assert 0.01 < moved < 0.6
    assert advanced > 0.01

    assert run.written(TORQUE_ENABLE)[SERVO] == 1
    browser.click("#stop")
    until(lambda: run.limp)
    browser.until("document.querySelector('#message').textContent.includes('limp')")
    assert errors(browser) == []


@pytest.mark.parametrize("window", [(1440, 900, False), (1024, 700, False), (390, 844, True)])
def test_all_of_the_page_fits_the_window(
    recorded: RecordedRobot, serve: Serve, browser: Browser, window: tuple[int, int, bool]
) -> None:
    width, height, dark = window
    browser.open(serve(recorded).address, width, height, dark=dark)
    browser.until("window.looked > 3")
    assert browser.value("document.documentElement.scrollWidth") <= width
    assert browser.value("(tab => tab.scrollWidth - tab.clientWidth)(document.querySelector('#joints'))") == 0
    assert browser.value("document.querySelector('footer').getBoundingClientRect().bottom") <= height
    ground = browser.value("getComputedStyle(document.documentElement).backgroundColor")
    assert (sum(map(int, ground[4:-1].split(","))) < 384) is dark
    assert errors(browser) == []


def test_a_page_without_the_token_says_so(recorded: RecordedRobot, serve: Serve, browser: Browser) -> None:
    served = serve(recorded)
    browser.open(served.address.partition("?")[0])
    browser.until("document.querySelector('#message')?.textContent.includes('token')")


def test_a_page_whose_server_ended_says_so(log: Path, serve: Serve, browser: Browser) -> None:
    served = serve(RecordedRobot(log))
    browser.open(served.address)
    browser.until("window.looked > 3")
    served.close()
    browser.until("document.querySelector('#message').textContent.includes('has ended')")
