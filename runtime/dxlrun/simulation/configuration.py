"""What the process of the simulated buses is started with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import msgspec

from dxlrun.simulation.bus.bus_config import BusConfig
from dxlrun.simulation.motion.mujoco_plant import UrdfBodies


@dataclass(frozen=True, slots=True)
class SimulationConfig:
    """What the process of the simulated buses is to serve."""

    buses: tuple[BusConfig, ...]
    faults: tuple[str, ...] = ()
    """Lines of faults; their times count from the start."""
    seed: int = 0
    """Of what the faults leave to chance."""
    links: dict[str, str] = field(default_factory=dict)
    """By bus: path of a symbolic link that always leads to its terminal, as udev's do."""
    bodies: UrdfBodies | None = None
    """What the servos move together; None: each joint moves by itself."""


def encode_config(config: SimulationConfig | Sequence[BusConfig]) -> bytes:
    """Return what `--config-fd` takes; buses alone are a configuration without faults."""
    if not isinstance(config, SimulationConfig):
        config = SimulationConfig(tuple(config))
    return msgspec.json.encode(config)


def decode_config(data: bytes) -> SimulationConfig:
    """Return the configuration of `encode_config`; raises msgspec.ValidationError."""
    return msgspec.json.decode(data, type=SimulationConfig)
