"""The page in Chromium: the robot moves with its joints, curves advance, a log plays and jumps."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from importlib.resources import files
from pathlib import Path

import pytest
from tests.kit.browser import CHROMIUM, Browser
from tests.view.served import Served

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


def differing(first: bytes, second: bytes) -> float:
    """Return the share of differing bytes of two uncompressed pictures."""
    return sum(a != b for a, b in zip(first, second, strict=True)) / len(first)


def scene(browser: Browser) -> bytes:
    """Return the pixels of the 3-D view, as the window shows them."""
    box = browser.value(
        "(b => [b.x, b.y, b.width, b.height])(document.querySelector('#body').getBoundingClientRect())"
    )
    return browser.pixels(*box)


def test_a_log_plays_and_jumps(recorded: RecordedRobot, serve: Serve, browser: Browser) -> None:
    browser.open(serve(recorded).address)
    browser.until("window.looked > 3 && !!document.querySelector('.legend b')?.textContent")
    assert browser.value("document.querySelector('#robot').textContent") == "bioloid_torso_imu"
    assert browser.value("document.querySelectorAll('#joints tbody tr').length") == 8
    assert browser.value("document.querySelector('#stop').hidden")
    before = scene(browser)
    move = "(time => { const input = document.querySelector('#time'); input.value = time; input.oninput(); })"
    looked = browser.value(f"{move}(8), window.looked")
    browser.until(f"window.looked > {looked + 3}")
    assert 0.003 < differing(before, scene(browser)) < 0.6
    assert browser.value("document.querySelector('#now').textContent").startswith("8.00 of ")
    browser.value("document.querySelector('#speed').value = '4', document.querySelector('#play').click()")
    browser.until("parseFloat(document.querySelector('#now').textContent) > 9.5")
    browser.value("document.querySelector('[data-tab=events]').click()")
    browser.value("[...document.querySelectorAll('#events li')].at(-1).click()")
    browser.until("parseFloat(document.querySelector('#now').textContent) < 2")
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
