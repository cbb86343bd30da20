"""The page of a report in a browser: it loads nothing, says no error, and all plots zoom together."""

import json
from pathlib import Path

import numpy as np
import pytest
from tests.kit.browser import CHROMIUM, Browser
from tests.kit.made_logs import Cycle, Said, made_log

from dxlrun.log.log_reader import read_log
from dxlrun_analysis.page.report_page import analyzed_page

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed; apt install chromium")
LOADED = "!!window.Bokeh && Bokeh.documents.length > 0 && Bokeh.documents[0].is_idle"
FRAMES = """(() => {
  const found = {};
  for (const view of [...Bokeh.index].filter(one => one.frame))
    found[view.model.name] = [view.frame.x_range.start, view.frame.x_range.end];
  return found;
})()"""
"""What the frames of the plots show of their horizontal axes, by name."""
FRAME = """(() => {
  const view = [...Bokeh.index].find(one => one.model?.name === "NAME");
  view.el.scrollIntoView({block: "center"});
  const box = view.el.getBoundingClientRect(), frame = view.frame.bbox;
  return [box.x + frame.x, box.y + frame.y, frame.width, frame.height];
})()"""
"""Where the frame of a plot is on the screen."""


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    """The page of a run of 300 cycles."""
    directory = tmp_path_factory.mktemp("page")
    cycles = [
        Cycle(number, late=number % 40, position=0.3 * np.sin(number / 20), goal=0.3, clamped=number == 70)
        for number in range(300)
    ]
    log = read_log(made_log(directory, cycles, (), [Said(2, 30, "<b>bold</b>")]))
    target: Path = directory / "report.html"
    target.write_text(analyzed_page(log)[1], encoding="utf-8")
    return target


@pytest.fixture(scope="module")
def browser(report, tmp_path_factory):
    """The page in a browser, when its plots are drawn."""
    browser = Browser(tmp_path_factory.mktemp("browser"))
    browser("Page.navigate", url=report.as_uri())
    browser.until(LOADED)
    yield browser
    browser.close()


def test_the_page_says_no_error_and_loads_nothing(browser, report):
    assert browser.value(LOADED)
    loaded = {
        one["params"]["request"]["url"]
        for one in browser.events
        if one["method"] == "Network.requestWillBeSent"
    }
    assert {url for url in loaded if not url.startswith("data:")} == {report.as_uri()}
    troubles = [
        one["params"]
        for one in browser.events
        if one["method"] in ("Runtime.exceptionThrown", "Log.entryAdded")
        or (one["method"] == "Runtime.consoleAPICalled" and one["params"]["type"] in ("error", "warning"))
    ]
    assert troubles == []


def test_a_zoom_in_one_plot_is_one_in_all(browser):
    before = browser.value(FRAMES)
    timed = {name for name, shown in before.items() if shown == before["lateness"]}
    assert {"lateness", "steps", "controllers", "joint-0", "joint-1", "events-timeline"} <= timed | {
        "controllers"
    }
    assert {"latency-histogram", "latency-cumulative", "budget-typical"}.isdisjoint(timed)
    x, y, width, height = browser.value(FRAME.replace("NAME", "joint-1"))
    browser.drag((x + width * 0.25, y + height * 0.5), (x + width * 0.5, y + height * 0.52))
    browser.until(
        f"JSON.stringify({FRAMES}['lateness']) != '{json.dumps(before['lateness'], separators=(',', ':'))}'"
    )
    begin, end = before["joint-1"]
    expected = [begin + 0.25 * (end - begin), begin + 0.5 * (end - begin)]
    after = browser.value(FRAMES)
    for name, shown in after.items():
        if name in timed:
            assert shown == pytest.approx(expected, abs=0.01 * (end - begin))
        else:
            assert shown == before[name]


def test_the_plots_are_drawn(browser):
    """Each has a canvas with more than one colour on it."""
    painted = """[...Bokeh.index].filter(one => one.frame).map(view => {
      const canvas = view.canvas_view.primary.canvas ?? view.canvas_view.primary.ctx.canvas;
      const data = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
      return new Set(new Uint32Array(data.buffer)).size;
    })"""
    colours = browser.value(painted)
    assert len(colours) >= 7
    assert min(colours) > 10


def test_a_click_on_a_name_hides_its_curve(browser):
    shown = """[...Bokeh.documents[0].roots().find(one => one.name === "joint-0").renderers]
      .filter(one => one.visible).map(one => one.name)"""
    click = (
        "[...document.querySelectorAll('#joint-0 button')].find(one => one.textContent === 'sent').click()"
    )
    assert "sent" in browser.value(shown)
    browser.value(click)
    assert "sent" not in browser.value(shown)
    assert "read" in browser.value(shown)
    browser.value(click)
    assert "sent" in browser.value(shown)


@pytest.mark.parametrize(("width", "columns"), [(1900, 2), (1000, 1), (500, 1)])
def test_the_width_of_the_window_is_used(browser, width, columns):
    places = """["#joint-0", "#joint-1", "#lateness"].map(one => document.querySelector(one))
      .map(one => one.getBoundingClientRect()).map(one => [one.x, one.y, one.width])"""
    browser("Emulation.setDeviceMetricsOverride", width=width, height=900, deviceScaleFactor=1, mobile=False)
    (x, y, each), (other_x, other_y, _), _ = browser.value(places)
    assert (other_x > x + each, other_y == y) == (columns == 2,) * 2
    assert columns * each > 0.85 * width
    frame = "[...Bokeh.index].find(one => one.model?.name === 'joint-0').frame.bbox.width"
    browser.until(f"{frame} > {each} - 120 && {frame} < {each}")  # the plot follows its place
    browser.until("document.documentElement.scrollWidth <= window.innerWidth")
