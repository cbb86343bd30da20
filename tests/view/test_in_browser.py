"""The page in Chromium: what clicks do, to the servos too; the robot moves, curves advance, a log plays."""

import math

import pytest
from tests.kit.awaited import until
from tests.kit.browser import Browser
from tests.kit.torso import GOAL_POSITION, JOINT, SERVO, TORQUE_ENABLE

from dxlrun.tooling.live import JointServo
from dxlrun_view.curves import Curve, Moment
from dxlrun_view.recorded_robot import RecordedRobot
from dxlrun_view.shown import LiveEvent, SourceProperties, ViewedController, ViewedRobot

pytestmark = pytest.mark.long

VISIBLE = "(selector => document.querySelector(selector).offsetParent !== null)"
"""In the page: whether an element is visible."""
ENABLED = """[...document.querySelectorAll('fieldset :is(input, button, select)')]
  .filter(one => !one.matches(':disabled'))"""
"""In the page: the controls that steer the robot and can be used."""


def errors(browser: Browser) -> list[object]:
    """Return what the page complained about; that the server of the page before has ended is none."""
    kinds = ("Runtime.exceptionThrown", "Log.entryAdded")
    found = [event["params"] for event in browser.events if event.get("method") in kinds]
    browser.events.clear()
    return [one for one in found if "ERR_CONNECTION_REFUSED" not in str(one)]


def test_a_log_plays_and_jumps(recorded, serve, browser):
    browser.open(serve(recorded).address)
    browser.until("window.looked > 3 && !!document.querySelector('.legend b')?.textContent")
    assert browser.value("document.querySelector('#robot').textContent") == "bioloid_torso_imu"
    assert browser.value("document.querySelectorAll('#joints tbody tr').length") == 8
    assert not browser.value(f"{VISIBLE}('#stop') || {VISIBLE}('#steering')")
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


def test_switch_slider_and_stop_reach_the_servos(live, run, serve, browser):
    browser.open(serve(live, control=True).address)
    browser.until("document.querySelector('.legend b')?.textContent")
    browser.click("[data-tab=controllers]")
    browser.click("[aria-label='Deactivate right_arm']")
    browser.until("!!document.querySelector('[aria-label=\"Activate right_arm\"]')")
    assert not live.describe_page().info.controllers[3].active
    browser.click("[aria-label='Activate right_arm']")
    browser.until("!!document.querySelector('[aria-label=\"Deactivate right_arm\"]')")

    browser.click("[data-tab=joints]")
    browser.click(f"[title^={JOINT}]")  # its curves
    browser.until("document.querySelectorAll('.legend b').length === 4")
    looks(browser, 5)
    still, curves = browser.picture("#scene"), browser.picture("#charts")
    name = f"[aria-label='Goal of {JOINT}']"
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


class Scripted:
    """A running robot with two joints, whose states a test sets."""

    def __init__(self) -> None:
        self.names = ("elbow_joint", "wrist_joint")
        self.events_: tuple[LiveEvent, ...] = ()
        self.values: dict[str, float | None] = {}
        self.problem, self.time, self.moving = "", 100.0, True

    folder = None

    def begin(self, **columns: tuple[float | None, float | None]) -> None:
        """Let the robot have its first cycle, with values of columns of both joints."""
        known: dict[str, float | None] = {"loop/cycle": 1.0, "loop/late": 0.001}
        for column, pair in columns.items():
            known |= {f"{name}/{column}": one for name, one in zip(self.names, pair, strict=True)}
        self.values = known

    def describe_page(self) -> SourceProperties:
        arm = ViewedController("arm", "position_controller", True, ("elbow_joint",), ("position",))
        began = bool(self.values)
        limits = dict.fromkeys(self.names, (-2.6, 0.17))
        servos = {"wrist_joint": JointServo("XM430-W350", 2.0, 80.0)}
        info = ViewedRobot(
            "arm", 50.0, 0.0, joints=self.names, limits=limits, controllers=(arm,), servos=servos
        )
        return SourceProperties(
            info=info if began else ViewedRobot("arm"),
            live=True,
            columns=tuple(self.values),
            span=(0.0, self.time),
            run=int(began),
            problem=self.problem,
            control=True,
        )

    def moment_at(self, time_s: float | None) -> Moment:
        self.time += 0.04 if self.moving else 0.0
        return Moment(self.time if self.values else 0.0, [*self.values.values()])

    def curve(self, name: str, begin: float, end: float, points: int) -> Curve:
        return Curve(name, [], [])

    def events(self, after: int) -> tuple[LiveEvent, ...]:
        return self.events_[after:]

    def urdf(self) -> str:
        return ""

    def close(self) -> None: ...


def await_phase(browser: Browser, phase: str) -> None:
    browser.until(f"document.body?.dataset.phase === '{phase}' && window.looked > 1")


def test_controls_are_enabled_only_with_fresh_states(serve, browser):
    robot = Scripted()
    browser.open(serve(robot, control=True).address)
    await_phase(browser, "loading")
    assert browser.value(f"{ENABLED}.length") == 0
    assert browser.value("document.querySelectorAll('[type=range]').length") == 1, "that of the time line"
    robot.begin(goal_position=(-1.0, None), position=(-0.9, None), torque=(1, 3))
    await_phase(browser, "live")
    sliders = (
        "[...document.querySelectorAll('#joints input')].map(one => "
        "[one.disabled, one.hidden, Number(one.value)])"
    )
    # No controller commands the wrist, and its position is unknown: its slider would be drawn near an end.
    browser.until("document.querySelectorAll('#joints input').length === 2")
    elbow, wrist = browser.value(sliders)
    assert (elbow[:2], wrist[:2]) == ([False, False], [True, True])
    assert elbow[2] == pytest.approx(-1.0, abs=0.01)
    assert browser.value(f"{ENABLED}.length") > 4
    for cause in ("stale", "problem"):
        robot.moving, robot.problem = cause != "stale", "arm does not run" * (cause == "problem")
        await_phase(browser, "gone")
        assert browser.value(f"{ENABLED}.length") == 0, cause
        assert browser.value(f"{VISIBLE}('#stop') && !document.querySelector('#stop').disabled"), (
            "STOP is always sent"
        )
        assert browser.value("document.querySelector('#banner').textContent"), cause
        browser.click("#stop")  # refused here, because no robot runs
        browser.until("document.querySelector('#message').textContent.includes('switch off its power')")
        robot.moving, robot.problem = True, ""
        await_phase(browser, "live")
        assert not browser.value(f"{VISIBLE}('#banner')")
    # Chromium logs each refused STOP as a resource that failed to load.
    assert [one for one in errors(browser) if "409 (Conflict)" not in str(one)] == []


def test_header_shows_voltage_hottest_servo_and_errors_first(serve, browser):
    robot = Scripted()
    robot.begin(voltage=(11.9, 11.2), temperature=(41, 67), hardware_error=(0, 0), torque=(1, 1))
    browser.open(serve(robot, control=True).address, 390, 844)
    await_phase(browser, "live")
    figures = (
        "[...document.querySelectorAll('#figures div')].map(one => "
        "one.innerText.replace(/\\s+/g, ' ').trim())"
    )
    assert browser.value(figures)[:3] == ["Voltage 11.2 V", "Hottest servo 67 °C wrist", "Errors None"]
    right = "document.querySelectorAll('#figures div')[2].getBoundingClientRect().right"
    assert browser.value(right) <= 390
    robot.events_ = (LiveEvent(1, 50.0, 40, "loop", "the bus was silent", 50.0),)
    browser.until(f"{figures}[2] === 'Errors 1 event'")
    robot.begin(hardware_error=(0, 32), torque=(1, 1))
    browser.until(f"{figures}[2] === 'Errors Overload error wrist'")
    robot.begin(hardware_error=(0, 37), torque=(1, 1))
    browser.until(f"{figures}[2] === 'Errors Input voltage error + 2 wrist'")
    tag = "document.querySelector('#joints .tag.bad').textContent"
    assert browser.value(tag) == "input voltage error; overheating error; overload error"
    # The control table of the elbow's servo is unknown.
    robot.begin(hardware_error=(33, 0), torque=(1, 1))
    browser.until(f"{figures}[2] === 'Errors Error 0x21 elbow'")
    browser.click("#figures div:nth-child(3)")
    assert browser.value(f"{VISIBLE}('#events')")
    assert errors(browser) == []


def test_hot_servo_is_marked_near_its_own_temperature_limit(serve, browser):
    robot = Scripted()
    browser.open(serve(robot).address)
    hot = "[...document.querySelectorAll('#joints .hot')].length"
    figure = "document.querySelectorAll('#figures b')[1]?.className"
    for temperatures, number in (((64, 69), 0), ((64, 70), 1), ((65, 69), 1)):
        robot.begin(temperature=temperatures)
        browser.until(f"{hot} === {number} && {figure} === '{'bad' * number}'")


def test_page_of_a_log_waits_for_no_robot(recorded, serve, browser):
    browser.open(serve(recorded).address.partition("?")[0])  # without the token, it gets no data
    browser.until("document.querySelector('#banner')?.textContent.includes('token')")
    assert browser.value("document.querySelector('#phase').textContent") == "Reading"
    for place in ("#no-scene", "#joints", "#controllers"):
        assert browser.value(f"document.querySelector('{place}').textContent") == "Reading the log …"
    assert len(errors(browser)) > 0
    browser.open(serve(Scripted()).address)
    browser.until("document.querySelector('#no-scene')?.textContent === 'Waiting for the robot …'")


@pytest.mark.parametrize("window", [(1440, 900, False), (1024, 700, False), (390, 844, True)])
def test_all_of_the_page_fits_the_window(recorded, serve, browser, window):
    width, height, dark = window
    browser.open(serve(recorded).address, width, height, dark=dark)
    browser.until("window.looked > 3")
    assert browser.value("document.documentElement.scrollWidth") <= width
    assert browser.value("(tab => tab.scrollWidth - tab.clientWidth)(document.querySelector('#joints'))") == 0
    assert browser.value("document.querySelector('footer').getBoundingClientRect().bottom") <= height
    if width < 600:
        assert browser.place("#time")[2] > 0.9 * width, "the time line has no row of its own"
    ground = browser.value("getComputedStyle(document.documentElement).backgroundColor")
    assert (sum(map(int, ground[4:-1].split(","))) < 384) is dark
    assert errors(browser) == []


def test_a_page_whose_server_ended_says_so(log, serve, browser):
    served = serve(RecordedRobot(log))
    browser.open(served.address)
    browser.until("window.looked > 3")
    served.close()
    browser.until("document.querySelector('#banner').textContent.includes('has ended')")
    assert browser.value("document.body.dataset.phase") == "gone"
