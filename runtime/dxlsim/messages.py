"""What the process of the simulated buses and the one that started it send each other: JSON, one a line."""

from __future__ import annotations

import msgspec

from dxlsim.simulation_plan import SimulationConfig


class SimulationJob(msgspec.Struct, frozen=True):
    """What the process of the simulated buses does, as JSON through a descriptor."""

    config: SimulationConfig
    ledger: str | None = None  # JSON-lines file of every byte on the buses
    priority: int = 0  # Real-time priority that it asks for, 1 to 99; 0: none
    core: int = -1  # Core that it stays on; -1: any
    shafts: int = -1  # Descriptor of the slot into which it writes how its shafts move; -1: none
    progress: int = -1  # Descriptor of the memory into which it writes how far it has come; -1: none


class Request(msgspec.Struct):
    """To the simulation."""

    look: bool = False  # answered by every servo as it is now
    fault: str | None = None  # a line of a fault to plan, as a person types it


class ServoLook(msgspec.Struct, frozen=True):
    """One servo as it is now."""

    bus: str
    id: int
    model: str
    torque: bool
    goal: float | None  # rad, from the servo's raw 0; None: its operating mode has no goal position
    present: float  # rad
    temperature: float  # degrees C
    voltage: float  # V
    error: int  # present error: the error byte (Protocol 1.0), or the value of the error item
    heard: int  # instruction packets to it since the start
    answered: int  # status packets from it since the start


class SimulationMessage(msgspec.Struct, frozen=True, omit_defaults=True):
    """From the simulation: one of these, `real_time` with the first ports, `lateness_us` with servos."""

    ports: dict[str, str] | None = None  # the device of each bus; empty where an adapter is unplugged
    real_time: str = ""  # what the system granted of it
    servos: tuple[ServoLook, ...] | None = None
    lateness_us: dict[str, float] = {}
    """How late replies were handed over, by what it is of, such as median and p99; empty before the first."""
    happened: str | None = None  # a fault that was injected now
    fault: str | None = None  # a fault line that was understood, in its canonical writing
    error: str | None = None  # Why the configuration cannot be served, or what is wrong with a fault line
