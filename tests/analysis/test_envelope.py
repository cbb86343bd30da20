"""Analysis: what stands out among many samples stays visible on few columns."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from dxlrun.analysis.figures.drawing import Columns

VALUES = st.lists(st.one_of(st.floats(-1e6, 1e6), st.just(float("nan"))), min_size=1, max_size=300)


@settings(max_examples=200, deadline=None)
@given(values=VALUES, most=st.integers(1, 40))
def test_each_column_keeps_its_smallest_and_largest_sample(values: list[float], most: int) -> None:
    y = np.array(values)
    columns = Columns(len(y), most)
    x, drawn = columns.envelope(np.arange(len(y), dtype=np.float64), y)
    assert columns.number <= most
    assert np.all(np.diff(x) >= 0)
    np.testing.assert_array_equal(drawn, y[x.astype(int)])
    for start in range(0, len(y), columns.width):
        part = y[start : start + columns.width]
        shown = drawn[(x >= start) & (x < start + columns.width)]
        if not np.isnan(part).all():
            assert (np.nanmin(shown), np.nanmax(shown)) == (np.nanmin(part), np.nanmax(part))


@settings(max_examples=100, deadline=None)
@given(flags=st.lists(st.booleans(), min_size=1, max_size=300), most=st.integers(1, 40))
def test_a_column_is_marked_when_one_of_its_samples_is(flags: list[bool], most: int) -> None:
    columns = Columns(len(flags), most)
    marked = columns.marked(np.array(flags))
    assert all(flags[index] for index in marked)
    assert {index // columns.width for index in marked} == {
        index // columns.width for index, flag in enumerate(flags) if flag
    }


@settings(max_examples=100, deadline=None)
@given(values=st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=300), most=st.integers(1, 40))
def test_the_largest_of_a_column_is_found(values: list[float], most: int) -> None:
    y = np.array(values)
    columns = Columns(len(y), most)
    picked = columns.largest(y)
    low, middle, high = columns.bounds(y)
    np.testing.assert_array_equal(y[picked], high)
    assert np.all((low <= middle) & (middle <= high))
    assert y.max() in y[picked]
