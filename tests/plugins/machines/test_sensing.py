"""Filters and broadcasters of sensors, and the fall reflex; single cases are in `scripts`."""

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.kit.stages import standing

from dxlrun.messages.declared import declared_message
from dxlrun_controllers.laws.madgwick import Madgwick, Vector
from dxlrun_controllers.sensing.fall_reflex import FallReflex
from dxlrun_controllers.sensing.imu_sensor_broadcaster import ImuSensorBroadcaster
from dxlrun_controllers.sensing.sensor_broadcaster import MESSAGES, SensorBroadcaster

KEYS: dict[str, object] = {
    "imu": "imu",
    "activate": ["curl"],
    "roll": ["-40 deg", "40 deg"],
    "pitch": ["-30 deg", "50 deg"],
}


def turned(heading: float, pitch: float, roll: float) -> tuple[float, ...]:
    """Return x, y, z, w of a body turned to a heading, pitched, and rolled, degrees: Z, then Y, then X."""
    a, b, c = (math.radians(angle) / 2 for angle in (roll, pitch, heading))
    return (
        math.sin(a) * math.cos(b) * math.cos(c) - math.cos(a) * math.sin(b) * math.sin(c),
        math.cos(a) * math.sin(b) * math.cos(c) + math.sin(a) * math.cos(b) * math.sin(c),
        math.cos(a) * math.cos(b) * math.sin(c) - math.sin(a) * math.sin(b) * math.cos(c),
        math.cos(a) * math.cos(b) * math.cos(c) + math.sin(a) * math.sin(b) * math.sin(c),
    )


@pytest.mark.parametrize("heading", [0.0, 80.0, -170.0])
@pytest.mark.parametrize(
    ("roll", "pitch", "falls"),
    [
        *((0, 49, 0), (0, 51, 1), (0, -29, 0), (0, -31, 1), (0, 89.9, 1), (0, -90, 1)),
        *((39, 49, 0), (39, -29, 0), (39, 51, 1), (-41, 49, 1)),
    ],
)
def test_roll_and_pitch_have_their_bounds_and_the_heading_none(heading, roll, pitch, falls):
    for scale in (0.01, 1.0, 100.0):  # the length of a quaternion has no meaning
        stage = standing(FallReflex, KEYS).activate()
        stage.context.reads[:] = [*(scale * each for each in turned(heading, pitch, roll)), 0.0]
        stage.steps(10)
        assert len(stage.takeovers) == falls


def test_it_is_the_filter_with_the_true_times_of_the_samples():
    stage = standing(ImuSensorBroadcaster, {"sensor": "chip", "gain": 0.3}).activate()
    law, last = Madgwick(0.3), None
    rng = np.random.default_rng(5)
    for _ in range(200):
        periods, age_s = rng.choice([1, 1, 1, 2, 4]), rng.uniform(0.0, 0.004)
        rate, force = rng.normal(0, 1, 3), rng.normal((0.0, 0.0, 9.81), 1.0)
        stage.context.reads[:] = [*rate, *force, age_s]
        stage.step(float(periods))
        sampled_s = stage.time_ns * 1e-9 - age_s
        if last is None:
            law.initialize_orientation(tuple(force), None, 0.0)
        else:
            law.update(tuple(rate), tuple(force), None, sampled_s - last)
        last = sampled_s
        expected = [law.x, law.y, law.z, law.w]
        found = stage.messages[-1][1].orientation
        assert [found.x, found.y, found.z, found.w] == pytest.approx(expected, abs=1e-12)
        assert stage.context.provided == pytest.approx([*expected, *rate, *force])


FOOT: dict[str, object] = {
    "message": "WrenchStamped",
    "cells": {
        "foot/front_left": ["60 mm", "30 mm"],
        "foot/front_right": ["60 mm", "-30 mm"],
        "foot/back_left": ["-40 mm", "30 mm"],
        "foot/back_right": ["-40 mm", "-30 mm"],
    },
}


def published(written: dict[str, object], *reads: float) -> Any:
    """Return the message of these reads, which fits its declaration."""
    stage = standing(SensorBroadcaster, written).activate()
    assert [*SensorBroadcaster.topics(stage.model).values()] == [MESSAGES[str(written["message"])][1]]
    stage.context.reads[:] = reads
    stage.step()
    ((_, message),) = stage.messages
    declared_message(type(message), "any").pack(message, (1, 2))
    return message


def test_a_foot_has_the_force_and_the_torque_of_its_cells():
    wrench = published(FOOT, 10.0, 0.0, 0.0, 0.0, 0.0).wrench
    assert (wrench.force.z, wrench.torque.x, wrench.torque.y) == pytest.approx((10.0, 0.3, -0.6))
    wrench = published(FOOT, 1.0, 2.0, 3.0, 4.0, 0.0).wrench
    center = -wrench.torque.y / wrench.force.z, wrench.torque.x / wrench.force.z
    assert center == pytest.approx(((3 * 0.06 - 7 * 0.04) / 10, (4 - 6) * 0.03 / 10))
    assert (wrench.force.x, wrench.force.y, wrench.torque.z) == (0.0, 0.0, 0.0)
    scaled = published({**FOOT, "scale": 0.5}, 10.0, 0.0, 0.0, 0.0, 0.0).wrench
    assert (scaled.force.z, scaled.torque.y) == pytest.approx((5.0, -0.3))


@pytest.mark.parametrize(
    ("message", "field"),
    [
        ("BatteryState", "voltage"),
        ("FluidPressure", "fluid_pressure"),
        ("MagneticField", "magnetic_field.y"),
        ("Temperature", "temperature"),
        ("Range", "range"),
        ("WrenchStamped", "wrench.force.x"),
    ],
)
def test_each_message_takes_a_state_or_a_weighted_sum(message, field):
    fields: dict[str, object] = {field: {"box/first": 0.5, "box/second": 0.25}}
    found = published({"message": message, "fields": fields}, 11.5, 4.0, 0.0)
    for name in field.split("."):
        found = getattr(found, name)
    assert found == 6.75


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
def test_it_is_equal_to_the_reference_after_each_sample(magnetic):
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
def test_it_begins_where_accelerometer_and_magnetometer_say(heading):
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


def test_free_fall_leaves_the_rates_alone():
    law = Madgwick(GAIN)
    law.initialize_orientation((0.0, 0.0, 0.0), None, 1.0)
    assert (law.w, law.x, law.y, law.z) == (1.0, 0.0, 0.0, 0.0)
    for _ in range(100):
        law.update((0.0, 0.0, 0.5), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), DT)
    assert law.heading == pytest.approx(0.5, abs=1e-5)
