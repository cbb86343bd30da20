"""What is simulated: servos with their loads on buses with their adapters; plain data, as JSON too.

Nothing of the simulation itself is imported here, so that the rest of the runtime can describe one cheaply.
"""

from __future__ import annotations

from typing import Literal

import msgspec

from dxlsim.motor_model import MotorModel


class Load(msgspec.Struct, frozen=True):
    """What hangs on the shaft of a servo, or on a joint, of a linear one in N and kg; nothing by default."""

    inertia: float = 0.0  # kg m^2, beside that of the servo's own rotor and gear
    friction: float = 0.0
    """Nm, Coulomb, beside the servo's own: the same at every speed, and the most that holds at rest"""
    gravity: float = 0.0  # Nm with which gravity turns the link where it is horizontal
    gravity_angle: float = 0.0  # rad from the servo's raw 0, where the link hangs straight down
    turns: float = 1.0
    """rad of the link for each rad of the shaft, when a gear lies between them; torques are the shaft's"""
    steady: float = 0.0  # Nm that turn the shaft back at every angle: of a weight on a slide


NO_LOAD = Load()


class ServoTimes(msgspec.Struct, frozen=True):
    """How slow a servo is, beside its return delay."""

    response_delay_ns: int = 0
    """Between the end of an instruction and its effect on the motor; torque off takes none.

    An AX-12+ was measured to need 17 to 50 ms from a goal to its first motion, its inertia included
    (J. A. Smith, J. Jivraj, "Analysis of Robotis Dynamixel AX-12+ Actuator Latencies").
    """
    write_time_ns: int = 0
    """After the end of an instruction that writes, in which the servo receives nothing.

    An AX-12 needs 24 us and 6 us a byte, several ms where it writes its EEPROM (Xevel, "Dynamixel protocol
    notes").
    """


class ServoConfig(msgspec.Struct, frozen=True):
    """A servo as it is connected to a bus when the simulation starts."""

    servo_id: int
    model: str
    position: float  # rad, from the servo's raw 0
    return_delay_ns: int = 500_000  # Initial value of Return Delay Time, rounded to its unit of 2 us
    load: Load = NO_LOAD  # What its shaft moves
    firmware: int | None = None
    """Firmware Version: it decides the control table where a model has two, and the fast reads.

    None: one that has all that the model's table names.
    """
    times: ServoTimes = ServoTimes()
    motor: MotorModel | None = None
    """Its motor, of a motor file; None: the one that the simulation has for the model."""


class Shown(msgspec.Struct, frozen=True):
    """What a device shows, and where it is."""

    states: dict[str, str] = {}
    """By item: name of the state that a robot makes of it, which says what it measures; else the table's."""
    values: dict[str, float] = {}  # By item: what it shows, SI units
    noise: dict[str, float] = {}  # By item: standard deviation of what it shows, SI units
    link: str = ""  # Link of the robot's URDF that it is fixed to; empty: it stands upright and still
    table: str = ""  # Text of its control table, where that is none of dxlrun's own


class DeviceConfig(msgspec.Struct, frozen=True):
    """A device as it is connected to a bus when the simulation starts."""

    servo_id: int  # Its ID
    model: str
    return_delay_ns: int = 0  # Initial value of its return delay time, where it has one
    shown: Shown = Shown()


class AdapterConfig(msgspec.Struct, frozen=True):
    """How a line behaves, and its adapter: the default hands each reply over whole, at its last byte."""

    latency_timer_ns: int = 0
    """FTDI: bytes are handed over when this timer runs out or 62 are there; 0: at once."""
    split: Literal["whole", "byte", "random"] = "whole"
    """Pieces in which bytes are handed over; `random`: 1 to 8 bytes."""
    seed: int = 0  # Of `random`
    echo: bool = False  # True: the host receives its own bytes back
    absent: Literal["silent", "slot"] = "silent"
    """Protocol 2.0, a listed servo does not reply: those after it never reply, or after its time [?]."""


WHOLE_REPLIES = AdapterConfig()


class BusConfig(msgspec.Struct, frozen=True):
    """One serial line and its servos."""

    name: str
    baud_rate: int  # bit/s, of the host and, at the start, of every servo
    servos: tuple[ServoConfig, ...]
    protocol: float = 1.0  # 1.0 or 2.0: one bus speaks one protocol
    control_tables: tuple[str, ...] = ()
    """Texts of the control tables of plug-ins: the process of the simulated buses loads no plug-ins."""
    adapter: AdapterConfig = WHOLE_REPLIES  # What is between the line and the host
    devices: tuple[DeviceConfig, ...] = ()  # What is on the line beside the servos
    recorded: str = ""  # Path of the log whose bus of this name answers instead of servos; empty: none does


class MechanismServo(msgspec.Struct, frozen=True):
    """A servo of a mechanism, by its coordinate s = per_rad * (theta - reference)."""

    index: int  # By the order in which the servos are added
    reference: float  # rad, of the servo from its raw 0
    per_rad: float  # rad or m for each rad of the shaft, with the sign of its direction


HINGES = ("revolute", "continuous")  # Types of the joints of a URDF that turn


class Mechanism(msgspec.Struct, frozen=True):
    """Servos, and the joints that they move: q = matrix @ s.

    One servo with a joint of its own, several servos on one joint, whose q is the mean of theirs, a
    differential, any matrix of full rank.
    """

    servos: tuple[MechanismServo, ...]
    joints: tuple[str, ...]
    matrix: tuple[tuple[float, ...], ...] = ((1.0,),)  # A row for each joint, a column for each servo
    loads: tuple[Load, ...] = ()
    """Of the joints, at the joints: Nm and kg m^2, or N and kg; `gravity_angle` is the joint's. Empty: one
    servo with a joint of its own, which has the load itself (`ServoConfig`)."""
    types: tuple[str, ...] = HINGES  # Of the URDF's joints that it can move

    @property
    def is_single(self) -> bool:
        """True when it is one servo that moves as if there were no other joint."""
        return not self.loads


class UrdfBodies(msgspec.Struct, frozen=True):
    """A URDF, and how servos move its joints, whichever plant moves the servos."""

    urdf: str
    mechanisms: tuple[Mechanism, ...]  # Servos that are in none of them are added after all others

    @property
    def servos(self) -> int:
        """Number of the servos of all mechanisms."""
        return sum(len(one.servos) for one in self.mechanisms)


class SimulationConfig(msgspec.Struct, frozen=True):
    """What the process of the simulated buses serves."""

    buses: tuple[BusConfig, ...]
    faults: tuple[str, ...] = ()  # Lines of faults; their times count from the start
    seed: int = 0  # Of what the faults leave to chance
    links: dict[str, str] = {}
    """By bus: path of a symbolic link that always leads to its terminal, as udev's do."""
    bodies: UrdfBodies | None = None  # What the servos move together; None: each joint moves by itself
    mechanisms: tuple[Mechanism, ...] = ()  # A servo that is in none of them moves by itself
    sensed: UrdfBodies | None = None  # The bodies with which devices move that are on a link; None: none is
