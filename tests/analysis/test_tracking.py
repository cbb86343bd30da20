"""Tracking against the trajectory that a servo could reach, of joints with a known way."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from msgspec import structs
from tests.kit.made_logs import loop_of, made_log

from dxlrun.channels.cycle import CycleLayout, Torque
from dxlrun.log.log_reader import Log, read_log
from dxlrun.output.json import json_text
from dxlrun.plan.loop_plan import JointPlan
from dxlrun_analysis.joints.goal_tracking import JointTracking, reachable, tracking
from dxlrun_analysis.report import analyze, tables

DT = 0.02
TICK = math.radians(300) / 1023
Way = npt.NDArray[np.float64]
Make = Callable[..., Log]
NECK = JointPlan("neck", -3.0, 3.0, None, top_speed=6.0)


@pytest.fixture
def make(tmp_path: Path) -> Make:
    """Return a log of one AX-12A that was sent these goals, and was read at these positions, one a cycle."""

    def make(
        goals: Way,
        positions: Way,
        speed: float = math.nan,
        registers: dict[str, int] | None = None,
        **joint: Any,
    ) -> Log:
        servo = {"joint": "neck", "model": "MX-64", "rad_per_tick": TICK, "rad_s_per_tick": 0.01}
        servo["registers"] = [{"name": name, "value": value} for name, value in (registers or {}).items()]
        plan = {
            "loop": loop_of(joints=(structs.replace(NECK, **joint),)),
            "buses": [{"protocol": 1.0, "servos": [servo]}],
        }
        log = read_log(made_log(tmp_path, plan=plan))
        cycles = np.zeros(len(goals), CycleLayout(("neck",), []).dtype)
        number = np.arange(len(goals))
        cycles["cycle"] = number
        for name in ("scheduled_ns", "woken_ns", "read_ns", "updated_ns", "written_ns"):
            cycles[name] = 10**9 + number * round(DT * 1e9)
        cycles["position"][:, 0], cycles["goal_position"][:, 0] = positions, goals
        cycles["goal_velocity"][:, 0] = speed
        cycles["valid"][:, 0] = np.isfinite(positions)
        header = structs.replace(log.header, joints=("neck",), controllers=())
        return replace(log, header=header, cycles=cycles)

    return make


def stepped(count: int, at: int, goal: float) -> Way:
    """Return goals that are 0 before a cycle, and another one from it on."""
    return np.where(np.arange(count) < at, 0.0, goal)


def ramp(count: int, at: int, goal: float, speed: float, delay: int = 0) -> Way:
    """Return the way to a goal that was sent in a cycle, at a speed, some cycles late."""
    return np.clip((np.arange(count) - at - delay) * DT * speed, 0.0, goal)


def only(log: Log) -> JointTracking:
    (joint,) = tracking(log)
    return joint


def test_the_way_of_a_step_is_no_error(make: Make) -> None:
    log = make(stepped(150, 10, 1.0), ramp(150, 10, 1.0, 0.5), speed=0.5)
    joint = only(log)
    assert (joint.rms_rad, joint.worst_rad) == pytest.approx((0.0, 0.0), abs=1e-9)
    assert (joint.lag_ms, joint.settling_ms, joint.rest_rad) == pytest.approx((0.0, 0.0, 0.0), abs=1e-6)


@pytest.mark.parametrize(
    ("limits", "speed"), [({}, 6.0), ({"velocity": 2.0}, 2.0), ({"top_speed": None}, None)]
)
def test_without_a_speed_the_lower_one_of_the_limits_counts(
    make: Make, limits: dict[str, float | None], speed: float | None
) -> None:
    log = make(stepped(100, 10, 1.0), np.zeros(100), **limits)
    expected = ramp(100, 10, 1.0, 1e9 if speed is None else speed)
    assert reachable(log, 0) == pytest.approx(expected)
    assert only(log).worst_rad == pytest.approx(1.0)  # it never moved, and that is an error


def test_a_declared_acceleration_counts(make: Make) -> None:
    # Goal Acceleration (73) of an MX-64: 8.583 deg/s^2 each
    log = make(stepped(200, 10, 1.0), np.zeros(200), speed=2.0, registers={"goal_acceleration": 20})
    way, ramp_rad_s2 = reachable(log, 0), 20 * math.radians(8.583)
    faster = np.diff(np.diff(way)) / DT**2
    assert np.abs(faster[:40]).max() == pytest.approx(ramp_rad_s2)
    # 2 * sqrt(way / acceleration) for a triangle
    arrived = int(np.argmax(way == 1.0)) - 10
    assert arrived * DT == pytest.approx(2 * math.sqrt(1.0 / ramp_rad_s2), abs=4 * DT)
    assert way.max() == 1.0


def test_lag_is_the_delay_on_the_way(make: Make) -> None:
    log = make(stepped(200, 10, 1.0), ramp(200, 10, 1.0, 0.5, delay=3), speed=0.5)
    joint = only(log)
    assert joint.lag_ms == pytest.approx(60.0, rel=0.02)
    assert joint.worst_rad == pytest.approx(0.5 * 0.06)
    assert joint.settling_ms == pytest.approx(20.0, abs=20.1)  # 0.03 of a way of 1 are left, and 2 % are near
    assert joint.rest_rad == pytest.approx(0.0, abs=1e-9)


@pytest.mark.filterwarnings("error")
def test_a_joint_that_rests_wherever_its_goals_are_known_has_no_lag(make: Make) -> None:
    goals = np.concatenate((np.full(60, 0.0), np.full(80, np.nan), np.full(60, 1.0)))  # an effort in between
    assert only(make(goals, np.nan_to_num(goals))).lag_ms is None


def test_a_stream_that_the_servo_can_follow_is_its_own_way(make: Make) -> None:
    t = np.arange(500) * DT
    goals, late = 0.4 * np.sin(2 * t), 0.4 * np.sin(2 * (t - DT - 0.03))
    joint = only(make(goals, late))
    assert joint.lag_ms == pytest.approx(30.0, rel=0.02)
    assert joint.worst_rad == pytest.approx(0.8 * 0.03, rel=0.02)
    assert (joint.settling_ms, joint.rest_rad) == (None, None)


def test_a_stream_that_is_too_fast_is_cut_to_the_speed_that_there_is(make: Make) -> None:
    goals = np.concatenate((np.linspace(0.0, 4.0, 50), np.full(150, 4.0)))  # 4 rad/s
    log = make(goals, np.zeros(200), velocity=2.0)
    way = reachable(log, 0)
    assert np.diff(way).max() == pytest.approx(2.0 * DT)
    assert int(np.argmax(way == 4.0)) == pytest.approx(100, abs=2)


def test_ringing_is_settling_and_sagging_is_error_at_rest(make: Make) -> None:
    after = np.maximum(np.arange(300) - 110, 0) * DT  # 1 rad at 0.5 rad/s from cycle 10 on
    rings = 0.1 * np.exp(-after / 0.2) * np.sin(20 * after) * (after > 0)
    joint = only(make(stepped(300, 10, 1.0), ramp(300, 10, 1.0, 0.5) + rings - 0.05 * (after > 0), speed=0.5))
    outside = after[np.abs(rings) > 0.02].max()
    assert joint.settling_ms == pytest.approx((outside + DT) * 1e3, abs=21)
    assert joint.settling_ms is not None
    assert joint.settling_ms > 200
    assert joint.rest_rad == pytest.approx(0.05, abs=2e-3)


def test_a_way_begins_where_the_joint_stands_when_it_gets_a_goal(make: Make) -> None:
    goals = np.concatenate((np.full(20, np.nan), np.full(80, 1.0)))
    positions = np.full(100, 0.4)
    positions[20:23] = np.nan  # and is read
    log = make(goals, positions, speed=0.5)
    way = reachable(log, 0)
    assert np.isnan(way[:23]).all()
    assert way[23:] == pytest.approx(np.minimum(0.4 + np.arange(77) * DT * 0.5, 1.0))
    nothing = only(make(np.full(20, np.nan), positions[:20]))
    assert (nothing.rms_rad, nothing.worst_rad, nothing.lag_ms, nothing.rest_rad) == (None, None, None, None)


def test_a_joint_that_is_given_torque_goes_to_no_goal_from_before(make: Make) -> None:
    """A reboot took it back by two turns, and its goal with it."""
    goals = stepped(100, 40, -4 * math.pi)
    log = make(goals, goals, speed=0.5)
    log.cycles["torque"] = Torque.ON
    log.cycles["torque"][40:60] = Torque.OFF
    log.cycles["torque"][60] = Torque.GIVEN
    assert reachable(log, 0)[62:] == pytest.approx(np.full(38, -4 * math.pi))


def test_a_speed_of_0_is_the_slowest_and_not_none(make: Make) -> None:
    way = reachable(make(stepped(100, 10, 1.0), np.zeros(100), speed=0.0), 0)
    assert way[-1] == pytest.approx(89 * DT * 0.01)


def test_of_several_ways_the_longest_settling_and_the_greatest_error_at_rest_count(make: Make) -> None:
    goals = np.concatenate((stepped(150, 10, 1.0), np.full(150, 2.0)))
    way = np.concatenate((ramp(150, 10, 1.0, 0.5), 1.0 + ramp(150, 0, 1.0, 0.5)))
    way[110:151] += 0.05  # the first rests farther off, the second comes there later
    joint = only(make(goals, np.where(way > 1.5, way - 0.2 * (np.arange(300) < 280), way), speed=0.5))
    assert joint.rest_rad == pytest.approx(0.05, abs=0.002)
    assert joint.settling_ms is not None
    assert joint.settling_ms > 300


def test_states_that_are_not_valid_are_no_error_and_a_joint_that_stands_has_no_lag(make: Make) -> None:
    positions = np.full(100, 0.001 * np.arange(100) % 2)
    positions[50] = np.nan
    log = make(np.zeros(100), positions)
    cycles = log.cycles.copy()
    cycles["position"][50, 0] = 3.0  # any value may stand there
    joint = only(replace(log, cycles=cycles))
    assert (joint.invalid, joint.lag_ms) == (1, None)
    assert joint.worst_rad == pytest.approx(0.099)


def test_a_first_goal_is_approached_from_where_the_joint_stands(make: Make) -> None:
    way = reachable(make(np.full(100, 1.0), np.zeros(100), speed=0.5), 0)
    assert way[1:] == pytest.approx(np.minimum(np.arange(1, 100) * DT * 0.5, 1.0), abs=DT)


def test_terminal_report_and_json_have_the_same_numbers(make: Make) -> None:
    from dxlrun_analysis.page.report_page import analyzed_page

    log = make(stepped(200, 10, 1.0), ramp(200, 10, 1.0, 0.5, delay=3), speed=0.5)
    report = analyze(log)
    (row,) = tables(report)["joints"].rows
    shown = dict(zip((column.name for column in tables(report)["joints"].columns), row, strict=True))
    assert [shown[name].text for name in ("worst", "lag", "at rest")] == ["1.72", "59 ms", "0.00"]
    (as_json,) = json.loads(json_text(report.numbers))["joints"]
    assert as_json["lag_ms"] == pytest.approx(60.0, rel=0.02)
    assert as_json["worst_rad"] == pytest.approx(0.03)
    words = "worst 1.72 deg (position minus reachable trajectory), lag 59 ms, settled after"
    assert words in analyzed_page(log)[1]
