"""Texts of the events that sensors cause."""

from __future__ import annotations

from dxlrun.channels.event_records import Severity, event_text
from dxlrun.features.sensors.events import SensorEvent


@event_text(SensorEvent.SENSOR, Severity.INFO)
def sensor_says(sensor: str, text: str) -> str:
    return f"sensor {sensor}: {text}"


@event_text(SensorEvent.SENSOR, Severity.ERROR)
def sensor_failed(sensor: str, error: str) -> str:
    return f"sensor {sensor}: {error}"


@event_text(SensorEvent.SENSOR_LOST, Severity.ERROR)
def sensor_not_finite(sensor: str, values: str) -> str:
    return f"sensor {sensor}: {values}; its values are not used"


@event_text(SensorEvent.SENSOR_LOST, Severity.ERROR)
def sensor_stuck(sensor: str, lasted_ns: int) -> str:
    return (
        f"sensor {sensor} has returned the same sample for {lasted_ns / 1e6:.0f} ms; "
        "check its cable and its driver"
    )


@event_text(SensorEvent.SENSOR_LOST, Severity.ERROR)
def sensor_silent(sensor: str, age_ns: int) -> str:
    return f"sensor {sensor} delivered no sample for {age_ns / 1e6:.0f} ms"


@event_text(SensorEvent.SENSOR_LOST, Severity.ERROR)
def sensor_never_answered(sensor: str) -> str:
    return f"sensor {sensor} delivered no sample since the start"


@event_text(SensorEvent.SENSOR_LOST, Severity.ERROR)
def sensor_gone(sensor: str) -> str:
    return f"sensor {sensor} has failed; its values are not valid"


@event_text(SensorEvent.SENSOR_BACK, Severity.INFO)
def sensor_back(sensor: str) -> str:
    return f"sensor {sensor} delivers samples again"
