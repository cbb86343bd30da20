"""Messages between the process of the simulated buses and the process that started it: JSON, one per line."""

from __future__ import annotations

import msgspec

from dxlsim.simulation_plan import SimulationConfig


class SimulationJob(msgspec.Struct, frozen=True):
    """First message to the process of the simulated buses: what it simulates, and how it runs."""

    config: SimulationConfig
    ledger: str | None = None  # JSON-lines file for every byte on the buses
    priority: int = 0  # Requested real-time priority, 1 to 99; 0: none
    core: int = -1  # Core to run on; -1: any
    shafts: int = -1  # Descriptor of the slot for the motion of the shafts; -1: none
    progress: int = -1  # Descriptor of the memory for the progress of the process; -1: none
    sockets: tuple[int, ...] = ()
    """Descriptor of a socket for each bus, whose other end the host holds; empty: a terminal for each."""


class SimulationRequest(msgspec.Struct):
    """Request to a running simulation."""

    look: bool = False  # Request the current state of every servo
    fault: str | None = None  # Line of a fault to plan, as typed by a person


class ServoLook(msgspec.Struct, frozen=True):
    """Present state of one simulated servo, in answer to a `look` request."""

    bus: str
    id: int
    model: str
    torque: bool
    goal: float | None  # rad, from the servo's raw 0; None: its operating mode has no goal position
    present: float  # rad
    temperature: float  # degrees C
    voltage: float  # V
    error: int  # Current errors: the error byte (Protocol 1.0), or the value of the error item
    heard: int  # Instruction packets received since the start
    answered: int  # Status packets sent since the start


class SimulationMessage(msgspec.Struct, frozen=True, omit_defaults=True):
    """Message from the simulation to its starter: one of these fields, `real_time` with the first ports,
    `lateness_us` with servos."""

    ports: dict[str, str] | None = None  # Device of each bus; empty for a socket, or without an adapter
    real_time: str = ""  # Real-time properties that the system granted
    servos: tuple[ServoLook, ...] | None = None
    lateness_us: dict[str, float] = {}
    """Lateness of the deliveries to the host, us, by statistic, such as median and p99; empty before the
    first delivery."""
    happened: str | None = None  # Fault that was just injected
    fault: str | None = None  # Accepted fault line in canonical form
    error: str | None = None  # Reason why the configuration or a fault line is invalid
