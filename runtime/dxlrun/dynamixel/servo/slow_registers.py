"""Slow registers: temperature, voltage and other registers that change slowly, read block by block in idle
time.
"""

from __future__ import annotations

from dxlrun.channels.cycle import States
from dxlrun.dynamixel import texts
from dxlrun.dynamixel.servo.life import Life
from dxlrun.dynamixel.servo.reboots import Reboots
from dxlwire.bus_plan import SLOW_STATES, BusPlan
from dxlwire.control_table import ControlItem, decoded, find_table, side_by_side
from dxlwire.exchange.bus_engine import NEVER
from dxlwire.exchange.idle import Urgency
from dxlwire.transaction import Program

_LIMITS = ("temperature_limit", "motor_temperature_limit")
WARN_BELOW = 10.0  # degrees C below the servo's own limit (failures.md)
COOLED = 5.0  # degrees C below the warning: the servo counts as cooled down

_Block = tuple[ControlItem, ...]  # adjacent items, read by one instruction; empty: Realtime Tick


class SlowReads:
    """Reads the slow registers of the servos of one bus, one block at a time, each once per period of the
    plan.

    Temperature and voltage go into the states; other items are logged when they change. Realtime Tick is read
    as well, because it shows a reboot between two cycles.
    """

    def __init__(self, life: Life, reboots: Reboots, states: States) -> None:
        self._life = life
        self._reboots = reboots
        self._states = states
        self._round = _round(life.bus.plan)
        self._next = 0
        self._reading = False
        self._interval_ns = life.bus.plan.slow_period_ns // max(len(self._round), 1)
        self._due_ns = 0
        self._known: dict[tuple[int, str], int] = {}
        self._hot: set[int] = set()  # servos near their temperature limit

    @property
    def due_ns(self) -> int:
        """Time (ns) of the next read; NEVER while a read is waiting."""
        return NEVER if self._reading or not self._round else self._due_ns

    def schedule_read(self) -> None:
        """Schedule the read of the next block in idle time if it is due; called once a cycle."""
        if self._life.now_ns() < self.due_ns:
            return
        for _ in self._round:
            index, block = self._round[self._next]
            self._next = (self._next + 1) % len(self._round)
            if not self._life.offline(index):
                self._begin_read(index, block)
                break
        self._due_ns = self._life.now_ns() + self._interval_ns

    def _begin_read(self, index: int, block: _Block) -> None:
        self._reading = True
        program = self._read_block(index, block) if block else self._read_tick(index)
        self._life.do(index, program, "slow registers", Urgency.SLOW)

    def _read_tick(self, index: int) -> Program[None]:
        rebooted = yield from self._reboots.tick(index)
        self._reading = False
        if rebooted and not self._life.offline(index):
            self._life.lose(index).rebooted = True

    def _read_block(self, index: int, block: _Block) -> Program[None]:
        start, end = block[0].address, block[-1].address + block[-1].size
        reply = yield self._life.access_servo(index).reading(start, end - start)
        self._reading = False
        if reply.answered:
            values = decoded(block, start, reply.parameters)
            for item in block:
                self._note(index, item, values[item.name])

    def _note(self, index: int, item: ControlItem, raw: int) -> None:
        states, row = self._states, self._life.bus.plan.servos[index].row
        before = self._known.get((index, item.name))
        self._known[index, item.name] = raw
        state = SLOW_STATES.get(item.name)
        if state == "temperature":
            states.temperature[row] = raw * item.scale
            self._warm(index, raw * item.scale)
        elif state == "voltage":
            states.voltage[row] = raw * item.scale
        elif before not in (None, raw) and item.name not in _LIMITS:
            event = texts.register_changed(self._life.servo_name(index), item.title, before, raw)
            self._life.report_event(index, event)

    def _warm(self, index: int, celsius: float) -> None:
        items = self._life.access_servo(index).items
        item = next((items[name] for name in _LIMITS if name in items), None)
        if item is None:
            return
        raw = self._known.get((index, item.name))
        if raw is None:  # read once, after the first temperature
            if not self._reading:
                self._begin_read(index, (item,))
            return
        limit = raw * item.scale
        about = self._life.servo_name(index), celsius, item.title, limit
        if celsius >= limit - WARN_BELOW and index not in self._hot:
            self._hot.add(index)
            self._life.report_event(index, texts.servo_hot(*about))
        elif celsius <= limit - WARN_BELOW - COOLED and index in self._hot:
            self._hot.remove(index)
            self._life.report_event(index, texts.servo_cooled(*about))


def _round(plan: BusPlan) -> list[tuple[int, _Block]]:
    """Return (servo, block) of all slow reads of a bus: the first block of every servo, then the second
    blocks, then the ticks.
    """
    if not plan.slow_period_ns:
        return []
    found: list[tuple[int, int, _Block]] = []
    for index, servo in enumerate(plan.servos):
        items = find_table(servo.model, plan.protocol).items
        blocks = [*side_by_side(items[name] for name in servo.slow if name in items)]
        if "realtime_tick" in items:
            blocks.append(())
        found += [(number, index, block) for number, block in enumerate(blocks)]
    return [(index, block) for _, index, block in sorted(found, key=lambda one: one[:2])]
