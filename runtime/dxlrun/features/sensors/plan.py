"""Plan of the sensors: settings of each sensor's process, and of the loop for it."""

from __future__ import annotations

from typing import Literal

import msgspec


class SensorPlan(msgspec.Struct, frozen=True):
    """Settings of one sensor, for its process and for the loop."""

    name: str
    type: str
    distribution: str  # publisher of the plug-in: `name version`
    parameters: str  # JSON that `Parameters` accepts
    states: tuple[str, ...]
    period_ns: int  # time between two samples
    timeout_ns: int  # age at which its values become invalid
    on_lost: Literal["continue", "stop"] = "continue"
    """Reaction of the run when it delivers no sample for that time."""
    links: tuple[str, ...] = ()
    """Links of the URDF whose simulated motion it senses; empty: it measures the real world."""
    simulated: bool = False  # can be stepped on virtual time
    noisy: tuple[str, ...] = ()
    """States that never all stay constant while the sensor works; if they do, the sensor is stuck."""
    units: dict[str, str] = {}
    """SI unit of each state that has one, by its name."""


def encode_sensors(sensors: tuple[SensorPlan, ...]) -> bytes:
    """Return the sensors for `Contribution.plan`; empty without sensors."""
    return msgspec.json.encode(sensors) if sensors else b""


def decode_sensors(plan: bytes) -> tuple[SensorPlan, ...]:
    """Return the sensors in `Contribution.plan`, in the order of the file."""
    return msgspec.json.decode(plan, type=tuple[SensorPlan, ...]) if plan else ()
