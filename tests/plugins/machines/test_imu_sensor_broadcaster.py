"""imu_sensor_broadcaster: samples by their true times, axes, magnetic heading, lost and wrong samples."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.kit.stages import standing

from dxlrun_controllers.laws.madgwick import Madgwick
from dxlrun_controllers.sensing.imu_sensor_broadcaster import ImuSensorBroadcaster

Array = NDArray[np.float64]
G = 9.81
LEVEL = (0.0, 0.0, G)
STILL = (0.0, 0.0, 0.0)
NAN = math.nan


class Bench:
    """A broadcaster under test, and what its sensor measures."""

    def __init__(self, **written: object) -> None:
        self.stage = standing(ImuSensorBroadcaster, {"sensor": "chip", **written})
        self.names = self.stage.interfaces.reads
        self.stage.activate()

    def sample(self, *values: Any, age_s: float = 0.0, periods: float = 1.0) -> None:
        """Update with values in the order of the reads, without the sensor's age behind the first ones."""
        flat = [float(number) for value in values for number in np.atleast_1d(value)]
        flat.insert(self.names.index("chip/age"), age_s)
        self.stage.context.reads[:] = flat
        self.stage.step(periods)

    @property
    def orientation(self) -> Array:
        """x, y, z, w of the newest message."""
        q = self.stage.messages[-1][1].orientation
        return np.array([q.x, q.y, q.z, q.w])

    @property
    def provided(self) -> Array:
        provided: Array = self.stage.context.provided
        return provided


def about(axis: int, degrees: float) -> Array:
    q = np.zeros(4)
    q[axis], q[3] = math.sin(math.radians(degrees) / 2), math.cos(math.radians(degrees) / 2)
    return q


def test_it_is_the_filter_with_the_true_times_of_the_samples() -> None:
    bench, law, last = Bench(gain=0.3), Madgwick(0.3), None
    rng = np.random.default_rng(5)
    for _ in range(200):
        periods, age_s = rng.choice([1, 1, 1, 2, 4]), rng.uniform(0.0, 0.004)
        rate, force = rng.normal(0, 1, 3), LEVEL + rng.normal(0, 1, 3)
        bench.sample(rate, force, age_s=age_s, periods=float(periods))
        sampled_s = bench.stage.time_ns * 1e-9 - age_s
        if last is None:
            law.initialize_orientation(tuple(force), None, 0.0)
        else:
            law.update(tuple(rate), tuple(force), None, sampled_s - last)
        last = sampled_s
        assert bench.orientation == pytest.approx([law.x, law.y, law.z, law.w], abs=1e-12)
        assert bench.provided[:4] == pytest.approx(bench.orientation)
        assert bench.provided[4:] == pytest.approx([*rate, *force])


def test_a_sample_is_taken_once_however_often_it_is_seen() -> None:
    bench = Bench()
    for cycle in range(10):  # of a sensor at a fifth of the rate; ages differ by some microseconds
        old = cycle % 5
        bench.sample((0.0, 0.0, 1.0), LEVEL, age_s=old * 0.02 + cycle * 3e-6)
        assert np.isnan(bench.provided).all() == bool(old)
    assert len(bench.stage.messages) == 2
    bench.sample((0.0, 0.0, 1.0), LEVEL)
    assert bench.orientation == pytest.approx(about(2, math.degrees(0.2)), abs=1e-3)


@pytest.mark.parametrize("wrong", [NAN, math.inf])
@pytest.mark.parametrize("place", [0, 5])
def test_a_sample_that_is_no_number_counts_as_lost(wrong: float, place: int) -> None:
    bench = Bench()
    for cycle in range(6):
        values = [0.0, 0.0, 1.0, *LEVEL]
        if cycle in {2, 3}:
            values[place] = wrong
        bench.sample(values)
        assert np.isnan(bench.provided).all() == (cycle in {2, 3})
    assert len(bench.stage.messages) == 4
    assert bench.orientation == pytest.approx(about(2, math.degrees(0.1)), abs=1e-4)
    assert bench.stage.said == ["chip measured NaN or infinity: these samples are skipped"]


def test_a_silent_sensor_is_reported_once_and_the_filter_begins_anew() -> None:
    bench = Bench(timeout="200 ms")
    for _ in range(50):
        bench.sample((0.0, 0.0, 1.0), LEVEL)
    for cycle in range(1, 31):
        bench.sample((0.0, 0.0, 1.0), LEVEL, age_s=cycle * 0.02)
    assert bench.stage.said == ["no new sample from chip for 0.2 s: the states keep their last values"]
    bench.sample(
        (9.0, 9.0, 9.0), (0.0, G, 0.0)
    )  # it lies on its side now; no rate is integrated over the gap
    yaw, roll = about(2, math.degrees(0.98)), about(0, 90.0)
    expected = [roll[0] * yaw[3], roll[0] * yaw[2], roll[3] * yaw[2], roll[3] * yaw[3]]
    assert bench.orientation == pytest.approx(expected, abs=1e-3)
    assert len(bench.stage.said) == 1


def test_without_any_sample_nothing_is_provided_or_said() -> None:
    bench = Bench()
    for _ in range(100):
        bench.sample([NAN] * 6, age_s=NAN)
    assert np.isnan(bench.provided).all()
    assert not bench.stage.messages
    assert not bench.stage.said


def test_it_begins_in_the_posture_in_which_it_is() -> None:
    bench = Bench()
    tilt = math.radians(30)
    bench.sample(STILL, (-G * math.sin(tilt), 0.0, G * math.cos(tilt)))
    assert bench.orientation == pytest.approx(about(1, 30.0))


@pytest.mark.parametrize(("declination", "degrees"), [("0 deg", 0.0), ("10 deg", -10.0)])
def test_with_a_magnetometer_x_is_the_east(declination: str, degrees: float) -> None:
    bench = Bench(magnetometer="compass", declination=declination, gain=0.5)
    for _ in range(100):  # the body's y axis points to the magnetic north, its x axis to the east of there
        bench.sample((0.0, 0.0, 0.05), LEVEL, (0.0, 20e-6, -44e-6), 0.0)
    assert bench.orientation == pytest.approx(about(2, degrees), abs=0.01)


def test_a_magnetometer_that_is_silent_or_wrong_leaves_the_heading_to_the_rates() -> None:
    bench = Bench(magnetometer="compass")
    bench.sample(STILL, LEVEL, (0.0, 1.0, 0.0), 0.0)
    for field, age in (((1.0, 0.0, 0.0), 0.6), ((NAN, 0.0, 0.0), 0.0), ((1.0, 0.0, 0.0), NAN)):
        for _ in range(10):
            bench.sample((0.0, 0.0, 1.0), LEVEL, field, age)
    assert bench.orientation == pytest.approx(about(2, math.degrees(0.6)), abs=1e-3)


def test_a_mounted_sensor_is_turned_into_the_axes_of_its_link() -> None:
    bench = Bench(mounting=["180 deg", "0 deg", "90 deg"])  # upside down, its x axis to the left
    bench.sample((0.1, 0.2, 0.3), (0.0, 0.0, -G))
    assert bench.provided == pytest.approx([0, 0, 0, 1, 0.2, 0.1, -0.3, 0, 0, G], abs=1e-9)


def test_an_orientation_of_the_sensor_is_passed_on_in_the_axes_of_its_link() -> None:
    bench = Bench(orientation="sensor", mounting=["0 deg", "0 deg", "90 deg"])
    assert bench.names[6:10] == tuple(f"chip/orientation.{axis}" for axis in "xyzw")
    bench.sample(STILL, LEVEL, about(2, 120.0))
    assert bench.orientation == pytest.approx(about(2, 30.0))
    bench.sample(STILL, LEVEL, [NAN, 0, 0, 1])
    assert len(bench.stage.messages) == 1


def test_covariances_are_those_of_the_file_as_ros_writes_them() -> None:
    bench = Bench(orientation="none", frame="torso", covariance={"angular_velocity": [1e-4, 2e-4, 3e-4]})
    bench.sample(STILL, LEVEL)
    ((topic, message),) = bench.stage.messages
    assert (topic, message.header.frame_id) == ("imu", "torso")
    assert message.orientation_covariance.tolist() == [-1.0] + [0.0] * 8
    assert message.angular_velocity_covariance.tolist() == [1e-4, 0, 0, 0, 2e-4, 0, 0, 0, 3e-4]
    assert not message.linear_acceleration_covariance.any()
    assert bench.stage.interfaces.provides[0] == "angular_velocity.x"
    assert bench.provided == pytest.approx([*STILL, *LEVEL])


@pytest.mark.parametrize(("rest", "drift"), [(None, 1.2), ("2 deg/s", 0.05)])
def test_the_bias_of_a_resting_gyroscope_is_learned_where_asked(rest: str | None, drift: float) -> None:
    bench = Bench(rest=rest)
    for _ in range(3000):  # one minute
        bench.sample((0.0, 0.0, 0.02), LEVEL)
    heading = 2 * math.atan2(bench.orientation[2], bench.orientation[3])
    assert heading == pytest.approx(drift, abs=0.05)
    for _ in range(50):
        bench.sample((0.0, 0.0, 1.02), LEVEL)
    turned = 2 * math.atan2(bench.orientation[2], bench.orientation[3]) - heading
    assert turned == pytest.approx(1.0 if rest else 1.02, abs=0.003)


def test_the_gain_changes_in_a_run() -> None:
    bench = Bench(gain=0.0)
    tilted = (0.0, G, G)
    bench.sample(STILL, LEVEL)
    for _ in range(50):
        bench.sample(STILL, tilted)
    assert bench.orientation == pytest.approx(about(0, 0.0))
    controller = bench.stage.controller
    controller.parameters = controller.parameters.model_copy(update={"gain": 0.5})
    controller.on_parameters(bench.stage.time_ns)
    for _ in range(100):
        bench.sample(STILL, tilted)
    assert bench.orientation == pytest.approx(about(0, 45.0), abs=0.02)
