"""Codes of the events that sensors cause."""

from __future__ import annotations

from enum import IntEnum

from dxlrun.channels.event_records import EventStage


class SensorEvent(IntEnum):
    """Code of an event about a sensor."""

    SENSOR = 52
    """A message of the driver, or a failure or restart of the sensor or its process."""
    SENSOR_LOST = 53
    """The sensor is invalid: no new sample within its timeout, or values that are not finite."""
    SENSOR_BACK = 54
    """The sensor is valid again after it was lost."""


STAGE = EventStage(SensorEvent)
