"""Bus plan: everything about one serial line that is computed before its port is opened: transactions,
reply layouts and units."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Literal

import msgspec
from msgspec.structs import replace

from dxlwire.exceptions import help_link
from dxlwire.joint_unit import ROTARY, JointUnit
from dxlwire.modes import Mode
from dxlwire.transaction import Transaction

SIMULATED = "sim"
"""Port of a simulated bus."""
SIGN = 0x400
"""Direction bit of items with sign and magnitude, bit 10: clockwise (e-Manual AX-12A, Moving Speed (32),
Present Speed (38), Present Load (40))."""


class Field(msgspec.Struct, frozen=True):
    """Place and encoding of one control item inside a block of bytes that is read or written at once,
    little-endian."""

    offset: int
    size: int  # 1, 2 or 4
    encoding: Literal["unsigned", "sign_magnitude", "twos_complement", "float32"]
    """Encoding of the integer on the wire. Only devices have float32 items."""
    bit: int | None = None  # Index of the only bit that counts, for an item of a device; None: all bits

    def tick(self, block: bytes | memoryview) -> int:
        """Return the value of this item from the bytes of its block, as a signed number of ticks.

        Velocity and effort are sign-magnitude in Protocol 1.0 and on the XL-320 (e-Manual AX-12A, Present
        Speed (38); XL-320, Present Speed (39)); bits above the sign are ignored. Other models use two's
        complement (e-Manual XM430-W350, Present Velocity (128))."""
        raw = block[self.offset : self.offset + self.size]
        if self.encoding == "sign_magnitude":
            value = int.from_bytes(raw, "little")
            return -(value & (SIGN - 1)) if value & SIGN else value & (SIGN - 1)
        return int.from_bytes(raw, "little", signed=self.encoding == "twos_complement")


class StateLayout(msgspec.Struct, frozen=True):
    """Block of bytes with position, velocity and effort that is read from a servo in each cycle."""

    address: int
    length: int
    position: Field
    velocity: Field
    effort: Field
    spare: int  # Readable bytes after the block; a longer read distinguishes late replies, see `exchange`


class GoalLayout(msgspec.Struct, frozen=True):
    """Block of bytes that is written to a servo in each cycle, with the goals of one mode that it
    contains."""

    address: int
    length: int
    position: Field | None = None
    speed: Field | None = None
    """In a block with a position: the speed toward that position, None if it is not in the block.
    Otherwise the goal that the servo follows."""
    effort: Field | None = None
    """In a mode with a position goal: the maximum effort on the way to the position. Otherwise the goal
    that the servo follows."""
    pwm: Field | None = None

    @property
    def leading(self) -> Field:
        """Field of the goal in this block that the servo follows: a position, else a speed, an effort or a
        PWM.

        Raises:
            LookupError: The block has no goal.
        """
        for place in (self.position, self.speed, self.effort, self.pwm):
            if place is not None:
                return place
        raise LookupError("this goal layout has no goal register")


class TorqueLimit(msgspec.Struct, frozen=True):
    """Register in RAM that limits a servo's torque, and the register from which it is initialized at
    power-up."""

    name: str  # Title in the e-Manual: `Torque Limit (34)`
    address: int
    full_address: int
    size: int  # Size of either item, bytes


class RegisterValue(msgspec.Struct, frozen=True):
    """One register of a servo with the value that it should have."""

    address: int
    size: int  # 1, 2 or 4
    value: int  # Integer on the wire; negative numbers are written in two's complement
    name: str  # Name in the control table: `position_p_gain`
    eeprom: bool = False  # True if the value survives power-off and is writable only while torque is off
    write: bool = True  # False: the start compares the register, and refuses another value

    @property
    def data(self) -> bytes:
        """Value as bytes for a write, little-endian."""
        return self.value.to_bytes(self.size, "little", signed=self.value < 0)


class Scale(msgspec.Struct, frozen=True):
    """Unit of one tick of a goal, and the highest number of ticks."""

    per_tick: float  # rad/s, the unit of the state's effort, or fraction of the full voltage
    most: int  # Highest tick without sign, according to the manual; the servo's own limit may be lower


class OwnLimit(msgspec.Struct, frozen=True):
    """Register with a limit that is stored in the servo. The servo refuses a goal beyond the limit."""

    of: Literal["speed", "effort", "pwm"]
    name: str
    address: int
    size: int


class ModePlan(msgspec.Struct, frozen=True):
    """One mode of one servo: the registers that select it and the goals that the servo then follows.
    Sources: see `mode_plan`."""

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
"""Control table items that are read between cycles and shown in a joint's states, with the name of the
state."""


class ServoPlan(msgspec.Struct, frozen=True):
    """One servo and its joint. The joint's position is s = direction * (theta - reference) * ratio, with
    the servo's angle theta."""

    joint: str  # Name in messages: the joint, or in a transmission `wrist/left`
    row: int
    """Row of the joint in the state and goal arrays of the whole robot. Where several servos move one
    joint (`MechanicsPlan`), the servo's own row in the arrays of the servos."""
    servo_id: int
    model: str
    model_number: int
    reference: float
    """rad, counted from the servo's raw 0; in a plan that was placed, from tick 0 of its position."""
    direction: int
    rad_per_tick: float
    max_tick: int
    rad_s_per_tick: float
    max_speed_tick: int
    effort_per_tick: float
    """Effort of the joint per tick of present load or current: Nm (N for a linear joint), or the servo's
    own unit, A or the fraction of the maximum."""
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
    """Register values that the servo should have, in the order of writing: EEPROM first. In logs the field
    has the name of the robot file's key `registers`, the source of most values."""
    modes: tuple[ModePlan, ...] = ()  # All modes that the servo can be in
    start_mode: Mode = Mode.POSITION  # Mode that the start-up selects; one of `modes`
    own_limits: tuple[OwnLimit, ...] = ()
    slow: tuple[str, ...] = ()  # Names of the items that are read between cycles
    # Torque is enabled again after a reboot (policy `on_returned_servo: hold`)
    torque_on_return: bool = False
    continuous: bool = False  # The joint is a wheel or turns more than once
    torque_at_start: bool = True
    """True if start-up switches torque on. Otherwise the servo stays limp until a client requests torque."""
    ratio: float = 1.0
    """Movement of the joint per radian of the servo: rad (1 / gear ratio), or m for a linear joint."""
    name: str = ""
    """Unique name of the servo if several servos move one joint: `hip/1`, `wrist/left`; otherwise empty."""
    unit: JointUnit = ROTARY  # Unit of the joint's positions
    expected: tuple[RegisterValue, ...] = ()
    """Register values of the robot file that the start compares and does not write."""
    homing_offset: int | None = None
    """Homing Offset that reference and ticks contain; None: unknown before the start. See `placement`."""
    unplaced_reference: float | None = None
    """Reference of the robot file, if `reference` contains a Homing Offset; None: they are the same."""
    extended: bool = False
    """Position control counts turns, although the joint is not continuous; the start finds the turn."""

    @property
    def own_name(self) -> str:
        """Name that only this servo has: `name`, or that of its joint if it is the joint's only servo."""
        return self.name or self.joint

    @property
    def declared(self) -> dict[str, int]:
        """Register values that the servo should have: integers on the wire by item name, in the order of
        writing."""
        return {setting.name: setting.value for setting in self.settings}

    @property
    def encoder_reference(self) -> float:
        """Reference of the robot file, rad from the servo's raw 0, without Homing Offset and turns."""
        return self.reference - (self.homing_offset or 0) * self.rad_per_tick

    @property
    def turn_ticks(self) -> int:
        """Ticks of one turn of the servo."""
        return round(math.tau / self.rad_per_tick)

    def moved(self, ticks: int) -> ServoPlan:
        """Return the plan of the same joint for a servo whose position is this many ticks higher."""
        ends = {"lower_tick": self.lower_tick + ticks, "upper_tick": self.upper_tick + ticks}
        modes = tuple(replace(mode, **ends) for mode in self.modes)
        return replace(self, reference=self.reference + ticks * self.rad_per_tick, modes=modes, **ends)

    @property
    def position_per_tick(self) -> float:
        """Movement of the joint per tick of the servo's position, rad or m."""
        return self.rad_per_tick * self.ratio

    @property
    def zero(self) -> float:
        """Position of the joint, rad or m, that is subtracted from that of its servo's ticks."""
        return self.direction * self.reference * self.ratio

    @property
    def wraps(self) -> bool:
        """True if the reported position jumps back after each revolution: a continuous joint whose
        position has less than four bytes."""
        return self.continuous and self.state.position.size < 4

    def joint_position(self, raw: int) -> float:
        """Convert a present or goal position in ticks to the joint's position, rad or m.

        theta = raw * rad_per_tick, counter-clockwise positive (thesis of M. Amarante Araujo, 2017,
        JointID; e-Manual AX-12A, Goal Position (30): 300/1023 deg a tick)."""
        return self.direction * (raw * self.position_per_tick - self.reference * self.ratio)

    def position_text(self, position: float) -> str:
        """Format a position of the joint, rad or m, for a message: `12.3 deg`, `4.56 mm`."""
        return self.unit.text(position, digits=self.unit.digits)

    def outside_limits(self, raw: int, lower_tick: int, upper_tick: int) -> str:
        """Return the error text for a servo at `raw`, outside of these limits, all in ticks: `is at 12.3
        deg, outside its limits ...`, with the fix."""
        first, last = sorted(map(self.joint_position, (lower_tick, upper_tick)))
        lower = self.position_text(first).partition(" ")[0]  # the unit follows the upper limit
        return (
            f"is at {self.position_text(self.joint_position(raw))}, outside its limits "
            f"{lower}..{self.position_text(last)}; move the joint inside by hand; "
            f"{help_link('a-joint-is-outside-its-limits')}"
        )

    def mode_plan(self, mode: int) -> ModePlan:
        """Return the plan of a mode of this servo.

        Raises:
            LookupError: The servo does not have the mode.
        """
        for plan in self.modes:
            if plan.mode == mode:
                return plan
        raise LookupError(f"{self.model} of {self.joint} has no mode {Mode(mode).name.lower()}")


class Member(msgspec.Struct, frozen=True):
    """Block of a servo or a device that is read in each cycle; a servo has one, a device may have several."""

    servo_id: int
    address: int
    length: int
    spare: int  # Readable bytes after the block
    device: int = -1  # Index of the device on its bus; -1 for a servo
    block: int = 0  # Index of the block within its device


class DeviceField(msgspec.Struct, frozen=True):
    """One value that a device reports, and its conversion to SI units: number on the wire * scale +
    offset."""

    state: str  # `angular_velocity.x`
    place: Field  # Position in its block
    scale: float  # SI units per tick
    offset: float  # SI units at tick 0
    column: int  # Column of the state among `source_states` of the cycle's record


class DeviceBlock(msgspec.Struct, frozen=True):
    """Adjacent bytes of a device that are read at once, with the values in them."""

    address: int
    length: int
    fields: tuple[DeviceField, ...]
    spare: int = 0  # Readable bytes after the block


class DevicePlan(msgspec.Struct, frozen=True):
    """Plan of a device: a unit on a bus that is not a servo. It is read in each cycle, but has no torque,
    goals or mode."""

    name: str
    servo_id: int  # Its ID
    model: str
    model_number: int | None  # None: the model number is not checked
    source: int  # Row of the device among the sources of the cycle's record
    blocks: tuple[DeviceBlock, ...]  # Blocks of the device, fetched by one read each


class Budget(msgspec.Struct, frozen=True):
    """Bytes and time (ns) that one cycle of reads and goals needs on one bus (protocol.md, Time budget)."""

    request_bytes: int
    reply_bytes: int
    wire_ns: int
    return_delay_ns: int
    latency_ns: int
    goal_bytes: int  # Bytes of goals among `request_bytes`; goals have no reply

    @property
    def goals_ns(self) -> int:
        """Time that the goals take on the wire, ns; part of `wire_ns`."""
        return self.wire_ns * self.goal_bytes // max(self.request_bytes + self.reply_bytes, 1)

    @property
    def total_ns(self) -> int:
        """Time of all reads and goals of one cycle, ns."""
        return self.wire_ns + self.return_delay_ns + self.latency_ns

    @property
    def highest_rate_hz(self) -> float:
        """Rate at which the reads and goals would occupy the whole time of the bus, Hz."""
        return 1e9 / self.total_ns


class BusPlan(msgspec.Struct, frozen=True):
    """Plan of one serial line: its servos and devices, the packets of a cycle, and their time budget."""

    name: str
    port: str  # Device path, or `sim`
    protocol: float
    baud_rate: int
    latency_ns: int
    return_delay_ns: int
    servos: tuple[ServoPlan, ...]
    groups: tuple[tuple[int, ...], ...]
    """Members that one instruction reads, as indices into `members` (servos first). A group of one is a
    plain read."""
    reads: tuple[Transaction, ...]
    """Read transaction of each group, in the plain form that every firmware supports, without lost servos."""
    limp: tuple[Transaction, ...]
    """Broadcasts that switch off the torque of all servos; without reply, so they can be sent at any time."""
    budget: Budget  # Cost of a cycle with the chosen reads, including the fast forms of `fast`
    fast: tuple[bool, ...] = ()
    """True for each group that is read by a fast form (fast sync or bulk read), provided that its servos
    answer one at start-up."""
    read_by: str = ""  # Instructions of the reads in the e-Manual's words: `fast sync read + read`
    watchdog_ticks: int = 0  # Value of each servo's Bus Watchdog, steps of 20 ms; 0: not armed
    slow_period_ns: int = 0  # Period in which each slow register is read once; 0: never
    devices: tuple[DevicePlan, ...] = ()  # Units on the bus that are not servos
    device_margin_ns: int = 1_000_000
    """Time that the host waits for a device after the latest arrival that the wire allows, ns."""
    rs485: bool = False  # The kernel switches the direction of the adapter's transceiver
    boot_ns: int = 0  # Boot time of the adapter after it was plugged in and opened

    @property
    def members(self) -> tuple[Member, ...]:
        """Blocks read in each cycle: one per servo, then every block of every device."""
        return members_of(self.servos, self.devices)

    def member_name(self, index: int) -> str:
        """Return the name of the joint or device to which `members[index]` belongs."""
        device = self.members[index].device
        return self.servos[index].joint if device < 0 else self.devices[device].name

    @property
    def names(self) -> dict[int, str]:
        """Name of the joint or device with each ID on this bus."""
        return {servo.servo_id: servo.joint for servo in self.servos} | {
            device.servo_id: device.name for device in self.devices
        }

    def label(self, servo: ServoPlan | DevicePlan) -> str:
        """Return the name of a servo or a device for messages: `elbow (ID 4 on bus main)`."""
        name = servo.joint if isinstance(servo, ServoPlan) else servo.name
        return f"{name} (ID {servo.servo_id} on bus {self.name})"


def members_of(servos: Sequence[ServoPlan], devices: Sequence[DevicePlan]) -> tuple[Member, ...]:
    """Return the blocks that each cycle reads from the servos and devices of one bus: servos first."""
    states = ((servo.servo_id, servo.state) for servo in servos)
    return (
        *(Member(servo_id, state.address, state.length, state.spare) for servo_id, state in states),
        *(
            Member(device.servo_id, block.address, block.length, block.spare, index, number)
            for index, device in enumerate(devices)
            for number, block in enumerate(device.blocks)
        ),
    )
