"""Simulated servos on simulated buses, with packet code of their own; they share only the control tables."""

from __future__ import annotations

from dxlrun.simulation.bus.adapter import AdapterConfig
from dxlrun.simulation.bus.bus_config import BusConfig, ServoCounts
from dxlrun.simulation.bus.ledger import Ledger, LedgerEntry, read_ledger
from dxlrun.simulation.bus.simulated_bus import SimulatedBus
from dxlrun.simulation.motion.mechanics import Load, Mechanics
from dxlrun.simulation.port.virtual import VirtualPort, VirtualPorts
from dxlrun.simulation.servo.simulated_servo import ServoConfig, SimulatedServo

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
