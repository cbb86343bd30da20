"""sensor_broadcaster: fields and sums of messages; what is old or wrong is in `scripts/broadcaster.txt`."""

from __future__ import annotations

from typing import Any

import pytest
from tests.kit.stages import standing

from dxlrun.messages.declared import declared_message
from dxlrun_controllers.sensing.sensor_broadcaster import MESSAGES, SensorBroadcaster

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


def test_a_foot_has_the_force_and_the_torque_of_its_cells() -> None:
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
def test_each_message_takes_a_state_or_a_weighted_sum(message: str, field: str) -> None:
    fields: dict[str, object] = {field: {"box/first": 0.5, "box/second": 0.25}}
    found = published({"message": message, "fields": fields}, 11.5, 4.0, 0.0)
    for name in field.split("."):
        found = getattr(found, name)
    assert found == 6.75
