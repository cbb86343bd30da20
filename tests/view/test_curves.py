"""Curves: what is kept of a running robot, and what a plot gets."""

import math

import msgspec
import numpy as np
import pytest
from tests.kit.torso import ROBOTS

from dxlrun import RemoteRobot
from dxlrun.testing import plan_of
from dxlrun.tooling.runs import VirtualLink
from dxlrun_view.curves import History, numbers_in, thinned
from dxlrun_view.live_robot import LiveRobot


def test_memory_holds_the_newest_moments_and_no_more():
    history = History(("a", "b"), 10)
    assert history.at().values == []
    for number in range(25):
        history.append(float(number), np.array([number, np.nan]))
    assert len(history) == 10
    assert history.span == (15.0, 24.0)
    assert history.at().time == 24.0
    assert history.at().values == [24.0, None]
    assert history.at(17.5).time == 17.0
    assert history.at(0.0).time == 15.0
    assert history.curve("a", 0.0, 99.0, 100).value == list(range(15, 25))
    assert history.curve("a", 18.2, 19.5, 100).time == [18.0, 19.0, 20.0]  # one beyond each side, to draw to
    with pytest.raises(KeyError):
        history.curve("c", 0.0, 1.0, 10)


@pytest.mark.parametrize("count", [1, 9, 10, 11, 20, 37])
def test_times_are_found_wherever_the_memory_begins(count):
    history = History(("a",), 10)
    for number in range(count):
        history.append(number / 2, np.array([number]))
    for number in range(max(0, count - 10), count):
        assert history.at(number / 2 + 0.1).values == [number]


def test_no_peak_is_lost_by_thinning():
    values = np.zeros(100_000)
    values[54_321], values[777] = 9.0, -7.0
    curve = thinned("a", np.arange(100_000) / 1e3, values, 300)
    assert len(curve.time) <= 300
    assert {9.0, -7.0} <= set(curve.value)
    assert curve.time == sorted(curve.time)
    unknown = thinned("a", np.arange(1000.0), np.full(1000, np.nan), 100)
    assert set(unknown.value) == {None}


def test_numbers_of_a_message_are_named():
    message = {"error": np.array([0.1, 0.2]), "name": "arm", "pose": {"x": 1}, "on": True, "names": ["a"]}
    found = numbers_in(message, "/arm/state:")
    assert found == {
        "/arm/state:error[0]": 0.1,
        "/arm/state:error[1]": 0.2,
        "/arm/state:pose.x": 1.0,
        "/arm/state:on": 1.0,
    }
    assert numbers_in({"long": np.zeros(1000)}, "") == {}
    assert math.isnan(numbers_in({"x": math.nan}, "")["x"])


def test_curves_start_again_with_a_run_whose_clock_is_earlier() -> None:
    with RemoteRobot("t", VirtualLink(plan_of(ROBOTS / "single_joint.yaml", duration_s=1.0))) as robot:
        states = robot.states()
    live, began_ns = LiveRobot("t"), 10**10
    for cycle, late_ns in enumerate((20, 40, 0)):
        live._note_cycle(msgspec.structs.replace(states, cycle=cycle, time_ns=began_ns + late_ns * 10**6))
    assert live.curve("loop/cycle", 0.0, 99.0, 9).value == [2.0]
