"""Shaft of a simulated servo: turns written registers into commands of the mechanics, and motion into
registers."""

from __future__ import annotations

import ctypes
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache, partial
from typing import ClassVar, NamedTuple

from dxlsim.motion.compiled_mechanics import STRUCTS, ShownQuantity, library
from dxlsim.motion.control_law import LIMP, ServoCommand
from dxlsim.motion.mechanics import STEP_NS, SUPPLY_OHM, Mechanics
from dxlsim.motion.motor import Motor
from dxlsim.registers.access import ShaftItems
from dxlsim.registers.memory import Memory, value_range
from dxlsim.simulation_plan import Load
from dxlwire.control_table import ControlItem

_ENCODINGS = {"unsigned": 0, "twos_complement": 1, "sign_magnitude": 2}  # As in mechanics.c


class LiveItem(NamedTuple):
    """Item that shows the motion: `quantity * times / unit`, rounded to ticks, plus `zero`."""

    quantity: ShownQuantity
    unit: float = 1.0
    times: float = 1.0
    zero: int = 0
    lowest: int | None = None  # Range of the ticks; None: that of the register
    highest: int | None = None
    sign_bit: int = -1  # Bit of a negative sign; -1: in two's complement, or unsigned


class Shaft(ABC):
    """Shaft of one simulated servo: follows written registers and reports the motion; a subclass for each
    family of registers."""

    items: ClassVar[ShaftItems]

    def __init__(self, memory: Memory, mechanics: Mechanics, motor: Motor, load: Load, angle: float) -> None:
        self.memory = memory
        self.mechanics = mechanics
        self.motor = motor
        self._torque_per_ampere = self.motor.torque_per_ampere
        self.index = mechanics.add_servo(self.motor, load, angle)
        self._library = library()
        self.state = STRUCTS["Shaft"](
            mechanics=mechanics.address,
            memory=ctypes.addressof(memory.image),
            index=self.index,
            now_ns=mechanics.grid_ns,
            started_ns=mechanics.grid_ns,
            sign=1.0,
            rad_per_tick=memory.table.rad_per_tick,
            divider=1.0,
            torque_per_ampere=motor.torque_per_ampere,
            supply_ohm=SUPPLY_OHM,
        )
        """Struct `Shaft` of mechanics.c: how the registers show the motion."""
        self.address = ctypes.addressof(self.state)
        self._last: ServoCommand | None = None
        self._goes_to_goal = False
        self._withdrawn = 0  # Number of times that pending commands were withdrawn

    @property
    def angle(self) -> float:
        """Angle of the shaft at the servo's time, rad from raw 0, including turns, without Homing Offset
        and reversal."""
        angle: float = self._library.motion_angle(self.address)
        return angle

    @property
    def velocity(self) -> float:
        """Speed of the shaft, rad/s, counter-clockwise positive."""
        return self.mechanics.plant.velocity.item(self.index)

    @property
    def current(self) -> float:
        """Current of the motor, A, positive when it drives counter-clockwise."""
        torque: float = self.mechanics.servos["torque"].item(self.index)
        return torque / self._torque_per_ampere

    @property
    def duty(self) -> float:
        """Fraction of the supply voltage at the motor, -1 to 1."""
        duty: float = self.mechanics.servos["duty"].item(self.index)
        return duty

    @property
    def moving(self) -> bool:
        """True while the shaft's trajectory moves, or while its speed exceeds the threshold."""
        return bool(self._library.motion_is_moving(self.address))

    @property
    def now_ns(self) -> int:
        """Time of the servo, ns."""
        now_ns: int = self.state.now_ns
        return now_ns

    @property
    def _goes_to_goal(self) -> bool:
        return bool(self.state.goes_to_goal)

    @_goes_to_goal.setter
    def _goes_to_goal(self, goes: bool) -> None:
        self.state.goes_to_goal = goes

    def show_items(self) -> None:
        """Take the items that show the motion from `live_items`; call it again after one has changed."""
        items = self.memory.table.items
        common = {
            "realtime_tick": LiveItem(ShownQuantity.TIME),
            "present_temperature": LiveItem(ShownQuantity.TEMPERATURE),
            "present_inverter_temperature": LiveItem(ShownQuantity.TEMPERATURE),
            "present_motor_temperature": LiveItem(ShownQuantity.TEMPERATURE),
        }
        for name in {"present_voltage", "present_input_voltage"} & items.keys():
            common[name] = LiveItem(ShownQuantity.VOLTAGE, items[name].scale)
        known = {name: live for name, live in {**common, **self.live_items()}.items() if name in items}
        self._items = _structs(tuple((items[name], live) for name, live in known.items()))
        self.state.items, self.state.item_count = ctypes.addressof(self._items), len(known)

    def show_range(self, address: int, length: int) -> None:
        """Write the motion at the servo's time into the registers of a range."""
        self._library.motion_show(self.address, 0, address, length)

    def position_tick(self, angle: float) -> int:
        """Return the value of Present Position, ticks, for an angle of the shaft, rad."""
        return int(self._library.motion_position_tick(self.address, angle))

    @property
    def torque_on(self) -> bool:
        """True if the motor holds or moves the shaft: torque is enabled and Torque Limit is not 0."""
        return self.memory.get("torque_enable") == 1 and self.memory.get("torque_limit", 1) > 0

    def recount_turns(self, angle: float) -> None:
        """Stop the shaft where it is, and change its count of turns so that its angle becomes `angle`,
        rad."""
        self.mechanics.recount_turns(self.index, angle)
        self._forget()

    def _forget(self) -> None:
        self._withdraw()
        self._last = None
        self._goes_to_goal = False
        self.state.turns = False

    def _withdraw(self) -> None:
        self._withdrawn += 1
        self.mechanics.withdraw(self.index)

    @property
    def response_delay_ns(self) -> int:
        """Delay until a command takes effect, ns; torque off has none."""
        delay_ns: int = self.state.response_delay_ns
        return delay_ns

    @response_delay_ns.setter
    def response_delay_ns(self, delay_ns: int) -> None:
        self.state.response_delay_ns = delay_ns

    def take_goal_items(self, names: Sequence[str]) -> None:
        """Set the items of a goal: position, speed and acceleration; names that the model lacks are
        ignored."""
        for struct, name in zip(self.state.goal_items, names, strict=True):
            if (item := self.memory.table.items.get(name)) is not None:
                struct.address, struct.size = item.address, item.size
                struct.encoding = _ENCODINGS[item.encoding]

    def advance_to(self, now_ns: int) -> None:
        """Advance the shaft's time and the mechanics to `now_ns`; an earlier time is ignored."""
        if now_ns > self.now_ns:
            self.state.now_ns = now_ns
            if now_ns - self.mechanics.grid_ns >= STEP_NS:
                self.mechanics.step_to(now_ns)

    def plan(self, written: Iterable[str]) -> None:
        """Command the motion that the registers ask for after these were written, unless it is the last
        command."""
        if self.items.aims.isdisjoint(written) and self.items.others.isdisjoint(written):
            return
        if self._goes_to_goal and self.items.aims.issuperset(written):
            if self._library.motion_plan(self.address, 0):
                self.mechanics.follow_plan(self.address)
            return
        command = self._command() if self.torque_on else LIMP
        self._goes_to_goal = command.limit > 0.0 and self._controls_position
        if self._goes_to_goal:
            self._library.motion_plan(self.address, 1)
            goal, speed, acceleration = self.state.next
            command = command._replace(goal=goal, speed=speed, acceleration=acceleration)
        if command != self._last:
            self._last = command
            self.state.turns = command.turning != 0.0
            if command.limit == 0.0:
                self._withdraw()
                self.mechanics.command_servo(self.index, command)
            else:
                self._act(partial(self.mechanics.command_servo, self.index, command))

    def _act(self, action: Callable[[], None]) -> None:
        """Schedule an action on the mechanics after the response delay, at the next grid point.

        It is up to a step late, half a step on average. That compensates the lead of a plant, which
        updates its velocity first."""
        withdrawn = self._withdrawn

        def act_if_current() -> None:
            if withdrawn == self._withdrawn:
                action()

        self.mechanics.call_at(self.now_ns + self.response_delay_ns, act_if_current)

    def power_up(self) -> None:
        """Stop the shaft and count its angle within one turn, as a servo does at power-up; the goal
        becomes that angle [i]."""
        self.recount_turns(self.within_a_turn(self.angle))
        self.memory["goal_position"] = self.position_tick(self.angle)

    @abstractmethod
    def within_a_turn(self, angle: float) -> float:
        """Return the angle, rad, that the servo shows after power-up, when it has lost its count of turns."""

    @abstractmethod
    def live_items(self) -> Mapping[str, LiveItem]:
        """Return the items that show the motion; names that the model lacks are ignored."""

    @abstractmethod
    def _command(self) -> ServoCommand:
        """Return the controller's command from the registers while torque is on, without the trajectory to
        a goal."""

    @property
    @abstractmethod
    def _controls_position(self) -> bool: ...


@cache
def _structs(shown: tuple[tuple[ControlItem, LiveItem], ...]) -> ctypes.Array[ctypes.Structure]:
    """Return the array of `LiveItem` of mechanics.c, the same for all servos that show the same: together
    they would not fit into the processor's cache."""
    structs = (STRUCTS["LiveItem"] * len(shown))()
    for struct, (item, live) in zip(structs, shown, strict=True):
        lowest, highest = value_range(item)
        struct.quantity, struct.unit, struct.times, struct.zero = live[:4]
        struct.lowest = lowest if live.lowest is None else live.lowest
        struct.highest = highest if live.highest is None else live.highest
        struct.sign_bit, struct.address, struct.size = live.sign_bit, item.address, item.size
    return structs


def critical_d(p: float, motor: Motor) -> float:
    """Return the D gain, duty per rad/s, with which a P gain, duty per rad, does not overshoot.

    With the motor's time constant T, and w its stall torque over damping, the loop is T x'' + (1 + D w) x'
    + P w x = 0."""
    speed = motor.stall_torque / motor.damping
    return max(0.0, 2 * math.sqrt(p * speed * motor.time_constant) - 1.0) / speed
