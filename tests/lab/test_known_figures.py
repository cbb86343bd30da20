"""Figures of made-up recordings, whose numbers are known exactly; and a rig that leaves a pause as it was."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from dxlrun_lab.characterize.dead_band import SLOW, approaches, stops, table
from dxlrun_lab.characterize.response import steps_of
from dxlrun_lab.characterize.trace import Trace
from dxlrun_lab.guided.rig import Rig
from dxlrun_lab.identify.result import KnownLoad, _PhysicalValues

BAND, LAG_S, SENT_S = 0.01, 0.05, 0.004


def test_dead_bands_of_both_sides_add_up_and_the_lag_of_a_moving_joint_is_not_one() -> None:
    """A joint that follows its goal of 50 ms ago, but not nearer than its dead band."""
    goals, _ = table(stops([0.2], 0.1), 0.01)
    position = [goals[0]]
    for goal in np.concatenate([np.full(round(LAG_S / 0.01), goals[0]), goals])[: len(goals) - 1]:
        position.append(float(np.clip(position[-1], goal - BAND, goal + BAND)))
    time = np.arange(len(goals)) * 0.01
    found = approaches(Trace(time, np.array(position), time, goals, 1e-5))
    assert {one.upward for one in found} == {True, False}
    assert [one.short for one in found] == pytest.approx([BAND] * len(found))
    reversals = [one.reversal for one in found if np.isfinite(one.reversal)]
    assert reversals
    assert reversals == pytest.approx([2 * BAND] * len(reversals), abs=SLOW * LAG_S / 4)


def test_response_times_count_from_the_sent_goal() -> None:
    time = np.arange(100) * 0.01
    goal = np.where(time < 0.5, 0.0, 0.1)
    (step,) = steps_of(Trace(time, np.roll(goal, 2), time + SENT_S, goal, 1e-4))
    assert step.time[step.goal > 0][0] == pytest.approx(-SENT_S)


def test_inertia_of_a_known_load_is_not_that_of_the_servo() -> None:
    servo: Any = SimpleNamespace(p_gain=32, table=SimpleNamespace(nominal_voltage=12.0, stall_torque=6.0))
    with_load, alone = (
        _PhysicalValues(servo, "manual", load).figures_of(np.ones(20))["inertia"]
        for load in (KnownLoad(0.005), KnownLoad())
    )
    assert alone - with_load == pytest.approx(0.005)


def test_a_run_that_a_client_had_paused_stays_paused(single: Rig) -> None:
    entry = {"type": "joint_state_broadcaster"}
    single.load_controller("first", entry)
    assert not single.paused
    with single._asking() as robot:
        robot.pause()
    single.load_controller("second", entry)
    assert single.paused
