"""Analysis: what stands out among many samples stays visible in few columns and bins."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dxlrun_analysis.page.envelope import Envelope, EnvelopeRows
from dxlrun_lab.figures import drawing

VALUES = st.lists(st.one_of(st.floats(-1e6, 1e6), st.just(float("nan"))), min_size=1, max_size=300)


@settings(max_examples=60, deadline=None)
@given(values=VALUES, columns=st.integers(1, 40))
def test_each_column_keeps_its_smallest_and_largest_sample(values, columns):
    y = np.array(values)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(drawing, "_COLUMNS", columns)
        x, drawn = drawing.reduced(np.arange(len(y), dtype=np.float64), y)
    width = -(-len(y) // columns)
    assert len(x) <= 2 * columns
    assert np.all(np.diff(x) >= 0)
    np.testing.assert_array_equal(drawn, y[x.astype(int)])
    for start in range(0, len(y), width):
        part = y[start : start + width]
        shown = drawn[(x >= start) & (x < start + width)]
        if not np.isnan(part).all():
            assert (np.nanmin(shown), np.nanmax(shown)) == (np.nanmin(part), np.nanmax(part))


SLICES = st.lists(
    st.lists(
        st.tuples(st.integers(1, 10**12), st.one_of(st.floats(-1e6, 1e6, width=32), st.just(float("nan")))),
        max_size=30,
    ),
    max_size=8,
)
"""Time since the sample before, ns, and value of each sample, slice by slice."""


def laid(
    slices: list[list[tuple[int, float]]], most: int, width_ns: int
) -> tuple[EnvelopeRows, np.ndarray, np.ndarray]:
    """Return the rows of an envelope of two curves, and the times and values that it took."""
    envelope = Envelope(2, most, width_ns)
    times, values, now = [], [], 10**15
    for one in slices:
        begin = len(times)
        for step, value in one:
            now += step
            times.append(now)
            values.append((value, -value))
        part = np.array(values[begin:], np.float32).reshape(-1, 2)
        envelope.add_samples(np.array(times[begin:], np.int64), part)
    return envelope.rows(), np.array(times, np.int64), np.array(values, np.float32).reshape(-1, 2)


@settings(max_examples=60, deadline=None)
@given(slices=SLICES, most=st.integers(2, 20), width_ns=st.integers(1, 10**6))
def test_bins_of_any_number_of_slices_hold_the_extremes_of_their_samples(slices, most, width_ns):
    rows, times, values = laid(slices, most, width_ns)
    assert len(rows.t_ns) <= most + most % 2
    assert np.isin(rows.t_ns, times).all()
    assert (np.diff(rows.t_ns) > 0).all()
    of = np.searchsorted(rows.t_ns, times, side="right") - 1
    for row in range(len(rows.t_ns)):
        mine = values[of == row]
        for curve in range(2):
            known = mine[~np.isnan(mine[:, curve]), curve]
            expected = (known.min(), known.max()) if len(known) else (np.nan, np.nan)
            np.testing.assert_array_equal((rows.low[row, curve], rows.high[row, curve]), expected)


def test_samples_that_come_late_go_into_the_bin_of_their_time():
    envelope = Envelope(1, 4, 10)
    envelope.add_samples(np.array([100, 110, 120]), np.array([[1.0], [2.0], [3.0]], np.float32))
    envelope.add_samples(np.array([125, 112]), np.array([[9.0], [-9.0]], np.float32))
    rows = envelope.rows()
    assert rows.t_ns.tolist() == [100, 110, 120]
    assert rows.low.ravel().tolist() == [1.0, -9.0, 3.0]
    assert rows.high.ravel().tolist() == [1.0, 2.0, 9.0]


def rows_of(times: list[int]) -> EnvelopeRows:
    values = np.arange(len(times), dtype=np.float32)[:, None]
    return EnvelopeRows(np.array(times, np.int64), values, values + 0.5)


def test_in_a_window_each_sample_has_a_row_and_no_bin_hides_what_lies_behind_it():
    samples = np.array([20, 25, 30], np.int64), np.array([[7.0], [8.0], [9.0]], np.float32)
    rows = rows_of([0, 10, 20, 30, 40]).and_samples(*samples, [(20, 35)])
    assert rows.t_ns.tolist() == [0, 10, 20, 25, 30, 35, 40]
    assert rows.low.ravel().tolist() == [0.0, 1.0, 7.0, 8.0, 9.0, 3.0, 4.0]
    assert rows.high.ravel().tolist() == [0.5, 1.5, 7.0, 8.0, 9.0, 3.5, 4.5]


def test_no_line_goes_across_a_long_time_without_samples():
    rows = rows_of([0, 10, 500, 510]).with_gaps(100)
    assert rows.t_ns.tolist() == [0, 10, 11, 500, 510]
    np.testing.assert_array_equal(np.isnan(rows.low.ravel()), [False, False, True, False, False])
    assert rows_of([0, 10]).with_gaps(100).t_ns.tolist() == [0, 10]
