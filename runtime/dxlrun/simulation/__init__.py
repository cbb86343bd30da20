"""Simulated servos on simulated buses, with packet code of their own; they share only the control tables."""

from __future__ import annotations

from dxlrun.simulation.adapter import AdapterConfig
from dxlrun.simulation.bus import SimulatedBus
from dxlrun.simulation.bus_config import BusConfig, ServoCounts
from dxlrun.simulation.ledger import Ledger, LedgerEntry, read_ledger
from dxlrun.simulation.mechanics import Load, Mechanics
from dxlrun.simulation.servo import ServoConfig, SimulatedServo
from dxlrun.simulation.virtual import VirtualPort, VirtualPorts

__all__ = [
    "AdapterConfig",
    "BusConfig",
    "Ledger",
    "LedgerEntry",
    "Load",
    "Mechanics",
    "ServoConfig",
    "ServoCounts",
    "SimulatedBus",
    "SimulatedServo",
    "VirtualPort",
    "VirtualPorts",
    "read_ledger",
]
