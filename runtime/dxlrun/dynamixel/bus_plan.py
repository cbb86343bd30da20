"""What the bus executes: prepared transactions, reply layouts, units; made before a port opens."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from dxlrun.dynamixel.transaction import Transaction


@dataclass(frozen=True, slots=True)
class Field:
    """One item inside a block of bytes, little-endian."""

    offset: int
    size: int
    """1, 2 or 4"""
    encoding: Literal["unsigned", "sign_magnitude", "twos_complement"]


@dataclass(frozen=True, slots=True)
class StateLayout:
    """The block that is read of a servo each cycle."""

    address: int
    length: int
    position: Field
    velocity: Field
    effort: Field
    spare: int
    """Bytes behind the block that can be read with it, see `exchange`."""


@dataclass(frozen=True, slots=True)
class GoalLayout:
    """The block that is written to a servo each cycle."""

    address: int
    length: int
    position: Field
    speed: Field | None
    """None: the model has no speed beside its goal position."""


@dataclass(frozen=True, slots=True)
class TorqueLimit:
    """Where a servo's torque is limited in RAM, and where its own limit stands, which it begins with."""

    name: str
    """As the e-Manual writes it: `Torque Limit (34)`."""
    address: int
    full_address: int
    size: int
    """Of both, bytes."""


@dataclass(frozen=True, slots=True)
class RegisterValue:
    """One item of a servo's memory and what it shall hold."""

    address: int
    size: int
    """1, 2 or 4"""
    value: int
    """The integer on the wire; one below 0 in two's complement."""
    name: str
    """As the control table has it: `position_p_gain`."""
    eeprom: bool = False
    """True where it survives power-off, and is written only while torque is off."""

    @property
    def data(self) -> bytes:
        """What is written, little-endian."""
        return self.value.to_bytes(self.size, "little", signed=self.value < 0)


@dataclass(frozen=True, slots=True)
class ServoPlan:
    """One servo and the joint that it moves: q = direction * (theta - reference)."""

    joint: str
    row: int
    """Row of the joint in the state and goal arrays of the whole robot."""
    servo_id: int
    model: str
    model_number: int
    reference: float
    """rad, counted from the servo's raw 0"""
    direction: int
    rad_per_tick: float
    max_tick: int
    rad_s_per_tick: float
    max_speed_tick: int
    effort_per_tick: float
    """Nm, A, or the fraction of the maximum per tick of present load or current."""
    lower_tick: int
    """Lowest goal that the joint's limits allow, as the servo counts."""
    upper_tick: int
    """Highest goal that the joint's limits allow, as the servo counts."""
    state: StateLayout
    goal: GoalLayout
    torque_address: int
    """Where torque enable stands, one byte."""
    hardware_error_address: int | None
    """Where hardware error status stands, one byte; None where the model has none."""
    torque_limit: TorqueLimit | None = None
    """None where the model has none that limits position control."""
    registers: tuple[RegisterValue, ...] = ()
    """What the robot file declares, in the order in which it is written: EEPROM first."""


@dataclass(frozen=True, slots=True)
class Budget:
    """What one cycle costs on one bus, ns (protocol.md, Time budget)."""

    request_bytes: int
    reply_bytes: int
    wire_ns: int
    return_delay_ns: int
    latency_ns: int

    @property
    def total_ns(self) -> int:
        """Time of one read-and-write exchange, ns."""
        return self.wire_ns + self.return_delay_ns + self.latency_ns

    @property
    def highest_rate_hz(self) -> float:
        """The rate at which the bus would do nothing else, Hz."""
        return 1e9 / self.total_ns


@dataclass(frozen=True, slots=True)
class ReadWay:
    """One way to read every servo of a bus once a cycle, and what a cycle then costs."""

    name: str
    """As the e-Manual calls it: `fast sync read`."""
    budget: Budget
    chosen: bool = False


@dataclass(frozen=True, slots=True)
class BusPlan:
    """One serial line: its servos, its prepared packets, its budget."""

    name: str
    port: str
    """Device path, or `sim`."""
    protocol: float
    baud_rate: int
    latency_ns: int
    return_delay_ns: int
    servos: tuple[ServoPlan, ...]
    groups: tuple[tuple[int, ...], ...]
    """Who is read by one instruction: indices into `servos`; a group of one is read by itself."""
    reads: tuple[Transaction, ...]
    """The state read of each group, when all its servos answer, in the form that every firmware knows."""
    limp: tuple[Transaction, ...]
    """Torque off, to be sent at any moment: to everybody first, then servo by servo, acknowledged."""
    torque_reads: tuple[Transaction, ...]
    """Read torque enable, in the order of `servos`."""
    budget: Budget
    """Of a cycle with the reads that were chosen: the fast forms where `fast` says so."""
    fast: tuple[bool, ...] = ()
    """Of each group: it is to be read by a fast form, if that is answered at the start."""
    ways: tuple[ReadWay, ...] = ()
    """How the bus could be read, the chosen one among them."""
    split: bool = False
    """The next read request leaves right behind the goals, so that the replies wait when a cycle begins."""
