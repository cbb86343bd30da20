"""Plan of the sensors: what the process of each opens, and what the loop expects of it."""

from __future__ import annotations

from typing import Literal

import msgspec


class SensorPlan(msgspec.Struct, frozen=True):
    """One sensor: what its process opens, and what the loop expects of it."""

    name: str
    type: str
    distribution: str  # Publisher of the plug-in: `name version`
    parameters: str  # JSON that `Parameters` accepts
    states: tuple[str, ...]
    period_ns: int  # Between two samples
    timeout_ns: int  # Age at which its values are no longer valid
    on_lost: Literal["continue", "stop"] = "continue"
    """What becomes of the run when it brings nothing for that time."""
    links: tuple[str, ...] = ()
    """Of the URDF, whose simulated motion it senses; empty: it measures the real world."""
    simulated: bool = False  # It can be stepped on virtual time
    noisy: tuple[str, ...] = ()
    """States that never stay the same together: as long as they do, the sensor is stuck."""
    units: dict[str, str] = {}
    """SI unit of each state that has one, by its name."""


def encode_sensors(sensors: tuple[SensorPlan, ...]) -> bytes:
    """Return `Contribution.plan` of sensors; empty without any."""
    return msgspec.json.encode(sensors) if sensors else b""


def decode_sensors(plan: bytes) -> tuple[SensorPlan, ...]:
    """Return the sensors of `Contribution.plan`, in the order of the file."""
    return msgspec.json.decode(plan, type=tuple[SensorPlan, ...]) if plan else ()
