"""Hooks that dxlrun finds by the entry point in pyproject.toml"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dxlrun import Sensor, hookimpl
from dxlrun_phidget.spatial import PhidgetSpatial


@hookimpl
def dxlrun_contract() -> int:
    """Return the plug-in contract version that this package was written for."""
    return 4


@hookimpl
def dxlrun_sensors() -> Mapping[str, type[Sensor[Any]]]:
    """Return the sensor classes by their type in the robot file."""
    return {"phidget_spatial": PhidgetSpatial}
