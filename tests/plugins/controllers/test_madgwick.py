"""Madgwick's filter: equal to the reference implementation, and to the true orientation of a turned body."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from dxlrun_controllers.laws.madgwick import Madgwick, Vector

Array = NDArray[np.float64]
COUNT, DT, GAIN = 400, 0.01, 0.1


def measured(k: int) -> tuple[Vector, Vector, Vector]:
    """Return the samples of a body that is turned and shaken: rad/s, m/s^2, uT; any numbers would do."""
    t = k * DT
    rate = (0.9 * math.sin(2.1 * t) + 0.1, 1.3 * math.cos(1.7 * t), 0.7 * math.sin(0.9 * t + 1.0))
    acceleration = (3.0 * math.sin(1.1 * t), 4.0 * math.cos(0.7 * t) - 1.0, 8.0 + 2.0 * math.sin(3.0 * t))
    field = (20.0 * math.cos(0.8 * t), 15.0 * math.sin(0.8 * t), -40.0 + 5.0 * math.sin(t))
    return rate, acceleration, field


def own(magnetic: bool) -> Array:
    """Return the orientation after each sample, shape (COUNT, 4)."""
    law = Madgwick(GAIN)
    found = np.empty((COUNT, 4))
    for k in range(COUNT):
        rate, acceleration, field = measured(k)
        law.update(rate, acceleration, field if magnetic else None, DT)
        found[k] = law.w, law.x, law.y, law.z
    return found


def reference(magnetic: bool) -> Array:
    filters: Any = pytest.importorskip("ahrs.filters", reason="ahrs is there for Python 3.11 only")
    law = filters.Madgwick(gain=GAIN, Dt=DT)
    q = np.array([1.0, 0.0, 0.0, 0.0])
    found = np.empty((COUNT, 4))
    for k in range(COUNT):
        rate, acceleration, field = (np.array(each) for each in measured(k))
        q = law.updateMARG(q, rate, acceleration, field) if magnetic else law.updateIMU(q, rate, acceleration)
        found[k] = q
    return found


@pytest.mark.parametrize("magnetic", [False, True])
def test_it_is_equal_to_the_reference_after_each_sample(magnetic: bool) -> None:
    np.testing.assert_allclose(own(magnetic), reference(magnetic), rtol=0, atol=1e-11)


def rotation(law: Madgwick) -> Array:
    """Return the matrix that turns vectors of the body into the fixed frame."""
    w, x, y, z = law.w, law.x, law.y, law.z
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def vector(values: Array) -> Vector:
    return float(values[0]), float(values[1]), float(values[2])


@pytest.mark.parametrize("heading", [0.0, 1.0, -2.5])
def test_it_begins_where_accelerometer_and_magnetometer_say(heading: float) -> None:
    for roll, pitch in ((0.0, 0.0), (0.6, -0.4), (-2.9, 1.2), (3.0, 0.0), (0.0, -1.5)):
        half = [angle / 2 for angle in (roll, pitch, heading)]
        true = Madgwick(GAIN)
        (cr, cp, cy), (sr, sp, sy) = (list(map(f, half)) for f in (math.cos, math.sin))
        true.w, true.x = cr * cp * cy + sr * sp * sy, sr * cp * cy - cr * sp * sy
        true.y, true.z = cr * sp * cy + sr * cp * sy, cr * cp * sy - sr * sp * cy
        turned = rotation(true)
        up, field = vector(turned.T @ [0, 0, 9.81]), vector(turned.T @ [20.0, 0.0, -44.0])
        for measured_field, given in ((field, 0.3), (None, heading)):
            law = Madgwick(GAIN)
            law.initialize_orientation(up, measured_field, given)
            np.testing.assert_allclose(rotation(law), turned, atol=1e-9)
            assert law.heading == pytest.approx(heading)


def test_free_fall_leaves_the_rates_alone() -> None:
    law = Madgwick(GAIN)
    law.initialize_orientation((0.0, 0.0, 0.0), None, 1.0)
    assert (law.w, law.x, law.y, law.z) == (1.0, 0.0, 0.0, 0.0)
    for _ in range(100):
        law.update((0.0, 0.0, 0.5), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), DT)
    assert law.heading == pytest.approx(0.5, abs=1e-5)
