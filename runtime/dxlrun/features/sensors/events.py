"""Events of sensors."""

from __future__ import annotations

from enum import IntEnum

from dxlrun.channels.events import EventStage


class SensorEvent(IntEnum):
    """Kind of an event of a sensor."""

    SENSOR = 52
    """Report of a sensor or its process: open failed, ended, opened again, or a text of the driver."""
    SENSOR_LOST = 53
    """A sensor had no new samples within its timeout, or values that are not finite. It is not valid."""
    SENSOR_BACK = 54
    """A lost sensor has samples again."""


STAGE = EventStage(SensorEvent)
