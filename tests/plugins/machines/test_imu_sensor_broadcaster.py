"""imu_sensor_broadcaster: samples by their true times; single cases are in `scripts/imu.txt`."""

from __future__ import annotations

import numpy as np
import pytest
from tests.kit.stages import standing

from dxlrun_controllers.laws.madgwick import Madgwick
from dxlrun_controllers.sensing.imu_sensor_broadcaster import ImuSensorBroadcaster


def test_it_is_the_filter_with_the_true_times_of_the_samples() -> None:
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
