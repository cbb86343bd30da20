"""Simulated servos on simulated buses, with packet code of their own; they share only the control tables.

The names of this module describe a simulation and read its ledger, and are cheap to import. What simulates is
imported from its own module: `bus.simulated_bus`, `servo`, `motion.mechanics`, `virtual_ports`.
"""

from __future__ import annotations

from dxlrun.plan.simulation_plan import (
    AdapterConfig,
    BusConfig,
    CoupledServo,
    Coupling,
    DeviceConfig,
    Load,
    ServoConfig,
    ServoTimes,
    Shown,
    SimulationConfig,
    UrdfBodies,
    UrdfJoint,
    decode_config,
    encode_config,
)
from dxlrun.simulation.bus.ledger import Ledger, LedgerEntry, read_ledger

__all__ = [
    "AdapterConfig",
    "BusConfig",
    "CoupledServo",
    "Coupling",
    "DeviceConfig",
    "Ledger",
    "LedgerEntry",
    "Load",
    "ServoConfig",
    "ServoTimes",
    "Shown",
    "SimulationConfig",
    "UrdfBodies",
    "UrdfJoint",
    "decode_config",
    "encode_config",
    "read_ledger",
]
