"""Distributions: exact while they are small, within their stated resolution beyond."""

from __future__ import annotations

import numpy as np
import pytest

from dxlrun_analysis.cycles.distribution import EXACT_VALUES, RESOLUTION, Distribution

SHARES = (0.0, 0.5, 0.99, 1.0)


def collected(values: np.ndarray, pieces: int) -> Distribution:
    found = Distribution()
    for piece in np.array_split(values, pieces):
        found.take(piece)
    return found


@pytest.mark.parametrize("pieces", [1, 7])
def test_quantiles_of_few_values_are_exact(pieces: int) -> None:
    values = np.random.default_rng(1).integers(0, 10**9, 1000)
    found = collected(values, pieces)
    assert found.quantiles(*SHARES) == pytest.approx(np.quantile(values, SHARES), rel=1e-12)
    assert (found.count, found.largest) == (1000, values.max())


@pytest.mark.parametrize("pieces", [1, 9])
@pytest.mark.parametrize("most", [200, 10**5, 10**13])
def test_quantiles_of_many_values_are_within_the_resolution(most: int, pieces: int) -> None:
    values = np.random.default_rng(2).integers(0, most, EXACT_VALUES + 1)
    found = collected(values, pieces)
    exact = np.quantile(values, SHARES, method="lower")
    np.testing.assert_allclose(found.quantiles(*SHARES), exact, rtol=RESOLUTION * 1.01, atol=0.5)
    assert found.quantiles(1.0) <= (found.largest,)


def test_memory_stays_the_same() -> None:
    found = Distribution()
    for _ in range(20):
        found.take(np.arange(EXACT_VALUES // 4))
    assert found.count == 5 * EXACT_VALUES
    assert found._pieces == []


def test_of_nothing_there_are_zeros_and_below_zero_is_zero() -> None:
    found = Distribution()
    found.take(np.zeros(0, np.int64))
    assert (found.count, found.quantiles(0.5)) == (0, (0.0,))
    found.take(np.array([-5, 4, 10]))
    assert (found.quantiles(0.0, 0.5, 1.0), found.largest) == ((0.0, 4.0, 10.0), 10)
