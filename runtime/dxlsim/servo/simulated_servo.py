"""Simulated servo: receives instructions, replies, moves its shaft, and can be damaged by faults.

This module has the common part of both protocols, and the servo of Protocol 1.0. `protocol2_servo` has the
instructions and the protection of the other servos. `[i]` marks behaviour that was inferred where the
e-Manual has no answer; nothing was compared with a real servo yet.

Not modelled: other protocols than 1.0 and 2.0 on one line (a servo set to another protocol is silent), the
shared properties of the two shafts of a 2XL or 2XC, servos that are coupled by Drive Mode, and effects of
the firmware version beyond the control table, the fast reads, Clear and Control Table Backup."""

from __future__ import annotations

import ctypes
import math
from abc import abstractmethod
from collections.abc import Callable

from dxlsim.motion.compiled_mechanics import function_address
from dxlsim.motion.shaft import Shaft
from dxlsim.registers.access import ACCESS, RULES, ErrorOf, accepted_goals, lock_error
from dxlsim.registers.memory import Memory
from dxlsim.servo.node import BULK_READ, Answer, SimulatedNode
from dxlsim.wire.compiled_line import GoalState
from dxlsim.wire.servo_packets import Instruction, InstructionPacket
from dxlsim.wire.servo_protocol1 import ErrorBit

BOOT_NS = 100_000_000  # Time without reception after a reboot; the manuals give no value [i]

_SECONDARY_IDS = ("secondary_shadow_id", "secondary_id")


class SimulatedServo(SimulatedNode):
    """One simulated servo of either protocol: its registers command a shaft and report the motion."""

    kind = "servo"

    def __init__(self, memory: Memory, error_of: ErrorOf, shaft: Shaft, note: Callable[[str], None]) -> None:
        self.shaft = shaft
        self._overload = False
        self.wakes_on_goal = True
        """True: in Protocol 1.0 a write of Goal Position (30) while Torque Enable (24) is 0 sets Torque
        Enable to 1 [i]."""
        self.boot_ns = BOOT_NS
        """Duration of a reboot or a factory reset by an instruction of Protocol 2.0, ns."""
        self._write_time_ns = 0
        self._registered: tuple[int, bytes] | None = None
        super().__init__(memory, error_of, note, shaft.now_ns)
        memory.show_range = shaft.show_range
        self.line.show, self.line.shaft = function_address("show"), shaft.address
        self.line.received_ns = shaft.now_ns
        self._secondary_item = next((each for each in _SECONDARY_IDS if each in memory), None)
        self._voltage = 0.0
        self.voltage = _supply(memory)
        shaft.mechanics.watch_servo(shaft.index, self._strained)
        self._watch_identity()
        named = (memory.table.items.get(name) for name in sorted(ACCESS.goals | shaft.items.aims))
        # A goal in the EEPROM, Profile Velocity of Y, is locked by torque, which only Python checks.
        self._goals = [
            item for item in named if item is not None and (item.access, item.area) == ("RW", "RAM")
        ]
        self._accepted = (GoalState * max(len(self._goals), 1))(
            *(GoalState(address=item.address, size=item.size, is_signed=item.signed) for item in self._goals)
        )
        self._names_of: dict[int, frozenset[str]] = {}
        self.line.take_goal = function_address("take_goal")
        self._set_aims()
        self.line.goals, self.line.goal_count = ctypes.addressof(self._accepted), len(self._goals)
        memory.watch_items(RULES, self._accept_goals)

    @property
    def write_time_ns(self) -> int:
        """Time without reception after an instruction that writes, ns."""
        return self._write_time_ns

    @write_time_ns.setter
    def write_time_ns(self, duration_ns: int) -> None:
        self._write_time_ns = duration_ns
        self._set_aims()

    def _set_aims(self) -> None:
        """Let the line follow goals that only change a trajectory, unless a write takes time."""
        aims = self.shaft.items.aims
        bits = sum(1 << index for index, item in enumerate(self._goals) if item.name in aims)
        self.line.aims = 0 if self._write_time_ns else bits

    def _identify(self) -> None:
        super()._identify()
        secondary = 255 if self._secondary_item is None else self.registers[self._secondary_item]
        off = secondary > 252 or secondary == self.servo_id
        self.line.secondary_id = -1 if off else secondary

    # Interface to the line

    def advance_to(self, now_ns: int) -> None:
        """Advance the shaft and the registers that show it to `now_ns`; an earlier time is ignored."""
        self.shaft.advance_to(now_ns)
        self.line.now_ns = self.shaft.now_ns
        self.registers.refresh()

    def receives(self, now_ns: int) -> bool:
        """Return True if the cable has contact at `now_ns`; the line asks while the cable is loose."""
        self.shaft.advance_to(now_ns)
        return all(contact() for contact in self._contacts)

    def present(self, now_ns: int, address: int, length: int) -> None:
        """Advance the shaft to `now_ns`, and the registers of a range that show it."""
        self.shaft.advance_to(now_ns)
        if length:
            self.registers.refresh_range(address, length)

    def execute_packet(self, packet: InstructionPacket, now_ns: int) -> Answer | None:
        """Advance the shaft to `now_ns`, and execute an instruction other than a read."""
        self.shaft.advance_to(now_ns)
        return super().execute_packet(packet, now_ns)

    def _accept_goals(self) -> None:
        """Let the line know the goals that the servo accepts now; Python executes other writes."""
        for accepted, item in zip(self._accepted, self._goals, strict=False):
            accepted.lowest, accepted.highest = accepted_goals(self.registers, item)

    def follow_written_goals(self, goals: int, now_ns: int) -> None:
        """Follow goals that the line has written, whose instruction ended at `now_ns`."""
        names = self._names_of.get(goals)
        if names is None:
            written = (item.name for index, item in enumerate(self._goals) if goals >> index & 1)
            names = self._names_of[goals] = frozenset(written)
        self.shaft.advance_to(now_ns)
        self._written(names)
        self._pause_after_write()

    def excuse(self, duration_ns: int) -> None:
        """Do not count a stall of this process, of `duration_ns`, toward the timeout of the Bus Watchdog."""
        self.line.received_ns += duration_ns

    # Differences between the protocols

    @abstractmethod
    def apply_protection(self, refused: int = 0) -> None:
        """Switch torque off if an error is active that the register Shutdown lists; `refused` has the
        error of a refused instruction."""

    @abstractmethod
    def _start_up(self) -> None: ...

    # Instructions that both protocols have

    def _manage(self, packet: InstructionPacket) -> int:
        match packet.instruction:
            case Instruction.REG_WRITE if (write := self._codec.write(packet.parameters)) is not None:
                return self._beyond_shadow(packet.servo_id, *write) or self._register(*write)
            case Instruction.ACTION if self._registered is not None:
                return self._act()
        return super()._manage(packet)

    def _write(self, address: int, data: bytes) -> int:
        error = super()._write(address, data)
        if not error:
            self._pause_after_write()
        return error

    def _pause_after_write(self) -> None:
        if self.write_time_ns:
            line = self.line
            self._receive_nothing_until(max(line.deaf_until_ns, line.received_ns + self.write_time_ns))

    def _written(self, names: frozenset[str]) -> None:
        self.shaft.plan(names)

    def _register(self, address: int, data: bytes) -> int:
        error = self._refused(self.registers.runs(address, data))
        if not error:
            self._keep_registered((address, data))
        return error

    def _act(self) -> int:
        if self._registered is None:
            return 0
        address, data = self._registered
        self._keep_registered(None)
        return self._write(address, data)

    def _keep_registered(self, write: tuple[int, bytes] | None) -> None:
        self._registered = write
        for name in ("registered", "registered_instruction"):
            self.registers.show_value(name, write is not None)

    def _set(self, name: str, wire: int) -> None:
        self.registers[name] = wire
        self.shaft.plan((name,))

    # Effects of time and load

    def _show_errors(self) -> None:
        """Update the error bits of replies that do not depend on registers alone."""

    def _strained(self) -> None:
        """React to a new temperature, in whole degrees, or to an overload, which the mechanics report."""
        if not self.overload and self.shaft.mechanics.overloaded(self.shaft.index):
            self.overload = True
            self.note(f"servo {self.servo_id}: overload: the load turns the shaft")
        self._show_errors()
        self.apply_protection()

    def power_up(self) -> None:
        """Start with RAM registers at their values for power-up; the shaft stays at its angle."""
        self._registered = None
        self.overload = False
        self.registers.restore_ram()
        self.shaft.power_up()
        self._start_up()
        self.apply_protection()
        self.registers.refresh()

    # Interface for tests and faults

    @property
    def shaft_angle(self) -> float:
        """Angle of the shaft, rad from raw 0, at the time of `advance_to` or of the last instruction."""
        return self.shaft.angle

    @property
    def velocity(self) -> float:
        """Speed of the shaft, rad/s, counter-clockwise positive."""
        return self.shaft.velocity

    @property
    def torque_on(self) -> bool:
        """True if the motor holds or moves the shaft: torque is enabled and Torque Limit is not 0."""
        return self.shaft.torque_on

    @property
    def overload(self) -> bool:
        """True while the load exceeds the torque of the shaft."""
        return self._overload

    @overload.setter
    def overload(self, on: bool) -> None:
        self._overload = on
        self._show_errors()

    @property
    def voltage(self) -> float:
        """Supply voltage of the servo, V; the servo measures less while it draws current."""
        return self._voltage

    @voltage.setter
    def voltage(self, volts: float) -> None:
        self._voltage = self.shaft.state.voltage = volts
        self.shaft.mechanics.supply(self.shaft.index, volts)
        self._show_errors()

    @property
    def temperature(self) -> float:
        """Temperature of the servo, degrees C."""
        celsius: float = self.shaft.mechanics.servos["temperature"].item(self.shaft.index)
        return celsius

    @temperature.setter
    def temperature(self, celsius: float) -> None:
        self.shaft.mechanics.heat(self.shaft.index, celsius)
        self._show_errors()

    def jam_shaft(self, on: bool) -> None:
        """Block the shaft at its present angle, or release it."""
        self.shaft.mechanics.jam_shaft(self.shaft.index, on)
        self.note(f"servo {self.servo_id}: shaft {'blocked' if on else 'free'}")

    def power_cycle(self) -> None:
        """Power-cycle the servo: RAM is lost, the shaft stays at its angle."""
        self.note(f"servo {self.servo_id}: power cycle")
        self.power_up()

    def trigger_overload(self) -> None:
        """Overload the shaft beyond its torque, as a fault.

        The overload ends with a power cycle, a reboot (Protocol 2.0), or a write of Torque Limit (34,
        Protocol 1.0)."""
        self.overload = True
        self.note(f"servo {self.servo_id}: overload")
        self.apply_protection()

    def set_voltage(self, volts: float) -> None:
        """Change the servo's supply voltage, V, as a fault."""
        self.voltage = volts
        self.note(f"servo {self.servo_id}: voltage {volts} V")
        self.apply_protection()

    def set_temperature(self, celsius: float) -> None:
        """Set the servo's temperature, degrees C, as a fault."""
        self.temperature = celsius
        self.note(f"servo {self.servo_id}: temperature {celsius} degC")
        self.apply_protection()

    def turn_shaft(self, by: float, duration_ns: int) -> None:
        """Turn the shaft as by hand by an angle, rad, within a time. The hand lets go of a servo that has
        torque."""

        def gives_way(turned: float) -> None:
            angles = f"{math.degrees(turned):.1f} of {math.degrees(by):g} deg"
            self.note(f"servo {self.servo_id}: turned by hand only {angles}, because the servo has torque")

        self.shaft.mechanics.turn_shaft(self.shaft.index, by, duration_ns, gives_way)


class Protocol1Servo(SimulatedServo):
    """Simulated servo of Protocol 1.0: AX, DX, EX, RX, and MX with their first firmware.

    It has error bits, Torque Limit 0 after a shutdown, and the lock of the EEPROM."""

    def __init__(self, memory: Memory, shaft: Shaft, note: Callable[[str], None]) -> None:
        super().__init__(memory, lock_error, shaft, note)
        self.line.least_entries = 2
        self.line.group_reads = BULK_READ if "bulk_read" in memory.table.capabilities else 0
        memory.watch_items(("min_voltage_limit", "max_voltage_limit", "temperature_limit"), self._show_errors)

    def _manage(self, packet: InstructionPacket) -> int:
        """Execute an instruction other than reads and writes; an AX rejects a bulk read as unknown [i]."""
        if packet.instruction != Instruction.FACTORY_RESET:
            return super()._manage(packet)
        self.registers.restore_factory_values()
        self.power_up()
        return 0

    def decline_group_read(self, packet: InstructionPacket, entries: int, *, failed: bool) -> None:
        """Note that the servo refuses a bulk read: MX models answer those of two servos or more."""
        self.note(f"servo {self.servo_id} refuses a bulk read of {entries}")

    # Protection

    def _show_errors(self) -> None:
        self.line.error_bits = self._errors_now()

    def _errors_now(self) -> int:
        """Return the error bits of every reply; each persists as long as its cause."""
        registers, errors = self.registers, self.registers.table.errors
        error = errors.value_of("overload") if self.overload else 0
        if not registers["min_voltage_limit"] <= round(self.voltage * 10) <= registers["max_voltage_limit"]:
            error |= errors.value_of("input_voltage")
        if round(self.temperature) > registers["temperature_limit"]:
            error |= errors.value_of("overheating")
        return error

    def apply_protection(self, refused: int = 0) -> None:
        """Set Torque Limit to 0 if Shutdown (18) lists an error; Torque Enable (24) does not change."""
        error = self._errors_now() | refused
        if error & self.registers["shutdown"] and self.registers["torque_limit"]:
            self.note(f"servo {self.servo_id}: shutdown, torque limit 0: {ErrorBit(error)!r}")
            self._set("torque_limit", 0)

    def _start_up(self) -> None:
        self.shaft.state.started_ns = self.shaft.now_ns
        self.registers["torque_limit"] = self.registers["max_torque"]  # e-Manual, Torque Limit (34)

    def _written(self, names: frozenset[str]) -> None:
        registers = self.registers
        if "goal_position" in names and self.wakes_on_goal and "torque_enable" not in names:
            registers["torque_enable"] = 1
        if "torque_limit" in names and registers["torque_limit"] > 0:
            self.overload = False
        super()._written(names)


def _supply(memory: Memory) -> float:
    """Return the voltage with which a simulated servo is supplied, V.

    It is the voltage of the manual's data; otherwise 12 V, or the middle of the servo's limits."""
    if memory.table.nominal_voltage:
        return memory.table.nominal_voltage
    lowest, highest = memory.get("min_voltage_limit", 0), memory.get("max_voltage_limit", 999)
    return 12.0 if lowest <= 120 <= highest else (lowest + highest) / 20
