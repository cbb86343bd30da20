"""Bus plan: prepared transactions, reply layouts and units, made before a port is opened."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Literal

import msgspec

from dxlwire.joint_unit import ROTARY, JointUnit
from dxlwire.modes import Mode
from dxlwire.transaction import Transaction

SIGN = 0x400
"""Sign bit of sign-magnitude items, bit 10: clockwise (e-Manual AX-12A, Moving Speed (32), Present Speed
(38), Present Load (40))."""


class Field(msgspec.Struct, frozen=True):
    """One item inside a block of bytes, little-endian."""

    offset: int
    size: int  # 1, 2 or 4
    encoding: Literal["unsigned", "sign_magnitude", "twos_complement", "float32"]
    """Encoding of the integer on the wire. Only devices have float32 items."""
    bit: int | None = None  # Index of the only bit that counts, for an item of a device; None: all bits

    def tick(self, block: bytes | memoryview) -> int:
        """Return the item as a signed number of ticks from the bytes of its block.

        Velocity and effort are sign-magnitude in Protocol 1.0 and on the XL-320 (e-Manual AX-12A, Present
        Speed (38); XL-320, Present Speed (39)); bits above the sign are ignored. Other models use two's
        complement (e-Manual XM430-W350, Present Velocity (128)).
        """
        raw = block[self.offset : self.offset + self.size]
        if self.encoding == "sign_magnitude":
            value = int.from_bytes(raw, "little")
            return -(value & (SIGN - 1)) if value & SIGN else value & (SIGN - 1)
        return int.from_bytes(raw, "little", signed=self.encoding == "twos_complement")


class StateLayout(msgspec.Struct, frozen=True):
    """Block that is read from a servo in each cycle."""

    address: int
    length: int
    position: Field
    velocity: Field
    effort: Field
    spare: int  # Readable bytes after the block; a longer read distinguishes late replies, see `exchange`


class GoalLayout(msgspec.Struct, frozen=True):
    """Block that is written to a servo in each cycle, with the goals of a mode that it contains."""

    address: int
    length: int
    position: Field | None = None
    speed: Field | None = None
    """In a block with a position: the speed toward it, None if it is not in the block. Otherwise the leading
    goal."""
    effort: Field | None = None
    """With the block of a position: the maximum effort on the way to it. Otherwise the leading goal."""
    pwm: Field | None = None

    @property
    def leading(self) -> Field:
        """Field of the goal that the servo follows: a position, else a speed, an effort or a PWM.

        Raises:
            LookupError: The block has no goal.
        """
        for place in (self.position, self.speed, self.effort, self.pwm):
            if place is not None:
                return place
        raise LookupError("no goal stands in this block")


class TorqueLimit(msgspec.Struct, frozen=True):
    """Torque limit of a servo in RAM, and the item from which it is initialized at power-up."""

    name: str  # Title in the e-Manual: `Torque Limit (34)`
    address: int
    full_address: int
    size: int  # Size of either item, bytes


class RegisterValue(msgspec.Struct, frozen=True):
    """One item of a servo's memory with its required value."""

    address: int
    size: int  # 1, 2 or 4
    value: int  # Integer on the wire; negative numbers are written in two's complement
    name: str  # Name in the control table: `position_p_gain`
    eeprom: bool = False  # True if the value survives power-off and is writable only while torque is off

    @property
    def data(self) -> bytes:
        """Payload of the write, little-endian."""
        return self.value.to_bytes(self.size, "little", signed=self.value < 0)


class Scale(msgspec.Struct, frozen=True):
    """Unit and maximum of a goal."""

    per_tick: float  # rad/s, the unit of the state's effort, or fraction of the full voltage
    most: int  # Highest tick without sign, according to the manual; the servo's own limit may be lower


class OwnLimit(msgspec.Struct, frozen=True):
    """Item with a servo's own limit. The servo refuses a goal beyond the limit."""

    of: Literal["speed", "effort", "pwm"]
    name: str
    address: int
    size: int


class ModePlan(msgspec.Struct, frozen=True):
    """One mode of one servo: the registers that select it and the goals that it follows. Sources: see
    `mode_plan`.
    """

    mode: Mode
    operating: tuple[RegisterValue, ...]
    """Register values that select the mode, in the order of writing, with torque off."""
    goals: tuple[GoalLayout, ...]  # Blocks of its goals, in the order of sending
    lower_tick: int  # Lowest goal position
    upper_tick: int  # Highest goal position
    present_rad_s_per_tick: float  # Unit of the present speed in this mode
    speed: Scale | None = None
    effort: Scale | None = None
    pwm: Scale | None = None


SlowState = Literal["temperature", "voltage"]
SLOW_STATES: Mapping[str, SlowState] = MappingProxyType(
    {
        "present_temperature": "temperature",
        "present_motor_temperature": "temperature",
        "present_voltage": "voltage",
        "present_input_voltage": "voltage",
    }
)
"""Control table items that are states of a joint and are read between cycles."""


class ServoPlan(msgspec.Struct, frozen=True):
    """One servo and its joint, whose position is s = direction * (theta - reference) * ratio."""

    joint: str  # Name in messages: the joint, or in a transmission `wrist/left`
    row: int
    """Row of the joint in the state and goal arrays of the whole robot. Where several servos move one joint
    (`MechanicsPlan`), the servo's own row in the arrays of the servos."""
    servo_id: int
    model: str
    model_number: int
    reference: float  # rad, counted from the servo's raw 0
    direction: int
    rad_per_tick: float
    max_tick: int
    rad_s_per_tick: float
    max_speed_tick: int
    effort_per_tick: float
    """Effort of the joint per tick of present load or current: Nm (N for a linear joint), or the servo's own
    unit, A or the fraction of the maximum."""
    lower_tick: int  # Lowest goal within the joint's limits, in ticks of the servo
    upper_tick: int  # Highest goal within the joint's limits, in ticks of the servo
    state: StateLayout
    goal: GoalLayout
    torque_address: int  # Address of Torque Enable, one byte
    hardware_error_address: int | None
    """Address of the byte that reports hardware errors; None in Protocol 1.0, where the error byte of each
    reply reports them."""
    torque_limit: TorqueLimit | None = None  # None if the model has none that limits position control
    settings: tuple[RegisterValue, ...] = msgspec.field(default=(), name="registers")
    """Required register values, in the order of writing: EEPROM first. In logs the field has the name of the
    robot file's key `registers`, the source of most values."""
    modes: tuple[ModePlan, ...] = ()  # All modes that the servo can be in
    start_mode: Mode = Mode.POSITION  # Mode that the start-up selects; one of `modes`
    own_limits: tuple[OwnLimit, ...] = ()
    slow: tuple[str, ...] = ()  # Names of the items that are read between cycles
    # Torque is enabled again after a reboot (policy `on_returned_servo: hold`)
    torque_on_return: bool = False
    continuous: bool = False  # The joint is a wheel or turns more than once
    torque_at_start: bool = True
    """True if start-up enables torque. Otherwise the servo stays limp until a client requests torque."""
    ratio: float = 1.0
    """Movement of the joint per radian of the servo: rad (1 / gear ratio), or m for a linear joint."""
    name: str = ""
    """Unique name of the servo if several servos move one joint: `hip/1`, `wrist/left`; otherwise empty."""
    unit: JointUnit = ROTARY  # Unit of the joint's positions

    @property
    def own_name(self) -> str:
        """Unique name of the servo."""
        return self.name or self.joint

    @property
    def declared(self) -> dict[str, int]:
        """Register values from the robot file: integers on the wire by item name, in the order of writing."""
        return {setting.name: setting.value for setting in self.settings}

    @property
    def position_per_tick(self) -> float:
        """Movement of the joint per tick of the position, rad or m."""
        return self.rad_per_tick * self.ratio

    @property
    def wraps(self) -> bool:
        """True if the position wraps around once per revolution of a wheel."""
        return self.continuous and self.state.position.size < 4

    def joint_position(self, raw: int) -> float:
        """Return the joint's position, rad or m, for a present or goal position in ticks.

        theta = raw * rad_per_tick, counter-clockwise positive (thesis of M. Amarante Araujo, 2017, JointID;
        e-Manual AX-12A, Goal Position (30): 300/1023 deg a tick).
        """
        return self.direction * (raw * self.position_per_tick - self.reference * self.ratio)

    def position_text(self, position: float) -> str:
        """Format a position of the joint, rad or m, for a message: `12.3 deg`, `4.56 mm`."""
        return self.unit.text(position, digits=self.unit.digits)

    def outside_limits(self, raw: int, lower_tick: int, upper_tick: int) -> str:
        """Return the problem and its fix for a position outside limits, all in ticks. The text follows the
        joint's name.
        """
        first, last = sorted(map(self.joint_position, (lower_tick, upper_tick)))
        lower = self.position_text(first).partition(" ")[0]  # the unit follows the upper limit
        return (
            f"is at {self.position_text(self.joint_position(raw))}, outside its limits "
            f"{lower}..{self.position_text(last)}: move the joint inside by hand"
        )

    def step_text(self, step: float) -> str:
        """Format a step of the joint, rad or m, for a message: `12 deg`, `5 mm`."""
        return self.unit.text(step, digits=0)

    def mode_plan(self, mode: int) -> ModePlan:
        """Return the plan of a mode.

        Raises:
            LookupError: The servo does not have the mode.
        """
        for plan in self.modes:
            if plan.mode == mode:
                return plan
        raise LookupError(f"{self.model} of {self.joint} has no mode {Mode(mode).name.lower()}")


class Member(msgspec.Struct, frozen=True):
    """Block of a servo or a device that one read fetches in each cycle; devices may have several."""

    servo_id: int
    address: int
    length: int
    spare: int  # Readable bytes after the block
    device: int = -1  # Index of the device on its bus; -1 for a servo
    block: int = 0  # Index of the block within its device


class DeviceField(msgspec.Struct, frozen=True):
    """One state of a device: number on the wire * scale + offset."""

    state: str  # `angular_velocity.x`
    place: Field  # Position in its block
    scale: float  # SI units per tick
    offset: float  # SI units at tick 0
    column: int  # Column of the state among `source_states` of the cycle's record


class DeviceBlock(msgspec.Struct, frozen=True):
    """Bytes of a device that one read fetches."""

    address: int
    length: int
    fields: tuple[DeviceField, ...]
    spare: int = 0  # Readable bytes after the block


class DevicePlan(msgspec.Struct, frozen=True):
    """Unit on a bus that is not a servo: read in each cycle, but without torque, goals or a mode."""

    name: str
    servo_id: int  # Its ID
    model: str
    model_number: int | None  # None: the model number is not checked
    source: int  # Row of the device among the sources of the cycle's record
    blocks: tuple[DeviceBlock, ...]  # Blocks of the device, fetched by one read each


class Budget(msgspec.Struct, frozen=True):
    """Cost of one cycle on one bus, ns (protocol.md, Time budget)."""

    request_bytes: int
    reply_bytes: int
    wire_ns: int
    return_delay_ns: int
    latency_ns: int
    goal_bytes: int  # Bytes of goals among `request_bytes`; goals have no reply

    @property
    def goals_ns(self) -> int:
        """Time of the goals on the wire, ns."""
        return self.wire_ns * self.goal_bytes // max(self.request_bytes + self.reply_bytes, 1)

    @property
    def total_ns(self) -> int:
        """Time of one read-and-write exchange, ns."""
        return self.wire_ns + self.return_delay_ns + self.latency_ns

    @property
    def highest_rate_hz(self) -> float:
        """Rate at which the exchange would occupy the whole bus time, Hz."""
        return 1e9 / self.total_ns


class BusPlan(msgspec.Struct, frozen=True):
    """One serial line: its servos, its prepared packets, its budget."""

    name: str
    port: str  # Device path, or `sim`
    protocol: float
    baud_rate: int
    latency_ns: int
    return_delay_ns: int
    servos: tuple[ServoPlan, ...]
    groups: tuple[tuple[int, ...], ...]
    """Members that one instruction reads, as indices into `members` (servos first). A group of one is a plain
    read."""
    reads: tuple[Transaction, ...]
    """Read of each group without losses, in the form that every firmware supports."""
    limp: tuple[Transaction, ...]
    """Broadcasts that switch off the torque of all servos; without reply, so they can be sent at any time."""
    budget: Budget  # Cost of a cycle with the chosen reads, including the fast forms of `fast`
    fast: tuple[bool, ...] = ()
    """True for each group that is read by a fast form, provided that servos answer it at start-up."""
    read_by: str = ""  # Instructions of the reads in the e-Manual's words: `fast sync read + read`
    watchdog_ticks: int = 0  # Value of each servo's Bus Watchdog, steps of 20 ms; 0: not armed
    slow_period_ns: int = 0  # Period in which each slow register is read once; 0: never
    devices: tuple[DevicePlan, ...] = ()  # Units on the bus that are not servos
    device_margin_ns: int = 1_000_000
    """Time that the host waits for a device after the latest arrival that the wire allows."""
    rs485: bool = False  # The kernel switches the direction of the adapter's transceiver
    boot_ns: int = 0  # Boot time of the adapter after it was plugged in and opened

    @property
    def members(self) -> tuple[Member, ...]:
        """Blocks read in each cycle: one per servo, then every block of every device."""
        return members_of(self.servos, self.devices)

    def member_name(self, index: int) -> str:
        """Return the name of a member's joint or device."""
        device = self.members[index].device
        return self.servos[index].joint if device < 0 else self.devices[device].name

    @property
    def names(self) -> dict[int, str]:
        """Names of joints and devices, by ID."""
        return {servo.servo_id: servo.joint for servo in self.servos} | {
            device.servo_id: device.name for device in self.devices
        }

    def label(self, servo: ServoPlan | DevicePlan) -> str:
        """Return the name of a servo or a device in messages: `elbow (ID 4 on bus main)`."""
        name = servo.joint if isinstance(servo, ServoPlan) else servo.name
        return f"{name} (ID {servo.servo_id} on bus {self.name})"


def members_of(servos: Sequence[ServoPlan], devices: Sequence[DevicePlan]) -> tuple[Member, ...]:
    """Return the blocks to read in each cycle from the servos and devices of one bus."""
    states = ((servo.servo_id, servo.state) for servo in servos)
    return (
        *(Member(servo_id, state.address, state.length, state.spare) for servo_id, state in states),
        *(
            Member(device.servo_id, block.address, block.length, block.spare, index, number)
            for index, device in enumerate(devices)
            for number, block in enumerate(device.blocks)
        ),
    )
