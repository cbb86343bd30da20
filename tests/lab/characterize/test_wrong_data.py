"""What cannot be measured is reported with the reason, and not invented."""

import math
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from tests.kit.campaigns import campaign

from dxlrun_lab.characterize import characterization_tables, dead_band, gaps, rates, response, speeds
from dxlrun_lab.characterize.joint_figure import JointFigure
from dxlrun_lab.characterize.trace import Trace

pytestmark = pytest.mark.long

TICK = math.radians(0.088)


def stepping(noise: float, *, lag_s: float = 0.03, delay_s: float = 0.02) -> list[response.StepResponse]:
    """Return steps that begin with the square of the time after a delay; `noise`, rad, of positions."""
    random, found = np.random.default_rng(3), []
    for rate in (44, 47, 51, 53, 57, 61):
        time = np.arange(round(2.5 * rate)) / rate
        number = (time / 0.5 + 1e-9).astype(int)
        levels = 0.14 * np.array([0, 1, 2, 1, 0])[number]
        position = np.zeros(len(time))
        for start in np.flatnonzero(np.diff(number)) + 1:
            since = np.maximum(time - (time[start] + 0.001) - delay_s, 0.0)
            position += (levels[start] - levels[start - 1]) * (1 - np.exp(-((since / lag_s) ** 2)))
        position = np.round((position + noise * random.standard_normal(len(time))) / TICK) * TICK
        found += response.steps_of(Trace(time, position, time + 0.001, levels, TICK))
    return found


def test_noise_widens_the_interval_until_nothing_is_reported():
    quiet, noisy = (response.response(stepping(noise)) for noise in (0.0, 1.5 * TICK))
    assert quiet[0].value == pytest.approx(0.020, abs=0.002)
    assert quiet[1].value == pytest.approx(0.020 + 0.03, rel=0.05)
    assert noisy[1].uncertainty > quiet[1].uncertainty
    first, rise = response.response(stepping(0.05))
    assert (first.value, rise.value) == (None, None)
    assert "steps started at rest; 6 are needed" in first.why


@pytest.mark.parametrize(
    ("value", "uncertainty", "shown", "shown_uncertainty"),
    [(0.002, 0.001, "2 ms", "± 1"), (0.001, 0.002, "below 3 ms", ""), (-0.001, 0.001, "below 2 ms", "")],
)
def test_a_figure_that_is_not_distinct_from_0_is_an_upper_bound(value, uncertainty, shown, shown_uncertainty):
    one = JointFigure("response", "s", value, uncertainty)
    assert characterization_tables.format_figure(one) == shown
    assert characterization_tables.shown_uncertainty(one) == shown_uncertainty


def test_estimators_refuse_nothing_and_motions_without_motion():
    def steps(way: float, height: float) -> list[response.StepResponse]:
        rows = np.full(50, way), np.full(50, height)
        return [response.StepResponse(np.arange(50) * 0.01, *rows, height, way, 0.0, TICK)] * 8

    assert response.response([])[0].why.startswith("only 0 steps started at rest")
    still = steps(0.0, 0.1)
    assert "the joint moved by only 0 deg in steps of 5.7 deg" in response.response(still)[0].why
    small = response.response(steps(0.01, 0.01))[0].why
    assert "too small for positions in ticks of 0.088 deg; give a range of about 2 deg" in small
    found = speeds.speeds(still, 1.0, 5.0)
    assert {(figure.value, figure.why) for figure in found} == {(None, "the joint hardly moved")}
    assert dead_band.dead_band([], TICK, {}, TICK)[0].value is None
    assert gaps.longest_gap([], "position", 0.02, 0.004, 1.0).value is None
    kept = [gaps.GapResult(gap / 100, 0.001, False) for gap in range(1, 5)]
    why = gaps.longest_gap(kept, "position", 0.02, 0.004, 1.0).why
    assert "stayed within 1.1 deg at the longest tried gap, 40 ms" in why


def test_a_joint_that_does_not_follow_its_goal_has_no_dead_band():
    """Its goal moves within the dead band: the errors at its rests are those of the goal, and say nothing."""
    rows, _ = dead_band.table(dead_band.stops([-0.01, 0.0, 0.01], 0.05), 1 / 60)
    time = np.arange(len(rows)) / 60
    stuck, moved = (
        dead_band.approaches(Trace(time, position, time + 0.001, rows, TICK))
        for position in (np.zeros(len(rows)), np.roll(rows, 2))
    )
    assert (len(stuck), len(moved)) == (0, 12)
    band, change = dead_band.dead_band(stuck, TICK, {}, TICK)
    assert (band.value, change.value) == (None, None)
    assert band.why == "the joint did not follow its goal, or did not come to rest"
    assert dead_band.dead_band(moved, TICK, {}, TICK)[0].value == pytest.approx(0.0, abs=1e-9)


def test_a_longest_gap_is_one_that_left_the_path_or_in_which_the_joint_rested():
    kept = gaps.GapResult(0.01, 0.001, False)
    rested = gaps.longest_gap([kept, gaps.GapResult(0.02, 0.002, True)], "posvel", 0.02, 0.004, 1.0)
    assert (rested.value, rested.limit) == (pytest.approx(0.015), "the joint stops between commands")
    left = gaps.longest_gap([kept, gaps.GapResult(0.02, 0.021, False)], "position", 0.0191, 0.004, 1.0)
    assert left.value == pytest.approx(0.01905)
    assert left.value - left.uncertainty <= 0.01 + 1e-12, "all between the gaps that were tried"


@pytest.mark.parametrize(
    ("lost", "too_long", "late", "exchange_s", "fault"),
    [(0, 20, 400, 0.0008, ""), (0, 990, 0, 0.0021, "bus"), (2, 0, 0, 0.0008, "servo")],
)
def test_the_machines_lateness_does_not_count_against_a_rate(lost, too_long, late, exchange_s, fault):
    assert rates.RateResult(500.0, 1000, lost, too_long, late, exchange_s).fault == fault


@pytest.mark.parametrize(
    ("begin", "step", "keeps", "expected"),
    [
        (50.0, 50, 260.0, [50, 100, 150, 200, 250, 300]),
        (100.0, 50, 60.0, [50, 100]),
        (50.0, 50, 5000.0, [*range(50, 401, 50)]),
        (125.0, 0, 200.0, None),
    ],
)
def test_the_search_continues_with_the_next_rate_that_controllers_allow(begin, step, keeps, expected):
    """A controller of 50 Hz, as most robots have one, leaves multiples of it: less than GROWS allows."""
    judged = []
    while (rate := rates.following(judged, begin, 410.0, Fraction(step))) is not None:
        judged.append(rates.RateResult(rate, 100, 0 if rate <= keeps else 50, 0, 0, 0.001))
    tried = sorted(one.rate for one in judged)
    if expected is not None:
        assert tried == expected
    else:
        assert 0.98 * keeps < max(rate for rate in tried if rate <= keeps) <= keeps


def test_a_joint_that_is_stuck_has_no_figures(measures):
    done = measures(["response"], "MX-64", simulation="{friction: 5.5 Nm}")
    figures = done.result.joints[0].figures
    assert figures
    for figure in figures:
        assert figure.value is None, figure
        assert "the joint moved by only 0 deg" in figure.why
    assert done.result.why == ""


@campaign(ci=0, night=1, release=1)
@pytest.mark.parametrize("model", ["AX-12A", "MX-64"])
def test_the_range_that_is_named_does(measures, model):
    why = measures(["speed"], model, reach=0.2).figure(speeds.TOP).why
    needed = math.radians(float(why.rpartition("about ")[2].removesuffix(" deg")))
    assert measures(["speed"], model, reach=needed / 2).figure(speeds.TOP).value is not None


def lose(rig: Any, cycle: int) -> None:
    bus = rig.robot.link.simulated.buses[0]
    if bus.now_ns > 25_000_000_000 and not bus.servo(1).is_silent:
        bus.servo(1).silence()


def test_a_small_range_is_named_and_a_lost_servo_keeps_what_was_measured_before(measures):
    done = measures(["speed", "dead_band"], "AX-12A", reach=0.2, each_cycle=lose)
    top = done.figure(speeds.TOP)
    assert top.value is None
    assert top.why.startswith("the range of 23 deg is too small: the joint reached ")
    assert done.figure(speeds.ACCELERATION).value is not None
    assert done.result.why == "joint joint (ID 1 on bus main) is lost"
    band = done.figure(dead_band.NAME)
    assert (band.value, band.why) == (None, f"the experiment ended early: {done.result.why}")


def test_steps_before_an_early_end_give_a_response(measures):
    done = measures(["response"], each_cycle=lose)
    assert done.result.why
    assert 6 <= done.figure(response.RISE).count < 60
    assert done.figure(response.RISE).value is not None
