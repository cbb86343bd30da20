"""Simulation plan: describes simulated buses, adapters, servos and their loads; plain data, convertible to
JSON.

This module imports nothing of the simulation itself, so that the rest of the runtime can describe a
simulation cheaply."""

from __future__ import annotations

from typing import Literal

import msgspec

from dxlsim.motor_model import MotorModel


class Load(msgspec.Struct, frozen=True):
    """Load on the shaft of a simulated servo, or on a joint (N and kg for a linear one); none by default."""

    inertia: float = 0.0  # kg m^2, in addition to the servo's own rotor and gear
    friction: float = 0.0
    """Coulomb friction in addition to the servo's own, Nm: constant in motion, the maximum at rest."""
    gravity: float = 0.0  # Torque by gravity with the link in horizontal position, Nm
    gravity_angle: float = 0.0  # rad from the servo's raw 0, with the link straight down
    turns: float = 1.0
    """Radians of the link per radian of the shaft, with a gear between them; torques are at the shaft."""
    steady: float = 0.0  # Constant torque that turns the shaft back, Nm: of a weight on a slide


NO_LOAD = Load()


class ServoTimes(msgspec.Struct, frozen=True):
    """Delays of a simulated servo, in addition to its return delay."""

    response_delay_ns: int = 0
    """Delay between the end of an instruction and its effect on the motor, ns; torque off has none.

    An AX-12+ was measured to need 17 to 50 ms from a goal to its first motion, including its inertia (J.
    A. Smith, J. Jivraj, "Analysis of Robotis Dynamixel AX-12+ Actuator Latencies")."""
    write_time_ns: int = 0
    """Time without reception after the end of an instruction that writes, ns.

    An AX-12 needs 24 us plus 6 us per byte, and several ms for a write to its EEPROM (Xevel, "Dynamixel
    protocol notes")."""


class ServoConfig(msgspec.Struct, frozen=True):
    """Simulated servo that is connected to a bus at the start of the simulation."""

    servo_id: int
    model: str
    position: float  # rad, from the servo's raw 0
    return_delay_ns: int = 500_000  # Initial value of Return Delay Time, rounded to its unit of 2 us
    load: Load = NO_LOAD  # Load on its shaft
    firmware: int | None = None
    """Firmware Version: selects the control table if a model has two, and the support of fast reads.

    None: a version with all items of the model's table."""
    times: ServoTimes = ServoTimes()
    motor: MotorModel | None = None
    """Parameters of the servo's motor from a motor file; None: the simulation's default for the servo
    model."""
    homing_offset: int = 0  # Initial value of Homing Offset, ticks


class DeviceReadings(msgspec.Struct, frozen=True):
    """Quantities that a simulated device measures, and its location on the robot."""

    states: dict[str, str] = {}
    """State name by item, which selects the measured quantity; default: the state in the control table."""
    values: dict[str, float] = {}  # Constant value by item, SI units
    noise: dict[str, float] = {}  # Standard deviation by item, SI units
    link: str = ""  # Link of the robot's URDF that carries the device; empty: it is upright and at rest
    table: str = ""  # Text of its control table, unless it is shipped with dxlrun


class DeviceConfig(msgspec.Struct, frozen=True):
    """Simulated device that is connected to a bus at the start of the simulation."""

    servo_id: int  # Its ID
    model: str
    return_delay_ns: int = 0  # Initial value of its return delay time, if it has this item
    shown: DeviceReadings = DeviceReadings()


class AdapterConfig(msgspec.Struct, frozen=True):
    """Behaviour of a simulated line's adapter; by default each reply is delivered as a whole with its last
    byte."""

    latency_timer_ns: int = 0
    """FTDI latency timer, ns: bytes are delivered when it expires or when 62 bytes are waiting; 0: at
    once."""
    split: Literal["whole", "byte", "random"] = "whole"
    """Size of the pieces that are delivered to the host; `random`: 1 to 8 bytes."""
    seed: int = 0  # Seed of `random`
    echo: bool = False  # True: the host receives its own bytes
    absent: Literal["silent", "slot"] = "silent"
    """Protocol 2.0, effect of an absent servo in a group read: the servos after it never reply, or reply
    after its slot [?]."""


WHOLE_REPLIES = AdapterConfig()


class BusConfig(msgspec.Struct, frozen=True):
    """One simulated serial line with its servos, devices and adapter."""

    name: str
    baud_rate: int  # bit/s, of the host and, at the start, of every servo
    servos: tuple[ServoConfig, ...]
    protocol: float = 1.0  # 1.0 or 2.0; a bus has one protocol
    control_tables: tuple[str, ...] = ()
    """Texts of plug-ins' control tables: the process of the simulated buses loads no plug-ins."""
    adapter: AdapterConfig = WHOLE_REPLIES  # Adapter between the line and the host
    devices: tuple[DeviceConfig, ...] = ()  # Units on the line that are not servos
    # Path of a log whose bus of this name answers instead of servos; empty: simulated servos
    recorded: str = ""


class MechanismServo(msgspec.Struct, frozen=True):
    """Servo of a mechanism, with its coordinate s = per_rad * (theta - reference) for the angle theta of
    its shaft."""

    index: int  # Index in the order in which the servos are added
    reference: float  # rad from the servo's raw 0
    per_rad: float  # rad or m per rad of the shaft, with the sign of its direction


HINGES = ("revolute", "continuous")  # Rotary joint types of a URDF


class Mechanism(msgspec.Struct, frozen=True):
    """Servos and the joints that they move together: joint coordinates q = matrix @ servo coordinates s.

    One servo with its own joint, several servos on one joint (q is the mean of theirs), a differential, or
    any other matrix of full rank."""

    servos: tuple[MechanismServo, ...]
    joints: tuple[str, ...]
    matrix: tuple[tuple[float, ...], ...] = ((1.0,),)  # One row per joint, one column per servo
    loads: tuple[Load, ...] = ()
    """Loads at the joints: Nm and kg m^2, or N and kg; `gravity_angle` is the joint's. Empty for one servo
    with its own joint, whose load is in `ServoConfig`."""
    types: tuple[str, ...] = HINGES  # Joint types of a URDF that it can move

    @property
    def is_single(self) -> bool:
        """True for one servo that moves its own joint, independently of all other joints."""
        return not self.loads


class UrdfBodies(msgspec.Struct, frozen=True):
    """URDF of a robot with the mechanisms that move its joints."""

    urdf: str
    mechanisms: tuple[Mechanism, ...]  # Servos without a mechanism are added after all others

    @property
    def servos(self) -> int:
        """Number of the servos of all mechanisms."""
        return sum(len(one.servos) for one in self.mechanisms)


class SimulationConfig(msgspec.Struct, frozen=True):
    """Configuration of a simulation: all that the process of the simulated buses needs."""

    buses: tuple[BusConfig, ...]
    faults: tuple[str, ...] = ()  # Lines of faults; their times count from the start
    seed: int = 0  # Seed of the random values of faults
    links: dict[str, str] = {}
    """Path of a symbolic link to each bus's terminal, by name of the bus; it is updated like links by
    udev."""
    # Bodies that the servos move together; None: each joint moves independently
    bodies: UrdfBodies | None = None
    mechanisms: tuple[Mechanism, ...] = ()  # Servos without a mechanism move independently
    sensed: UrdfBodies | None = None  # Bodies whose links carry devices; None: no device is on a link
