"""A simulated servo as bus and tests see it: it hears instructions, answers, and can be broken.

Where the e-Manual says nothing, `[i]` marks what was inferred; nothing here was compared with a servo yet.

Not modelled: other protocols than 1.0 and 2.0 on one line (a servo that is told to speak one falls silent),
what the two shafts of a 2XL or 2XC share, servos that Drive Mode couples, and what firmware decides beyond
the control table, the fast reads, Clear and Control Table Backup.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from dxlrun.dynamixel.control_table import ControlTable, control_table, models_by_number
from dxlrun.simulation.configuration import ServoConfig
from dxlrun.simulation.memory.cells import Memory
from dxlrun.simulation.motion.mechanics import Mechanics
from dxlrun.simulation.servo.bodies import make_body
from dxlrun.simulation.servo.body import Body
from dxlrun.simulation.wire.packets import BROADCAST, GroupRead, InstructionPacket, ReadEntry, Reply


@dataclass(slots=True)
class ServoCounts:
    """What a servo did on the line since the start."""

    received: int = 0
    """Intact instructions to it, those to all servos among them."""
    replied: int = 0
    errors: int = 0
    """Replies with an error."""
    last_error: int = 0
    """Of its last reply, as in the packet."""

    def reply(self, error: int) -> None:
        """Count a reply."""
        self.replied += 1
        self.errors += error != 0
        self.last_error = error


class SimulatedServo:
    """One servo: the bus calls `execute` and `reply_to_group_read`; tests look at registers and cause faults.

    `note` is told of every refusal and every fault.
    """

    def __init__(
        self,
        config: ServoConfig,
        baud_rate: int,
        start_ns: int,
        note: Callable[[str], None] | None = None,
        protocol: float = 1.0,
        *,
        mechanics: Mechanics | None = None,
    ) -> None:
        self._note = note or (lambda text: None)
        table = _table(config, protocol)
        self._body, self._instructions = make_body(
            table,
            mechanics or Mechanics(start_ns),
            config.load,
            config.position,
            self._note,
            firmware=config.firmware,
        )
        self.counts = ServoCounts()
        self._silent = False
        self.registers["id"] = config.servo_id
        self._baud_item = (
            "baud_rate" if "baud_rate" in table.items else "baud_rate_bus"
        )  # the Y series has two
        self.registers[self._baud_item] = _baud_value(self.registers, baud_rate)
        self.registers["return_delay_time"] = min(254, round(config.return_delay_ns / 2000))
        self._body.power_up()

    @property
    def registers(self) -> Memory:
        """Its control items, by name, as integers of the wire."""
        return self._body.memory

    @property
    def body(self) -> Body:
        """What it is without its line."""
        return self._body

    # What the bus asks

    @property
    def servo_id(self) -> int:
        """ID."""
        return self._body.servo_id

    @property
    def secondary_id(self) -> int | None:
        """Secondary ID (12), to which it hears and never answers; None: it has none, or it is off."""
        return self._body.secondary_id

    def listens_to(self, servo_id: int) -> bool:
        """Return whether an instruction to an ID, or to all, is for this servo."""
        return servo_id == BROADCAST or servo_id in (self._body.servo_id, self._body.secondary_id)

    @property
    def baud_rate(self) -> int:
        """The rate at which it listens, bit/s."""
        return _rate(self._body.memory, self._body.memory[self._baud_item])

    def advance(self, now_ns: int) -> None:
        """Bring the shaft and the present registers to a time; going back is ignored."""
        self._body.advance(now_ns)
        self._body.refresh()

    def execute(self, packet: InstructionPacket, now_ns: int) -> Reply | None:
        """Obey an instruction whose last byte arrived at `now_ns`; return the reply, None for silence."""
        body, instructions = self._body, self._instructions
        servo_id = body.servo_id  # a write of ID is still answered under the old one [i]
        own = packet.servo_id == servo_id
        if not (own or self.listens_to(packet.servo_id)) or not self.receives(now_ns):
            return None
        answering = instructions.answers(packet, own)
        delay_ns = instructions.delay_ns(packet, 10_000_000_000 // self.baud_rate) if answering else 0
        error, parameters = instructions.obey(packet)
        if error:
            said = f"{packet.instruction:#04x} {packet.parameters.hex(' ')}"
            self._note(f"servo {servo_id} refuses {said}: {instructions.describe(error)}")
            body.protect(error)
        if not answering:
            return None
        return Reply(servo_id, error | body.state(), parameters, delay_ns)

    def reply_to_group_read(self, reading: GroupRead, entry: ReadEntry, now_ns: int) -> Reply | None:
        """Return its part of the answer to an instruction that ended at `now_ns`; None for silence."""
        if not self.receives(now_ns):
            return None
        answer = self._instructions.reply_to_group_read(reading, entry)
        if answer is None:
            return None
        body = self._body
        # of a status that servos share only the first one waits
        delay_ns = 0 if reading.fast and entry is not reading.entries[0] else body.delay_ns
        return Reply(body.servo_id, answer[0] | body.state(), answer[1], delay_ns)

    def receives(self, now_ns: int) -> bool:
        """Take note of an instruction at a time; return whether it reaches the servo."""
        body = self._body
        if self._silent or now_ns < body.deaf_until_ns or not body.hears_protocol:
            return False
        body.hear(now_ns)
        return True

    def lasts(self, entry: ReadEntry) -> bool:
        """Return whether it replies the same until a servo moves or something is written."""
        return self._body.lasts(entry.address, entry.length)

    # What tests see and do

    @property
    def wakes_on_goal(self) -> bool:
        """Whether writing Goal Position (30) of Protocol 1.0 switches the torque on [i]."""
        return self._body.wakes_on_goal

    @wakes_on_goal.setter
    def wakes_on_goal(self, on: bool) -> None:
        self._body.wakes_on_goal = on

    @property
    def answers_damaged(self) -> bool:
        """Whether a packet with a wrong checksum gets the manual's error; a robot may do either [?]."""
        return self._body.answers_damaged

    @answers_damaged.setter
    def answers_damaged(self, on: bool) -> None:
        self._body.answers_damaged = on

    @property
    def boot_ns(self) -> int:
        """How long a reboot by an instruction takes [i]."""
        return self._body.boot_ns

    @boot_ns.setter
    def boot_ns(self, duration_ns: int) -> None:
        self._body.boot_ns = duration_ns

    @property
    def position(self) -> float:
        """Angle of the shaft, rad from raw 0, at the time of `advance` or of the last instruction."""
        return self._body.shaft.angle

    @property
    def velocity(self) -> float:
        """Speed of the shaft, rad/s, counter-clockwise positive."""
        return self._body.shaft.velocity

    @property
    def torque_on(self) -> bool:
        """True when the motor holds or moves the shaft: torque enabled and its limit not 0."""
        return self._body.shaft.torque_on

    @property
    def voltage(self) -> float:
        """Its supply, V."""
        return self._body.voltage

    @property
    def temperature(self) -> float:
        """degrees C."""
        return self._body.temperature

    def silence(self, on: bool = True) -> None:
        """Cut or mend its data line: it hears and answers nothing, and goes on with what it does."""
        self._silent = on
        self.registers.version += 1
        self._note(f"servo {self.servo_id}: data line {'cut' if on else 'mended'}")

    def reset(self) -> None:
        """Cut and give back its power: RAM is lost, the shaft stays where it is."""
        self._note(f"servo {self.servo_id}: power cycle")
        self._body.power_up()

    def cut_power(self, until_ns: int) -> None:
        """Cut its power until a time: RAM is lost, and it neither moves nor hears anything before."""
        self.reset()
        self._body.deaf_until_ns = max(self._body.deaf_until_ns, until_ns)
        self.registers.version += 1

    def poke(self, name: str, wire: int) -> None:
        """Set a control item as if it had been so before; the integer of the wire, no refusal."""
        self._note(f"servo {self.servo_id}: {name} set to {wire}")
        self._body.poke(name, wire)

    def trigger_overload(self) -> None:
        """Load the shaft beyond the torque.

        It ends with a power cycle, a reboot (Protocol 2.0), a write of Torque Limit (34, Protocol 1.0).
        """
        self._body.overload = True
        self.registers.version += 1
        self._note(f"servo {self.servo_id}: overload")
        self._body.protect()

    def set_voltage(self, volts: float) -> None:
        """Supply it with another voltage, V."""
        self._body.voltage = volts
        self._note(f"servo {self.servo_id}: voltage {volts} V")
        self._body.protect()

    def set_temperature(self, celsius: float) -> None:
        """Heat it, degrees C."""
        self._body.temperature = celsius
        self._note(f"servo {self.servo_id}: temperature {celsius} degC")
        self._body.protect()

    def turn(self, by: float, duration_ns: int) -> None:
        """Let a hand turn the shaft by an angle, rad, in a time; it gives way to a servo that has torque."""

        def gives_way(turned: float) -> None:
            came = f"gives way after {math.degrees(turned):.1f} of {math.degrees(by):g} deg"
            self._note(f"servo {self.servo_id}: holds or drives its shaft, so the hand that turns it {came}")

        shaft = self._body.shaft
        shaft.mechanics.turn(shaft.index, by, duration_ns, gives_way)

    def turn_by_hand(self, angle: float) -> None:
        """Turn the shaft to an angle, rad; a servo with torque goes back to its goal."""
        self._note(f"servo {self.servo_id}: turned by hand to {angle} rad")
        self._body.shaft.rest_at(angle)
        self._body.shaft.plan(self._body.shaft.items)


def _table(config: ServoConfig, protocol: float) -> ControlTable:
    """Return the table of a model, or the one that its number has with the firmware that was asked for."""
    table = control_table(config.model, protocol)
    if config.firmware is None:
        return table
    fitting = (
        each for each in models_by_number(table.model_number, protocol) if each.firmware <= config.firmware
    )
    return next(fitting, table)


def _rate(memory: Memory, value: int) -> int:
    """Return the manual's rate of a value, bit/s; in Protocol 1.0 also by its formula 2e6 / (value + 1)."""
    rates = memory.table.baud_rates
    if memory.table.protocol == 1.0:
        return rates.get(value, 2_000_000 // (value + 1))
    return rates.get(value, 0)


def _baud_value(memory: Memory, baud_rate: int) -> int:
    for value, rate in memory.table.baud_rates.items():
        if rate == baud_rate:
            return value
    value = round(2_000_000 / baud_rate) - 1  # e-Manual, Baud Rate (4): 2,000,000 / (value + 1)
    if memory.table.protocol != 1.0 or not 0 <= value <= 254:
        raise ValueError(f"the servo has no baud rate near {baud_rate} bit/s")
    return value
