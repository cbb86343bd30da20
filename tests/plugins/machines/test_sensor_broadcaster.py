"""sensor_broadcaster: fields of messages from states, numbers and sums; nothing wrong or old is published."""

from __future__ import annotations

import math
from typing import Any

import pytest
from tests.kit.stages import standing

from dxlrun.messages.declared import declared_message
from dxlrun_controllers.sensing.sensor_broadcaster import MESSAGES, SensorBroadcaster

SONAR: dict[str, object] = {
    "message": "Range",
    "frame": "sonar",
    "fields": {
        "range": "sonar/range",
        "min_range": 0.02,
        "max_range": 4.0,
        "field_of_view": 0.3,
        "radiation_type": 1,
    },
}
FOOT: dict[str, object] = {
    "message": "WrenchStamped",
    "cells": {
        "foot/front_left": ["60 mm", "30 mm"],
        "foot/front_right": ["60 mm", "-30 mm"],
        "foot/back_left": ["-40 mm", "30 mm"],
        "foot/back_right": ["-40 mm", "-30 mm"],
    },
}


def placed(written: dict[str, object]) -> Any:
    return standing(SensorBroadcaster, written).activate()


def see(stage: Any, *reads: float) -> Any:
    """Update with these reads; return the newest message."""
    stage.context.reads[:] = reads
    stage.step()
    return stage.messages[-1][1] if stage.messages else None


def test_a_range_is_published_with_the_numbers_of_the_file() -> None:
    stage = placed(SONAR)
    assert stage.interfaces.reads == ("sonar/range", "sonar/age")
    assert SensorBroadcaster.topics(stage.model) == {"range": MESSAGES["Range"][1]}
    message = see(stage, 1.25, 0.01)
    assert (message.range, message.min_range, message.max_range, message.field_of_view) == (
        1.25,
        0.02,
        4.0,
        0.3,
    )
    assert (message.radiation_type, message.header.frame_id) == (1, "sonar")
    declared_message(type(message), "any").pack(message, (1, 2))


def test_a_foot_has_the_force_and_the_torque_of_its_cells() -> None:
    stage = placed(FOOT)
    wrench = see(stage, 10.0, 0.0, 0.0, 0.0, 0.0).wrench
    assert (wrench.force.z, wrench.torque.x, wrench.torque.y) == pytest.approx((10.0, 0.3, -0.6))
    wrench = see(stage, 1.0, 2.0, 3.0, 4.0, 0.0).wrench
    center = -wrench.torque.y / wrench.force.z, wrench.torque.x / wrench.force.z
    assert center == pytest.approx(((3 * 0.06 - 7 * 0.04) / 10, (4 - 6) * 0.03 / 10))
    assert (wrench.force.x, wrench.force.y, wrench.torque.z) == (0.0, 0.0, 0.0)
    scaled = see(placed({**FOOT, "scale": 0.5}), 10.0, 0.0, 0.0, 0.0, 0.0).wrench
    assert (scaled.force.z, scaled.torque.y) == pytest.approx((5.0, -0.3))


def test_a_field_may_be_a_weighted_sum() -> None:
    fields = {"temperature": {"hip/temperature": 0.5, "knee/temperature": 0.5}}
    stage = placed({"message": "Temperature", "fields": fields})
    assert stage.interfaces.reads == ("hip/temperature", "knee/temperature", "hip/age", "knee/age")
    assert see(stage, 30.0, 40.0, 0.0, 0.0).temperature == 35.0


def test_only_new_values_are_published_and_each_once() -> None:
    stage = placed(SONAR)
    for cycle in range(20):  # a sensor at a fifth of the rate
        see(stage, 1.0, 0.001 + cycle % 5 * 0.02 + cycle * 2e-6)
    assert len(stage.messages) == 4


@pytest.mark.parametrize(
    ("value", "age_s", "what"),
    [
        (math.nan, 0.0, "are not finite numbers"),
        (math.inf, 0.0, "are not finite numbers"),
        (1.0, 0.6, "are older than 0.5 s"),
    ],
)
def test_what_is_wrong_or_old_is_not_published_and_reported_once(
    value: float, age_s: float, what: str
) -> None:
    stage = placed(SONAR)
    see(stage, 1.0, 0.0)
    for _ in range(50):
        see(stage, value, age_s)
    assert len(stage.messages) == 1
    assert stage.said == [f"states {what}: nothing is published"]
    see(stage, 2.0, 0.0)
    assert len(stage.messages) == 2


def test_before_the_first_measurement_nothing_is_published_or_said() -> None:
    stage = placed(SONAR)
    for _ in range(50):
        see(stage, math.nan, math.nan)
    assert (stage.messages, stage.said) == ([], [])


@pytest.mark.parametrize(
    ("message", "field"),
    [
        ("BatteryState", "voltage"),
        ("FluidPressure", "fluid_pressure"),
        ("MagneticField", "magnetic_field.y"),
        ("Temperature", "temperature"),
        ("WrenchStamped", "wrench.force.x"),
    ],
)
def test_each_message_takes_a_state(message: str, field: str) -> None:
    stage = placed({"message": message, "fields": {field: "box/value"}})
    found = see(stage, 11.5, 0.0)
    for name in field.split("."):
        found = getattr(found, name)
    assert found == 11.5
    published = stage.messages[-1][1]
    declared_message(type(published), "any").pack(published, (1, 2))
