"""The PID law against closed forms, scipy's filters and its own promises; live gains and the state."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dxlrun.control.controllers.live_parameters import live_names, value_of, with_values
from dxlrun_controllers.laws.pid import Pid, Slope
from dxlrun_controllers.pid_controller import PidController
from dxlrun_controllers.plugin import dxlrun_controllers

ALL = np.ones(1, dtype=bool)
NONE = np.zeros(1)


def law(p=0.0, i=0.0, d=0.0, *, filter_s=0.0, limit=np.inf, integral_limit=np.inf):
    pid = Pid(1)
    pid.p[:], pid.i[:], pid.d[:], pid.filter_s = p, i, d, filter_s
    pid.upper[:], pid.lower[:] = limit, -limit
    pid.integral_limit[:] = integral_limit
    return pid


def stepped(pid, error, period_s=0.01, *, rate=0.0, bias=0.0, measured=ALL):
    rows = (np.array([value], dtype=float) for value in (error, rate, bias))
    return float(pid.update(*rows, measured, period_s)[0])


@pytest.mark.parametrize("filter_s", [0.0, 0.001, 0.05, 3.0])
def test_the_filtered_derivative_is_scipys_backward_difference_of_its_transfer_function(filter_s):
    from scipy import signal

    h, d = 0.01, 0.7
    errors = np.random.default_rng(1).normal(size=300)
    if filter_s:
        numerator, denominator, _ = signal.cont2discrete(
            ([d, 0.0], [filter_s, 1.0]), h, method="backward_diff"
        )
        numerator = numerator.ravel()
    else:
        numerator, denominator = np.array([d, -d]) / h, [1.0]
    theirs = signal.lfilter(numerator, denominator, errors - errors[0])  # it begins at rest
    pid, slope = law(d=d, filter_s=filter_s), Slope(1)
    ours = [stepped(pid, e, h, rate=slope.update(np.array([e]), ALL, h)[0]) for e in errors]
    np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-9)


@settings(max_examples=50, deadline=None)
@given(periods=st.lists(st.floats(1e-4, 0.1), min_size=1, max_size=50))
def test_the_integral_goes_by_true_time_however_irregular_the_periods(periods):
    pid = law(i=3.0)
    for period in periods:
        output = stepped(pid, 0.25, period)
    assert output == pytest.approx(3.0 * 0.25 * sum(periods))


def test_at_its_limit_it_does_not_wind_up_and_leaves_with_the_first_error_of_the_other_sign():
    pid = law(p=1.0, i=5.0, limit=2.0)
    for _ in range(1000):
        assert stepped(pid, 1.0) <= 2.0
    assert pid.output[0] == 2.0
    assert pid.integral[0] == pytest.approx(1.0)  # what p leaves of the limit; without it, 50
    assert stepped(pid, -0.1) == pytest.approx(1.0 - 0.1 - 5.0 * 0.1 * 0.01)


def test_where_p_alone_is_beyond_the_limit_the_integral_rests_and_may_come_back():
    pid = law(p=10.0, i=5.0, limit=2.0)
    for _ in range(10):
        stepped(pid, 1.0)
    assert pid.integral[0] == 0.0
    pid.integral[:] = 0.5
    stepped(pid, 1.0, bias=-20.0)  # below the lower limit: a step up is allowed
    assert pid.integral[0] == pytest.approx(0.55)


def test_the_integral_has_a_limit_of_its_own():
    pid = law(i=100.0, integral_limit=0.3)
    assert [stepped(pid, error) for error in (1.0, 1.0, -1.0)] == pytest.approx([0.3, 0.3, -0.3])


numbers = st.floats(-100, 100)


@settings(max_examples=200, deadline=None)
@given(
    gains=st.tuples(*[st.floats(0, 50)] * 3),
    limit=st.floats(0.01, 20),
    steps=st.lists(st.tuples(numbers, numbers, numbers, st.booleans()), min_size=1, max_size=30),
)
def test_whatever_comes_the_output_is_inside_and_the_integral_never_pushes_further_out(gains, limit, steps):
    pid = law(*gains, limit=limit, integral_limit=5.0, filter_s=0.02)
    for error, rate, bias, measured in steps:
        before = pid.output[0], pid.integral[0]
        output = stepped(pid, error, rate=rate, bias=bias, measured=np.array([measured]))
        assert -limit <= output <= limit
        assert abs(pid.integral[0]) <= 5.0
        if not measured:
            assert (output, pid.integral[0]) == before
            continue
        free = pid.proportional[0] + pid.derivative[0] + bias + pid.integral[0]
        assert np.clip(free, -limit, limit) == pytest.approx(output, abs=1e-9)
        growth = pid.integral[0] - before[1]
        beyond = max(0.0, abs(free) - limit) if free * growth > 0 else 0.0
        assert beyond == pytest.approx(0.0, abs=1e-9) or growth == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("silent", [1, 3])
def test_without_a_measurement_the_output_stays_and_the_time_counts_when_the_next_one_comes(silent):
    pid = law(p=1.0, i=2.0)
    first = stepped(pid, 0.5)
    for _ in range(silent):
        assert stepped(pid, np.nan, measured=~ALL, rate=np.nan) == first
    assert stepped(pid, 0.5) == pytest.approx(0.5 + 2.0 * 0.5 * (0.02 + silent * 0.01))


def test_a_slope_spans_the_silence_and_begins_with_nothing():
    slope = Slope(1)
    found = [
        float(slope.update(np.array([value]), np.array([measured]), 0.1)[0])
        for value, measured in ((5.0, True), (5.1, True), (np.nan, False), (5.5, True))
    ]
    assert found == pytest.approx([0.0, 1.0, 1.0, 2.0])
    slope.reset()
    assert slope.update(np.array([9.0]), ALL, 0.1)[0] == 0.0


def test_a_reset_goes_on_with_the_output_that_there_is():
    pid = law(p=2.0, i=1.0, integral_limit=3.0)
    pid.reset(np.array([1.0]), np.array([0.25]), np.array([0.1]))
    assert stepped(pid, 0.25, 1e-9, bias=0.1) == pytest.approx(1.0)
    pid.reset(np.array([np.nan]), np.array([0.25]), NONE)
    assert pid.integral[0] == 0.0
    pid.reset(np.array([99.0]), np.array([0.25]), NONE)
    assert pid.integral[0] == 3.0
    pid.reset(np.array([-99.0]), np.array([0.25]), NONE)
    assert pid.integral[0] == -3.0
    pid.i[:] = 0.0
    pid.reset(np.array([1.0]), np.array([0.25]), NONE)
    assert stepped(pid, 0.25) == pytest.approx(0.5)  # no integral: no bias that nothing removes


def test_a_reset_forgets_the_filtered_rate_and_the_time_of_a_silence():
    pid = law(i=1.0, d=1.0, filter_s=0.05)
    stepped(pid, 1.0, rate=4.0)
    stepped(pid, np.nan, 7.0, measured=~ALL)
    pid.reset(NONE, NONE, NONE)
    assert stepped(pid, 1.0, 0.05) == pytest.approx(0.05)  # neither 7 s of the integral nor the rate of 4


TWO = {"joints": ["a", "b"]}


def test_it_is_the_joint_position_controller_too():
    assert dxlrun_controllers()["joint_position_controller"] == dxlrun_controllers()["pid_controller"]


def test_gains_are_live_each_by_its_name_and_those_of_a_mapping_by_joint():
    model = PidController.Parameters.model_validate(TWO | {"gains": {"p": {"a": 1.0, "b": 2.0}, "i": 0.5}})
    assert list(live_names(model)) == [f"gains.{name}" for name in ("p.a", "p.b", "i", "d", "feed_forward")]
    changed = with_values(model, {"gains.p.b": 3.0, "gains.i": 0.0})
    assert (changed.gains.p, changed.gains.i) == ({"a": 1.0, "b": 3.0}, 0.0)
    assert model.gains.p == {"a": 1.0, "b": 2.0}
    assert value_of(changed, "gains.p.b") == 3.0
    for unknown in ("gains.p", "gains.p.c", "gains.i.a", "output_limit"):
        with pytest.raises(ValueError, match="is not a live parameter"):
            with_values(model, {unknown: 1.0})
