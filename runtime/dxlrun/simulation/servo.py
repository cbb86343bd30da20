"""A simulated servo of Protocol 1.0: a control table, what it answers, and a shaft that moves.

Where the e-Manual says nothing, `[i]` marks what was inferred; nothing here was compared with a servo yet.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from dxlrun.control_table import control_table
from dxlrun.simulation import motion
from dxlrun.simulation.packets import BROADCAST, ErrorBit, Instruction, InstructionPacket
from dxlrun.simulation.registers import Registers

ACCELERATION = 100.0
"""rad/s^2. The manual names none: 1.5 Nm of stall torque on 0.015 kg m^2 of gear and a light link [i]."""

_MOTION_ITEMS = frozenset(
    ("torque_enable", "goal_position", "moving_speed", "torque_limit", "cw_angle_limit", "ccw_angle_limit")
)


@dataclass(frozen=True, slots=True)
class ServoConfig:
    """A servo as it hangs on a bus when the simulation starts."""

    servo_id: int
    model: str
    position: float
    """rad, from the servo's raw 0"""
    return_delay_ns: int = 500_000
    """Initial value of Return Delay Time (5), rounded to its unit of 2 us."""


@dataclass(frozen=True, slots=True)
class Reply:
    """What a servo sends back, and how long after the instruction's last byte it starts to."""

    servo_id: int
    error: int
    parameters: bytes
    delay_ns: int


class SimulatedServo:
    """One servo: the bus calls `execute`; tests look at registers and cause faults.

    `wakes_on_goal`: writing Goal Position (30) while Torque Enable (24) is 0 sets it to 1 [i].
    `note` is told of every refusal and every fault.
    """

    def __init__(
        self, config: ServoConfig, baud_rate: int, start_ns: int, note: Callable[[str], None] | None = None
    ) -> None:
        self.registers = Registers(control_table(config.model))
        self.wakes_on_goal = True
        self._note = note or (lambda text: None)
        self._silent = False
        self._voltage = 12.0
        self._temperature = 30.0
        self._overload = False
        self._registered: tuple[int, bytes] | None = None
        self._now_ns = start_ns
        self._motion = motion.rest(start_ns, config.position)
        self._drive: tuple[float, ...] = ()
        self.registers["id"] = config.servo_id
        self.registers["baud_rate"] = _baud_value(self.registers, baud_rate)
        self.registers["return_delay_time"] = min(254, round(config.return_delay_ns / 2000))
        self._power_up()

    # What the bus asks

    @property
    def servo_id(self) -> int:
        """ID (3)."""
        return self.registers["id"]

    @property
    def baud_rate(self) -> int:
        """The rate at which it listens, bit/s: the manual's list, or its formula 2e6 / (value + 1)."""
        value = self.registers["baud_rate"]
        return self.registers.table.baud_rates.get(value, 2_000_000 // (value + 1))

    def advance(self, now_ns: int) -> None:
        """Bring the shaft and the present registers to a time; going back is ignored."""
        self._now_ns = max(self._now_ns, now_ns)
        self._refresh()

    def execute(self, packet: InstructionPacket, now_ns: int) -> Reply | None:
        """Obey an instruction whose last byte arrived at `now_ns`; return the reply, None for silence."""
        servo_id = self.servo_id  # a write of ID (3) is still answered under the old one [i]
        own = packet.servo_id == servo_id
        if self._silent or not (own or packet.servo_id == BROADCAST):
            return None
        self._now_ns = max(self._now_ns, now_ns)
        error, parameters = self._obey(packet) if packet.intact else (ErrorBit.CHECKSUM, b"")
        if error:
            said = packet.parameters.hex(" ")
            self._note(f"servo {servo_id} refuses {packet.instruction:#04x} {said}: {ErrorBit(error)!r}")
            self._shut_down_on(error)
        if not self._answers(packet, own):
            return None
        return Reply(
            servo_id=servo_id,
            error=error | self._state(),
            parameters=parameters,
            delay_ns=self.registers["return_delay_time"] * 2000,
        )

    # What tests see and do

    @property
    def position(self) -> float:
        """Angle of the shaft, rad from raw 0, at the time of `advance` or of the last instruction."""
        return self._motion.at(self._now_ns)[0]

    @property
    def velocity(self) -> float:
        """Speed of the shaft, rad/s, counter-clockwise positive."""
        return self._motion.at(self._now_ns)[1]

    @property
    def torque_on(self) -> bool:
        """True when the motor holds or moves the shaft: torque enabled and its limit not 0."""
        return self.registers["torque_enable"] == 1 and self.registers["torque_limit"] > 0

    def silence(self, on: bool = True) -> None:
        """Cut or mend its data line: it hears and answers nothing, and goes on with what it does."""
        self._silent = on
        self._note(f"servo {self.servo_id}: data line {'cut' if on else 'mended'}")

    def reset(self) -> None:
        """Cut and give back its power: RAM is lost, the shaft stays where it is."""
        self._note(f"servo {self.servo_id}: power cycle")
        self._power_up()

    def poke(self, name: str, wire: int) -> None:
        """Set a control item as if it had been so before; the integer of the wire, no refusal."""
        self._note(f"servo {self.servo_id}: {name} set to {wire}")
        self.registers[name] = wire
        self._plan((name,))

    def trigger_overload(self) -> None:
        """Load the shaft beyond the torque; ends with a write of Torque Limit (34), or a power cycle."""
        self._overload = True
        self._note(f"servo {self.servo_id}: overload")
        self._shut_down_on(self._state())

    def set_voltage(self, volts: float) -> None:
        """Supply it with another voltage, V."""
        self._voltage = volts
        self._note(f"servo {self.servo_id}: voltage {volts} V")
        self._shut_down_on(self._state())

    def set_temperature(self, celsius: float) -> None:
        """Heat it, degrees C."""
        self._temperature = celsius
        self._note(f"servo {self.servo_id}: temperature {celsius} degC")
        self._shut_down_on(self._state())

    def turn_by_hand(self, angle: float) -> None:
        """Turn the shaft to an angle, rad; a servo with torque goes back to its goal."""
        self._note(f"servo {self.servo_id}: turned by hand to {angle} rad")
        self._motion = motion.rest(self._now_ns, angle)
        self._drive = ()
        self._plan(_MOTION_ITEMS)

    # Instructions

    def _answers(self, packet: InstructionPacket, own: bool) -> bool:
        """Return whether a status packet follows (Status Return Level (16)); of broadcasts only to a ping."""
        if packet.intact and packet.instruction == Instruction.PING:
            return True
        level = 1 if packet.intact and packet.instruction == Instruction.READ else 2
        return own and level <= self.registers["status_return_level"]

    def _obey(self, packet: InstructionPacket) -> tuple[int, bytes]:
        """Return error bits and parameters of the reply."""
        parameters = packet.parameters
        match packet.instruction:
            case Instruction.PING:
                answer: tuple[int, bytes] = (0, b"")
            case Instruction.READ if len(parameters) == 2:
                answer = self._read(*parameters)
            case Instruction.WRITE if len(parameters) >= 2:
                answer = self._write(parameters[0], parameters[1:]), b""
            case Instruction.REG_WRITE if len(parameters) >= 2:
                answer = self._register(parameters[0], parameters[1:]), b""
            case Instruction.ACTION if self._registered is not None:
                answer = self._write_registered(*self._registered), b""
            case Instruction.FACTORY_RESET:
                self.registers.restore_factory_values()
                self._power_up()
                answer = 0, b""
            case Instruction.SYNC_WRITE if packet.servo_id == BROADCAST:
                answer = self._sync_write(parameters), b""
            case _:  # also bulk read, which an AX does not know, and a wrong number of parameters [i]
                answer = ErrorBit.INSTRUCTION, b""
        return answer

    def _read(self, address: int, length: int) -> tuple[int, bytes]:
        self._refresh()
        data = self.registers.read(address, length)
        return (ErrorBit.RANGE, b"") if data is None else (0, data)

    def _write(self, address: int, data: bytes) -> int:
        error = self.registers.refusal(address, data)
        if not error:
            names = self.registers.write(address, data)
            if "goal_position" in names and self.wakes_on_goal and "torque_enable" not in names:
                self.registers["torque_enable"] = 1
            if "torque_limit" in names and self.registers["torque_limit"] > 0:
                self._overload = False
            self._plan(names)
        return error

    def _register(self, address: int, data: bytes) -> int:
        error = self.registers.refusal(address, data)
        if not error:
            self._registered = (address, data)
            self.registers["registered"] = 1
        return error

    def _write_registered(self, address: int, data: bytes) -> int:
        self._registered = None
        self.registers["registered"] = 0
        return self._write(address, data)

    def _sync_write(self, parameters: bytes) -> int:
        if len(parameters) < 2 or parameters[1] == 0 or (len(parameters) - 2) % (parameters[1] + 1):
            return ErrorBit.INSTRUCTION
        address, length, servo_id = parameters[0], parameters[1], self.servo_id
        error = 0
        for start in range(2, len(parameters), length + 1):
            if parameters[start] == servo_id:
                error |= self._write(address, parameters[start + 1 : start + 1 + length])
        return error

    # State

    def _power_up(self) -> None:
        angle = self.position
        self._registered = None
        self._overload = False
        self._drive = ()
        self._motion = motion.rest(self._now_ns, angle)
        self.registers.restore_ram()
        self.registers["goal_position"] = self._position_tick(angle)  # [i]
        self._shut_down_on(self._state())
        self._refresh()

    def _state(self) -> int:
        """Return the error bits that last as long as their cause."""
        registers = self.registers
        error = int(ErrorBit.OVERLOAD) if self._overload else 0
        if not registers["min_voltage_limit"] <= round(self._voltage * 10) <= registers["max_voltage_limit"]:
            error |= ErrorBit.VOLTAGE
        if self._temperature > registers["temperature_limit"]:
            error |= ErrorBit.OVERHEATING
        return error

    def _shut_down_on(self, error: int) -> None:
        """Take the torque away when Shutdown (18) lists the error; Torque Enable (24) stays as it is."""
        if error & self.registers["shutdown"] and self.registers["torque_limit"]:
            self._note(f"servo {self.servo_id}: shutdown, torque limit 0: {ErrorBit(error)!r}")
            self.registers["torque_limit"] = 0
            self._plan(("torque_limit",))

    def _plan(self, written: Iterable[str]) -> None:
        """Start another motion when what was written asks for one."""
        if _MOTION_ITEMS.isdisjoint(written):
            return
        drive = self._wanted()
        if drive == self._drive:
            return
        self._drive = drive
        angle, velocity, _ = self._motion.at(self._now_ns)
        if not drive:
            self._motion = motion.rest(self._now_ns, angle)
        elif len(drive) == 1:
            self._motion = motion.turn(self._now_ns, angle, velocity, drive[0], ACCELERATION)
        else:
            angle = (
                angle if 0 <= angle < math.tau else angle % math.tau
            )  # turns of wheel mode are not counted
            self._motion = motion.move_to(
                self._now_ns, angle, velocity, drive[0], speed=drive[1], acceleration=ACCELERATION
            )

    def _wanted(self) -> tuple[float, ...]:
        """Return nothing (limp), a speed (wheel mode, rad/s), or goal (rad) and speed (rad/s)."""
        registers, table = self.registers, self.registers.table
        if not self.torque_on:
            return ()
        ticks = registers.ticks("moving_speed")
        if registers.wheel_mode:
            return (ticks / table.max_speed_tick * table.max_speed,)
        speed = abs(ticks) * table.rad_s_per_tick
        goal = registers["goal_position"] * table.rad_per_tick
        return goal, min(speed, table.max_speed) if speed else table.max_speed

    def _refresh(self) -> None:
        registers, table = self.registers, self.registers.table
        angle, velocity, acceleration = self._motion.at(self._now_ns)
        unit = table.max_speed / table.max_speed_tick if registers.wheel_mode else table.rad_s_per_tick
        # No mechanics stand behind the load: some for the speed, some for the change of it [i].
        load = 0.1 * velocity / table.max_speed + 0.4 * acceleration / ACCELERATION
        limit = registers["torque_limit"]
        registers["present_position"] = self._position_tick(angle)
        registers["present_speed"] = _sign_magnitude(velocity / unit, table.max_speed_tick)
        registers["present_load"] = _sign_magnitude(load / table.effort_per_tick, limit)
        registers["present_voltage"] = max(0, min(255, round(self._voltage * 10)))
        registers["present_temperature"] = max(0, min(255, round(self._temperature)))
        registers["moving"] = int(velocity != 0.0 or acceleration != 0.0)

    def _position_tick(self, angle: float) -> int:
        """Return what Present Position (36) shows; beyond the reach the nearest end [i]."""
        table = self.registers.table
        if not 0 <= angle < math.tau:
            angle %= math.tau
        tick = round(angle / table.rad_per_tick)
        if tick <= table.max_tick:
            return tick
        dead_zone = math.tau / table.rad_per_tick - table.max_tick
        return table.max_tick if tick - table.max_tick < dead_zone / 2 else 0


def _sign_magnitude(ticks: float, limit: int) -> int:
    magnitude = min(limit, round(abs(ticks)))
    return magnitude | 1 << 10 if ticks < 0 and magnitude else magnitude


def _baud_value(registers: Registers, baud_rate: int) -> int:
    for value, rate in registers.table.baud_rates.items():
        if rate == baud_rate:
            return value
    value = round(2_000_000 / baud_rate) - 1  # e-Manual, Baud Rate (4): 2,000,000 / (value + 1)
    if not 0 <= value <= 254:
        raise ValueError(f"the servo has no baud rate near {baud_rate} bit/s")
    return value
