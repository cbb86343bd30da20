"""Plan of the sensors: the settings that the loop and each sensor's process need."""

from __future__ import annotations

from typing import Literal

import msgspec


class SensorPlan(msgspec.Struct, frozen=True):
    """Settings of one sensor for its process and for the loop, as stored in the plan."""

    name: str
    type: str
    distribution: str  # publisher of the plug-in: `name version`
    parameters: str  # JSON that `Parameters` accepts
    states: tuple[str, ...]
    period_ns: int  # time between two samples
    timeout_ns: int  # age at which its values become invalid
    on_lost: Literal["continue", "stop"] = "continue"
    """Reaction of the run if no sample arrives for `timeout_ns`."""
    links: tuple[str, ...] = ()
    """URDF links whose simulated motion the sensor measures; empty for a real sensor."""
    simulated: bool = False  # can be stepped on virtual time
    noisy: tuple[str, ...] = ()
    """States that always change because of noise; if all of them stay equal, the sensor is stuck."""
    units: dict[str, str] = {}
    """SI unit of each state that has one, by the state's name."""


def encode_sensors(sensors: tuple[SensorPlan, ...]) -> bytes:
    """Encode sensor plans as JSON for `Contribution.plan`; empty bytes without sensors."""
    return msgspec.json.encode(sensors) if sensors else b""


def decode_sensors(plan: bytes) -> tuple[SensorPlan, ...]:
    """Decode the sensor plans from `Contribution.plan`, in file order; empty bytes give none."""
    return msgspec.json.decode(plan, type=tuple[SensorPlan, ...]) if plan else ()
