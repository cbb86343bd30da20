"""What the bus executes: prepared transactions, reply layouts, units; made before a port opens."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Literal

import msgspec

from dxlwire.joint_unit import ROTARY, JointUnit
from dxlwire.modes import Mode
from dxlwire.transaction import Transaction

SIGN = 0x400
"""Of sign-magnitude items, bit 10: clockwise (e-Manual AX-12A, Moving Speed (32), Present Speed (38), Present
Load (40))."""


class Field(msgspec.Struct, frozen=True):
    """One item inside a block of bytes, little-endian."""

    offset: int
    size: int  # 1, 2 or 4
    encoding: Literal["unsigned", "sign_magnitude", "twos_complement", "float32"]
    """A servo's item is no float32."""
    bit: int | None = None  # Of a device's item: the only bit of it that is meant

    def tick(self, block: bytes | memoryview) -> int:
        """Return the item as the servo counts, out of the bytes of its block.

        Velocity and effort are sign-magnitude in Protocol 1.0 and of XL-320 (e-Manual AX-12A, Present Speed
        (38); XL-320, Present Speed (39)), bits above the sign are ignored; else two's complement (e-Manual
        XM430-W350, Present Velocity (128)).
        """
        raw = block[self.offset : self.offset + self.size]
        if self.encoding == "sign_magnitude":
            value = int.from_bytes(raw, "little")
            return -(value & (SIGN - 1)) if value & SIGN else value & (SIGN - 1)
        return int.from_bytes(raw, "little", signed=self.encoding == "twos_complement")


class StateLayout(msgspec.Struct, frozen=True):
    """The block that is read of a servo each cycle."""

    address: int
    length: int
    position: Field
    velocity: Field
    effort: Field
    spare: int  # Bytes behind the block that can be read with it, see `exchange`


class GoalLayout(msgspec.Struct, frozen=True):
    """A block that is written to a servo each cycle, with the goals of a mode that stand in it."""

    address: int
    length: int
    position: Field | None = None
    speed: Field | None = None
    """Beside a position: of the way to it, None where it does not stand there; alone: the goal itself."""
    effort: Field | None = None
    """Beside a position's block: the most that the way to it may take; alone: the goal itself."""
    pwm: Field | None = None

    @property
    def leading(self) -> Field:
        """Where the goal stands that a servo follows: a position, else a speed, an effort or a PWM.

        Raises LookupError for a block without any.
        """
        for place in (self.position, self.speed, self.effort, self.pwm):
            if place is not None:
                return place
        raise LookupError("no goal stands in this block")


class TorqueLimit(msgspec.Struct, frozen=True):
    """Where a servo's torque is limited in RAM, and where its own limit stands, which it begins with."""

    name: str  # As the e-Manual writes it: `Torque Limit (34)`
    address: int
    full_address: int
    size: int  # Of both, bytes


class RegisterValue(msgspec.Struct, frozen=True):
    """One item of a servo's memory and what it shall hold."""

    address: int
    size: int  # 1, 2 or 4
    value: int  # The integer on the wire; one below 0 in two's complement
    name: str  # As the control table has it: `position_p_gain`
    eeprom: bool = False  # True where it survives power-off, and is written only while torque is off

    @property
    def data(self) -> bytes:
        """What is written, little-endian."""
        return self.value.to_bytes(self.size, "little", signed=self.value < 0)


class Scale(msgspec.Struct, frozen=True):
    """Unit and reach of a goal."""

    per_tick: float  # rad/s, the unit of the state's effort, or fraction of the full voltage
    most: int  # Highest tick without its sign, by the manual; the servo's own limit may be lower


class OwnLimit(msgspec.Struct, frozen=True):
    """Where a servo keeps the limit beyond which it refuses a goal as a whole."""

    of: Literal["speed", "effort", "pwm"]
    name: str
    address: int
    size: int


class ModePlan(msgspec.Struct, frozen=True):
    """One mode of one servo: what selects it, which goals it follows; see `mode_plan` for the sources."""

    mode: Mode
    operating: tuple[RegisterValue, ...]
    """What selects the mode, in the order in which it is written, with torque off."""
    goals: tuple[GoalLayout, ...]  # The blocks of its goals, in the order in which they are sent
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
"""Items of control tables that are states of a joint and are read between the cycles."""


class ServoPlan(msgspec.Struct, frozen=True):
    """One servo and what it moves: s = direction * (theta - reference) * ratio, the position of its joint."""

    joint: str  # What it moves, as sentences name it: its joint, or of a transmission `wrist/left`
    row: int
    """Row of the joint in the state and goal arrays of the whole robot; where several servos move one joint
    (`MechanicsPlan`), its own row in the arrays of the servos."""
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
    """The joint's effort per tick of present load or current: Nm (N where it is linear), or what the servo
    measures, A or the fraction of the maximum."""
    lower_tick: int  # Lowest goal that the joint's limits allow, as the servo counts
    upper_tick: int  # Highest goal that the joint's limits allow, as the servo counts
    state: StateLayout
    goal: GoalLayout
    torque_address: int  # Where torque enable stands, one byte
    hardware_error_address: int | None
    """Address of the byte that reports hardware errors; None in Protocol 1.0, whose replies contain them."""
    torque_limit: TorqueLimit | None = None  # None where the model has none that limits position control
    settings: tuple[RegisterValue, ...] = msgspec.field(default=(), name="registers")
    """What its memory shall hold, in the order in which it is written: EEPROM first. Logs have the name of
    the key that most of it comes from."""
    modes: tuple[ModePlan, ...] = ()  # The modes in which the servo can be
    start_mode: Mode = Mode.POSITION  # In which it is brought at the start; one of `modes`
    own_limits: tuple[OwnLimit, ...] = ()
    slow: tuple[str, ...] = ()  # Items that are read slowly, by name
    torque_on_return: bool = False  # Torque is given back after a reboot (policy `on_returned_servo: hold`)
    continuous: bool = False  # The joint is a wheel, or one of many turns
    torque_at_start: bool = True
    """The start gives it torque; False: it stays limp until a client requests torque."""
    ratio: float = 1.0
    """What the joint moves while the servo turns by 1 rad: rad (1 / gear ratio), or m where it is linear."""
    name: str = ""
    """Its own among all servos, where several move one joint: `hip/1`, `wrist/left`; empty: its joint's."""
    unit: JointUnit = ROTARY  # Of the joint's positions

    @property
    def own_name(self) -> str:
        """A name that no other servo has."""
        return self.name or self.joint

    @property
    def declared(self) -> dict[str, int]:
        """The integer on the wire that the robot file gives an item, by item, in the order of the writes."""
        return {setting.name: setting.value for setting in self.settings}

    @property
    def position_per_tick(self) -> float:
        """What the joint moves in a tick of the position, rad or m."""
        return self.rad_per_tick * self.ratio

    @property
    def wraps(self) -> bool:
        """True where the position goes from one end of its range to the other in a wheel's turn."""
        return self.continuous and self.state.position.size < 4

    def joint_position(self, raw: int) -> float:
        """Return the joint's position, rad or m, of a present or goal position in ticks.

        theta = raw * rad_per_tick, counter-clockwise positive (thesis of M. Amarante Araujo, 2017, JointID;
        e-Manual AX-12A, Goal Position (30): 300/1023 deg a tick).
        """
        return self.direction * (raw * self.position_per_tick - self.reference * self.ratio)

    def position_text(self, position: float) -> str:
        """Write a position of the joint, rad or m, for a person: `12.3 deg`, `4.56 mm`."""
        return self.unit.text(position, digits=self.unit.digits)

    def outside_limits(self, raw: int, lower_tick: int, upper_tick: int) -> str:
        """Return the problem and its fix for a position outside limits, all in ticks; follows the name."""
        first, last = sorted(map(self.joint_position, (lower_tick, upper_tick)))
        lower = self.position_text(first).partition(" ")[0]  # the unit follows the upper limit
        return (
            f"is at {self.position_text(self.joint_position(raw))}, outside its limits "
            f"{lower}..{self.position_text(last)}: move the joint inside by hand"
        )

    def step_text(self, step: float) -> str:
        """Write a step of the joint, rad or m: `12 deg`, `5 mm`."""
        return self.unit.text(step, digits=0)

    def mode_plan(self, mode: int) -> ModePlan:
        """Return one of its modes; raises LookupError when the servo does not have it."""
        for plan in self.modes:
            if plan.mode == mode:
                return plan
        raise LookupError(f"{self.model} of {self.joint} has no mode {Mode(mode).name.lower()}")


class Member(msgspec.Struct, frozen=True):
    """What one read gets each cycle of a servo, or of a device, which may need several."""

    servo_id: int
    address: int
    length: int
    spare: int  # Bytes behind the block that can be read with it
    device: int = -1  # Index of the device on its bus; -1: it is a servo
    block: int = 0  # Number of the device's block


class DeviceField(msgspec.Struct, frozen=True):
    """One state of a device: number on the wire * scale + offset."""

    state: str  # `angular_velocity.x`
    place: Field  # In its block
    scale: float  # SI units per tick
    offset: float  # SI units at tick 0
    column: int  # Of the state among `source_states` of the cycle's record


class DeviceBlock(msgspec.Struct, frozen=True):
    """Bytes of a device that one read gets."""

    address: int
    length: int
    fields: tuple[DeviceField, ...]
    spare: int = 0  # Bytes behind the block that can be read with it


class DevicePlan(msgspec.Struct, frozen=True):
    """Something on a bus that is no servo: read each cycle, never given torque, goals or a mode."""

    name: str
    servo_id: int  # Its ID
    model: str
    model_number: int | None  # None: it is not checked
    source: int  # Row of the device among the sources of the cycle's record
    blocks: tuple[DeviceBlock, ...]  # Each is a read of its own


class Budget(msgspec.Struct, frozen=True):
    """What one cycle costs on one bus, ns (protocol.md, Time budget)."""

    request_bytes: int
    reply_bytes: int
    wire_ns: int
    return_delay_ns: int
    latency_ns: int
    goal_bytes: int  # Those of `request_bytes` that are goals, which have no reply

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
        """The rate at which the bus would do nothing else, Hz."""
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
    """What is read by one instruction: indices into `members`, which are those of `servos` first; a group of
    one is read by itself."""
    reads: tuple[Transaction, ...]
    """The state read of each group, when all its servos answer, in the form that every firmware knows."""
    limp: tuple[Transaction, ...]
    """Torque off for all servos at once, without a reply, to be sent at any moment."""
    budget: Budget  # Of a cycle with the reads that were chosen: the fast forms where `fast` says so
    fast: tuple[bool, ...] = ()
    """Of each group: it is to be read by a fast form, if that is answered at the start."""
    read_by: str = ""  # What the e-Manual calls the instructions of the reads: `fast sync read + read`
    watchdog_ticks: int = 0  # Bus Watchdog of each servo that has one, steps of 20 ms; 0: not armed
    slow_period_ns: int = 0  # In which time each slow register is read once; 0: none is
    devices: tuple[DevicePlan, ...] = ()  # What is on the bus and is no servo
    device_margin_ns: int = 1_000_000
    """How long a device is awaited beyond the latest moment of its reply by the wire."""
    rs485: bool = False  # The kernel switches the direction of the adapter's transceiver
    boot_ns: int = 0  # How long its adapter boots after it was plugged in and opened

    @property
    def members(self) -> tuple[Member, ...]:
        """What is read each cycle: every servo, then every block of every device."""
        return members_of(self.servos, self.devices)

    def member_name(self, index: int) -> str:
        """Return the joint or the device of a member."""
        device = self.members[index].device
        return self.servos[index].joint if device < 0 else self.devices[device].name

    @property
    def names(self) -> dict[int, str]:
        """Joint or device by ID."""
        return {servo.servo_id: servo.joint for servo in self.servos} | {
            device.servo_id: device.name for device in self.devices
        }

    def label(self, servo: ServoPlan | DevicePlan) -> str:
        """Return a servo or a device as messages name it: `elbow (ID 4 on bus main)`."""
        name = servo.joint if isinstance(servo, ServoPlan) else servo.name
        return f"{name} (ID {servo.servo_id} on bus {self.name})"


def members_of(servos: Sequence[ServoPlan], devices: Sequence[DevicePlan]) -> tuple[Member, ...]:
    """Return what is read each cycle of the servos and devices of one bus."""
    states = ((servo.servo_id, servo.state) for servo in servos)
    return (
        *(Member(servo_id, state.address, state.length, state.spare) for servo_id, state in states),
        *(
            Member(device.servo_id, block.address, block.length, block.spare, index, number)
            for index, device in enumerate(devices)
            for number, block in enumerate(device.blocks)
        ),
    )
