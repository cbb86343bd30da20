"""One servo on a tool's line: read and write its control table, and switch its torque.

What every run does is done by the same programs as there: registers are compared, only differences written
and read back; torque comes with a goal where the servo stands.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

from dxlrun.dynamixel.control_table import ControlItem, ControlTable, control_table
from dxlrun.dynamixel.plan.bus_plan import BusPlan, RegisterValue, ServoPlan
from dxlrun.dynamixel.plan.line import LONGEST_RETURN_DELAY_NS, listen
from dxlrun.dynamixel.plan.planning import Wiring, bus_plan
from dxlrun.dynamixel.servo import modes, watchdog
from dxlrun.dynamixel.servo.registers import Difference, Settled, compare, settle
from dxlrun.dynamixel.servo.retry import extend_timeouts, retry
from dxlrun.dynamixel.servo.watchdog import shown, tripped
from dxlrun.dynamixel.tools.scanning import FoundServo
from dxlrun.dynamixel.tools.tool_line import ToolLine
from dxlrun.dynamixel.wire.transaction import Outcome, Program, Result
from dxlrun.errors import ServoFault
from dxlrun.mode import Mode

LONGEST_READ = 64
"""Bytes of one read; neighbours are read together."""
BLINK_NS = 300_000_000
"""How long the LED is on, and then off."""
_LEDS = ("led", "led_red", "led_green", "led_blue")


class OneServo:
    """A servo that a tool was told to deal with; blocks, and raises ServoFault or PortError."""

    def __init__(self, tool: ToolLine, found: FoundServo) -> None:
        if not found.model or found.garbled:
            raise ServoFault(f"ID {found.servo_id} at {found.baud_rate} bit/s {'; '.join(found.remarks)}")
        self.tool = tool
        self.found = found
        self.table: ControlTable = control_table(found.model, found.protocol)
        self.move_to(found.servo_id, found.baud_rate)

    def move_to(self, servo_id: int, baud_rate: int) -> None:
        """Deal with it under another ID, at another rate, from now on."""
        self.servo_id, self.baud_rate = servo_id, baud_rate
        self.tool.speak(self.table.protocol, baud_rate)
        self.plan = self._plan()

    @property
    def called(self) -> str:
        """How messages call it."""
        return f"{self.table.model}, ID {self.servo_id} at {self.baud_rate} bit/s"

    @property
    def _servo(self) -> ServoPlan:
        return self.plan.servos[0]

    def fail(self, text: str) -> ServoFault:
        """Return the error that says something of this servo."""
        return ServoFault(f"{self.called}: {text}")

    # Registers

    def read(self, names: Sequence[str], *, refused: bool = False) -> Mapping[str, int]:
        """Return items by name: integers of the wire, signed where the item is.

        `refused`: what the servo's firmware does not have is left out; without, that is an error.
        """
        found: dict[str, int] = {}
        for block in _blocks([self.table.items[name] for name in names]):
            found |= self.run(self._read_block(block, refused=refused))
        return {name: found[name] for name in names if name in found}

    def differences(self, wanted: Sequence[RegisterValue]) -> tuple[Difference, ...]:
        """Compare registers with what they shall hold; writes nothing."""
        found = self.run(compare(self.plan, self._servo, wanted, self.tool.line))
        silent = [self.table.items[one.register.name].title for one in found if one.found is None]
        if silent:
            raise self.fail(f"did not answer when {', '.join(silent)} was read")
        return found

    def writable(self, wanted: Sequence[RegisterValue]) -> None:
        """Make sure that nothing stands against writing registers: torque, or the lock of Protocol 1.0."""
        stored = [self.table.items[one.name].title for one in wanted if one.eeprom]
        if not stored:
            return
        if self.holds_torque():
            raise self.fail(
                f"holds torque, so {stored[0]} in its EEPROM is not written; switch the torque off first: "
                f"{self.command} torque off"
            )
        if self.table.protocol == 1.0 and "lock" in self.table.items and self.read(["lock"])["lock"]:
            raise self.fail("its Lock (47) is 1, which keeps the EEPROM as it is until its power is cut")

    def write(self, wanted: Sequence[RegisterValue]) -> tuple[str, ...]:
        """Write the registers that differ, in order, and read each back; return what was written.

        Before goals, which a servo refuses while its Bus Watchdog is tripped, that is cleared; so is it where
        the watchdog itself is written.
        """
        self.writable(wanted)
        tripping = any(one.name.startswith(("goal_", "bus_watchdog")) for one in wanted)
        cleared = self.clear_watchdog(armed=False) if tripping else ()
        settled: Settled = self.run(settle(self.plan, self._servo, wanted, self.tool.line))
        if settled.problems:
            before = [f"written before that: {text}" for _, text in settled.written]
            raise ServoFault("\n".join([*settled.problems, *before]))
        return (*cleared, *(text for _, text in settled.written))

    def clear_watchdog(self, *, armed: bool) -> tuple[str, ...]:
        """Clear a Bus Watchdog that is tripped, `armed`: or would trip; return what was done, if anything.

        A run that was killed leaves it so. A servo that was stopped with torque would go on to its old goal,
        at full speed, as its profile was reset: its torque is off until it is held where it stands. Raises
        ServoFault.
        """
        item = self.table.items.get("bus_watchdog")
        if item is None:
            return ()
        raw = self.read([item.name], refused=True).get(item.name, 0)
        if not (tripped(item, raw) or (armed and raw)):
            return ()
        stopped = tripped(item, raw) and self.holds_torque()
        if stopped:
            self.torque(False)
        if problem := self.run(watchdog.disarm(self.plan, self._servo)):
            raise ServoFault(problem)
        why = "it had stopped the servo, as no instruction came"
        if not tripped(item, raw):
            why = f"it would have stopped the servo after {raw * 20} ms without an instruction"
        done = f"cleared {item.title}, which was {shown(item, raw)}: {why}"
        return (done, self._hold()) if stopped else (done,)

    # Torque and LED

    def holds_torque(self) -> bool:
        """Say whether Torque Enable is on."""
        return bool(self.read(["torque_enable"])["torque_enable"])

    def torque(self, on: bool) -> tuple[str, ...]:
        """Switch the torque on where the servo stands, or off; read back. Return what was done.

        For the torque a Bus Watchdog that is tripped, or would trip, is cleared.
        """
        if not on:
            written = self.write([self.register("torque_enable", 0)])
            return ("holds no torque" + ("" if written else ", as before"),)
        cleared = self.clear_watchdog(armed=True)
        if not self.holds_torque():
            return (*cleared, self._hold())
        return cleared if len(cleared) > 1 else (*cleared, "holds torque, as before")

    def _hold(self) -> str:
        """Hold the servo where it stands; return what was done."""
        mode = self._mode()
        held = self.run(modes.hold(self.plan, self._servo, self._servo.mode_plan(mode)))
        if held.problem:
            self.run(settle(self.plan, self._servo, [self.register("torque_enable", 0)], self.tool.line))
            raise self.fail(f"{held.problem}; its torque is off")
        where = "" if held.goal is None else f" at tick {held.goal}, where it stood"
        return f"holds torque in {mode.name.lower().replace('_', '-')} mode{where}"

    def blink(self, times: int) -> str:
        """Let the LED blink, and leave it as it was; return what was done."""
        names = [name for name in _LEDS if name in self.table.items]
        if not names:
            raise self.fail("this model has no LED that can be switched")
        before = self.read(names)
        bright = [self.register(name, self.table.items[name].maximum) for name in names]
        dark = [self.register(name, 0) for name in names]
        try:
            for state in (bright, dark) * times:
                self.write(state)
                self.tool.run(_pause(BLINK_NS))
        finally:
            self.write([self.register(name, value) for name, value in before.items()])
        return f"blinked {times} times"

    # Inside

    def run(self, program: Program[Result]) -> Result:
        """Run a program patiently: somebody knows that the servo is there."""
        return self.tool.run(extend_timeouts(program))

    @property
    def command(self) -> str:
        """How a command line to it begins."""
        return f"dxlrun servo {self.tool.port.name} {self.servo_id}"

    def _mode(self) -> Mode:
        """Find out in which mode it is, and prepare that; raises ServoFault for one that is not known."""
        for continuous in (False, True):
            try:
                self.plan = self._plan(continuous)
            except ValueError:  # the model has no modes without end
                break
            mode = self.run(modes.mode_now(self.plan, self._servo))
            if mode is not Mode.UNKNOWN:
                return mode
        self.plan = self._plan()
        raise self.fail("is in a mode that dxlrun does not know, so its torque stays off")

    def register(self, name: str, value: int) -> RegisterValue:
        """Return an item with what it shall hold, the integer of the wire."""
        item = self.table.items[name]
        return RegisterValue(item.address, item.size, value, name, item.area == "EEPROM")

    def _plan(self, continuous: bool = False) -> BusPlan:
        table, name = self.table, self.tool.port.name
        end = math.inf if continuous else 0.0
        wiring = Wiring(
            joint=table.model,
            row=0,
            servo_id=self.servo_id,
            table=table,
            reference=0.0,
            direction=1,
            lower=-end or table.min_tick * table.rad_per_tick,
            upper=end or table.max_tick * table.rad_per_tick,
            continuous=continuous,
        )
        return bus_plan(
            name=name,
            port=name,
            baud_rate=self.baud_rate,
            latency_ns=self.tool.port.most_latency_ns,
            return_delay_ns=LONGEST_RETURN_DELAY_NS,
            joints=[wiring],
            protocol=table.protocol,
        )

    def _read_block(self, block: Sequence[ControlItem], *, refused: bool) -> Program[dict[str, int]]:
        start, end = block[0].address, block[-1].address + block[-1].size
        reply = yield from retry(self.tool.line.read(self.servo_id, start, end - start))
        if reply.answered:
            return {item.name: _integer(item, reply.parameters, start) for item in block}
        found: dict[str, int] = {}
        for item in block:
            reply = yield from retry(self.tool.line.read(self.servo_id, item.address, item.size))
            if reply.answered:
                found[item.name] = _integer(item, reply.parameters, item.address)
            elif reply.outcome is not Outcome.REFUSED:
                raise self.fail(f"did not answer when {item.title} was read")
            elif not refused:
                why = self.tool.line.dialect.describe_error(reply.error)
                raise self.fail(f"refuses to read {item.title}: {why}")
        return found


def _integer(item: ControlItem, data: bytes | memoryview, start: int) -> int:
    offset = item.address - start
    return int.from_bytes(data[offset : offset + item.size], "little", signed=item.signed)


def _blocks(items: Sequence[ControlItem]) -> Iterator[list[ControlItem]]:
    """Yield neighbours together, as far as one read takes them."""
    block: list[ControlItem] = []
    for item in sorted(items, key=lambda item: item.address):
        joined = block and block[-1].address + block[-1].size == item.address
        if block and (not joined or item.address + item.size - block[0].address > LONGEST_READ):
            yield block
            block = []
        block.append(item)
    if block:
        yield block


def _pause(duration_ns: int) -> Program[bool]:
    yield listen(duration_ns)
    return True
