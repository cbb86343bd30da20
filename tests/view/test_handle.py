"""A tip that is dragged on the page: planned and shown, and moved once it is sent; judged by the ledger."""

import json
import math
from typing import Any

import numpy as np
import pytest
from tests.kit.awaited import until
from tests.kit.judged_arms import example
from tests.kit.torso import ROBOTS, Run
from tests.kit.wire import changes
from tests.view.served import Served
from tests.view.test_in_browser import errors

from dxlrun.testing import plan_of
from dxlrun_view.live_robot import LiveRobot
from dxlsim.bus.ledger import read_ledger

pytestmark = pytest.mark.long

NAME = "open_manipulator_x_space"
ARM = example(NAME, "link1", "end_effector_link", "joint1", "joint2", "joint3", "joint4")
TICK = math.tau / 4096


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    one = Run(tmp_path_factory.mktemp("arm"), robot=NAME, rate=10)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_RUNTIME_DIR", str(one.place))
        one.start()
        yield one
        one.end()


@pytest.fixture
def page(arm):
    robot = LiveRobot(NAME)
    served: list[Served] = []

    def make(*, control: bool) -> Served:
        served.append(Served(robot, control=control))
        return served[-1]

    yield make
    for each in served:
        each.close()
    robot.close()


def sent(arm: Run) -> list[float]:
    """Return the goals of the joints that the servos got last, rad."""
    found = changes(read_ledger(arm.ledger), plan_of(ROBOTS / f"{NAME}.yaml"), 116)
    return [(found[servo][-1][1] - 2048) * TICK for servo in (11, 12, 13, 14)]


def tip(arm: Run) -> Any:
    return ARM.matrix(sent(arm))[:3, 3]


def acted(served: Served, verb: str, position: Any, **more: object) -> tuple[int, Any]:
    message = {"verb": verb, "controller": "arm", "position": list(position), **more}
    status, answer = served.ask("/act", message)
    return status, json.loads(answer)


def test_a_pose_is_planned_without_a_motion_and_then_sent(arm, page):
    served = page(control=True)
    until(lambda: served.look(shown=True)["shown"]["columns"])
    handle = {"controller": "arm", "tip": "end_effector_link", "base": ""}
    assert served.look(shown=True)["shown"]["handles"] == [handle]
    begin, goal = until(lambda: sent(arm)), (0.2, 0.05, 0.15)
    status, plan = acted(served, "plan", goal)
    assert status == 200
    assert ARM.matrix([plan["goal"][joint] for joint in ARM.joints])[:3, 3] == pytest.approx(goal, abs=1e-4)
    assert acted(served, "plan", (0.9, 0.0, 0.1))[1]["goal"] == {}
    assert "out of reach" in acted(served, "plan", (0.9, 0.0, 0.1))[1]["said"]
    off = acted(served, "plan", goal, quaternion=[0.0, 0.0, math.sin(0.6), math.cos(0.6)])[1]
    assert "deg from the orientation" in off["said"]
    assert acted(served, "plan", goal, quaternion=[0.0, 0.0, 0.0, 2.0])[0] == 409
    assert sent(arm) == begin, "a plan moved a joint"
    assert acted(served, "pose", goal)[0] == 200
    assert "moves" in acted(served, "plan", goal)[1]["refused"]
    until(lambda: acted(served, "plan", goal)[0] == 200, lambda: acted(served, "plan", goal))  # at its end
    until(lambda: np.abs(tip(arm) - goal).max() < 1e-3)
    assert [acted(page(control=False), verb, goal)[0] for verb in ("plan", "pose")] == [403, 403]


def test_a_handle_is_dragged_and_sent(arm, page, browser):
    browser.open(page(control=True).address)
    browser.until("document.querySelector('#handle')?.options.length === 2")
    begin = tip(arm)
    choose = "(list => { list.value = 'arm'; list.dispatchEvent(new Event('change')); })"
    browser.value(f"{choose}(document.querySelector('#handle'))")
    browser.until("!!document.querySelector('#handle').dataset.place")
    assert browser.value("document.querySelector('#send').disabled")
    left, top, *_ = browser.place("#scene")
    x, y = map(float, browser.value("document.querySelector('#handle').dataset.place").split(","))
    before = browser.picture("#scene")
    browser.drag((left + x, top + y), (left + x - 20, top + y + 25))
    browser.until("!document.querySelector('#send').disabled")
    assert browser.differing(before, browser.picture("#scene")) > 0.005, "no ghost"
    assert tip(arm) == pytest.approx(begin, abs=1e-9), "it moved before it was sent"
    browser.click("#send")
    until(lambda: np.linalg.norm(tip(arm) - begin) > 0.01)
    assert errors(browser) == []
