"""Goals: arrays in SI units -> the sync writes of one bus, in whatever mode each servo is."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

import msgspec
import numpy as np
from numpy.typing import NDArray

from dxlrun.channels.cycle import Commands, Floats
from dxlrun.description.modes import COMMAND_INTERFACES, CommandName, Mode
from dxlrun.dynamixel.plan.planning import goal_parts
from dxlrun.dynamixel.wire.dialect import Dialect, dialect_of
from dxlrun.plan.bus_plan import (
    SIGN,
    BusPlan,
    Field,
    GoalLayout,
    ModePlan,
    OwnLimit,
    Scale,
    ServoPlan,
)

REPEATED = 50
"""Cycles after which an unchanged goal is sent again: a sync write has no acknowledgement."""

LEADS: Mapping[Mode, CommandName] = {Mode.VELOCITY: "velocity", Mode.EFFORT: "effort", Mode.PWM: "pwm"}
"""The goal that a mode follows, where it is not the position; without it a servo is sent none."""

ROUNDING = 1e-6  # Ticks; a speed that is less below a tick is that tick: it was computed from it
_VELOCITY = COMMAND_INTERFACES.index("velocity")

Bools = NDArray[np.bool_]


class GoalCell(msgspec.Struct, frozen=True):
    """One goal item of one servo: how a goal in SI units becomes the integer in its packet.

    With its sign: tick = (sign * goal + offset) / unit, to the nearest, from `low` to `high`. A magnitude:
    tick = |goal| / unit, from `low` to `high`, `free` where the goal is NaN; that of a speed is rounded down,
    because it is a limit.
    """

    place: Field  # Where it stands in the servo's block
    interface: int  # Row of the goals, as COMMAND_INTERFACES counts
    magnitude: bool
    sign: float
    offset: float
    unit: float
    low: int
    high: int
    free: int = 0

    def tick(self, goal: float, ceiling: float) -> int:
        """Return the integer on the wire; a magnitude of velocity is at most `ceiling`, NaN: no ceiling."""
        if not self.magnitude:
            exact = (self.sign * goal + self.offset) / self.unit
            tick = (
                round(exact)
                if self.low <= exact <= self.high
                else self.low
                if exact < self.low
                else self.high
            )
            mirrored = self.place.encoding == "sign_magnitude" and tick < 0
            return SIGN - tick if mirrored else tick
        if self.interface == _VELOCITY and not (math.isnan(ceiling) or abs(goal) <= ceiling):
            goal = ceiling
        exact = abs(goal) / self.unit
        if self.low <= exact <= self.high:
            return math.floor(exact + ROUNDING) if self.interface == _VELOCITY else round(exact)
        return self.low if exact < self.low else self.high if exact > self.high else self.free


class GoalArrays:
    """Builds the goal packets of one bus: one sync write for all servos of one mode and layout.

    A goal is sent when it changed, once more in the next cycle, and every `REPEATED` cycles; so what stays
    costs no time on the wire. Position: to the nearest tick, inside the joint's limits and so inside the
    servo's range, never wraps. Speed toward a position: magnitude, rounded down; 0 rad/s is 1 tick, because 0
    ticks mean the maximum in joint mode and no limit in a profile; NaN is 0 ticks; too fast is the highest
    tick.
    Velocity, effort and PWM as goals of their own: to the nearest tick with their sign, no more than the
    servo's own limit, beyond which it would refuse the goal as a whole; NaN: the servo gets none. Effort
    beside a position: the most that it may take, NaN = all that the servo's own limit lets it.
    """

    def __init__(self, plan: BusPlan) -> None:
        self._plan = plan
        self._modes: list[Mode] = [servo.start_mode for servo in plan.servos]
        self._limits: list[dict[str, int]] = [{} for _ in plan.servos]
        self.fraction = 1.0  # The part of a servo's limit of effort or PWM that goals may ask for
        self._unlimited = [math.nan] * len(plan.servos)
        self.sync_writes: tuple[SyncWrite, ...] = ()
        """One for each mode and block of goals, in the order in which they are sent; new after a change."""
        self.renew()

    @property
    def modes(self) -> Sequence[Mode]:
        """The modes in which the servos are for the goals; UNKNOWN: one gets none."""
        return self._modes

    def set_mode(self, index: int, mode: Mode) -> None:
        """Take a servo, by its index in the plan, for one in another mode; UNKNOWN: it gets no goals.

        Raises LookupError when the servo does not have the mode.
        """
        if mode != self._modes[index]:
            if mode is not Mode.UNKNOWN:
                self._plan.servos[index].mode_plan(mode)
            self._modes[index] = mode
            self.renew()

    def set_limits(self, index: int, limits: Mapping[OwnLimit, int]) -> None:
        """Keep the goals of a servo within the limits that were read of it, ticks."""
        self._limits[index] = {limit.of: value for limit, value in limits.items()}
        self.renew()

    def weaken(self, fraction: float) -> None:
        """Let no goal ask for more effort or PWM than a fraction of the servo's limit."""
        self.fraction = fraction
        self.renew()

    def packets(self, goals: Commands, included: Bools, ceiling: Floats | None = None) -> Iterator[bytes]:
        """Build one packet after the other for servos that are `included`, shape (servos,), with a goal due.

        `ceiling`, shape (servos,): the highest speed toward a position, rad/s; NaN: no other than the goal's.
        """
        values: list[list[float]] = goals.values.tolist()
        here: list[bool] = included.tolist()
        most: list[float] = self._unlimited if ceiling is None else ceiling.tolist()
        for one in self.sync_writes:
            if (packet := one.packet(values, here, most)) is not None:
                yield packet

    def renew(self) -> None:
        """Build the sync writes anew; every goal is sent again, as after the line was lost."""
        groups: dict[tuple[Mode, tuple[GoalLayout, ...]], list[int]] = {}
        servos = self._plan.servos
        for index, (servo, mode) in enumerate(zip(servos, self._modes, strict=True)):
            if mode is not Mode.UNKNOWN:
                groups.setdefault((mode, servo.mode_plan(mode).goals), []).append(index)
        dialect = dialect_of(self._plan.protocol)
        self.sync_writes = tuple(
            SyncWrite(
                dialect,
                layout,
                LEADS.get(mode, "position"),
                part,
                [servos[index] for index in part],
                [_cells(servos[index], mode, layout, self._limits[index], self.fraction) for index in part],
            )
            for (mode, layouts), members in groups.items()
            for layout in layouts
            for part in goal_parts(dialect, layout, members)
        )


class SyncWrite:
    """One block of goals of the servos of one bus in one mode, and when each of them was sent."""

    def __init__(  # noqa: PLR0917  what is written, to which servos
        self,
        dialect: Dialect,
        layout: GoalLayout,
        lead: CommandName,
        members: Sequence[int],
        servos: Sequence[ServoPlan],
        cells: Sequence[Sequence[GoalCell]],
    ) -> None:
        self._dialect = dialect
        self.layout = layout
        self.lead = COMMAND_INTERFACES.index(lead)
        """Row of the goals without which a servo is sent none."""
        self.members = tuple(members)  # Indices of its servos on the bus
        self.rows = [servo.row for servo in servos]
        self.ids = [servo.servo_id for servo in servos]
        self.cells = cells  # The items of each servo, in the order of the wire
        self._ticks = [[0] * len(items) for items in cells]
        self._again = [False] * len(servos)  # the goal changed in the cycle before
        self._served = [False] * len(servos)  # the servo could get a goal in the cycle before
        self._sent_at = [0] * len(servos)
        self._cycle = 0

    def packet(
        self, values: Sequence[Sequence[float]], included: Sequence[bool], ceiling: Sequence[float]
    ) -> bytes | None:
        """Return the packet with the goals that are due in a cycle; None: none is. As `build` in kernel.c.

        `values`: the goals of all joints, in the rows of COMMAND_INTERFACES; `included`, `ceiling`: of each
        servo of the bus.
        """
        self._cycle += 1
        cycle, lead, due = self._cycle, values[self.lead], bytearray()
        for number, (index, row) in enumerate(zip(self.members, self.rows, strict=True)):
            served = included[index] and not math.isnan(lead[row])
            ticks = [cell.tick(values[cell.interface][row], ceiling[index]) for cell in self.cells[number]]
            changed = ticks != self._ticks[number] or (served and not self._served[number])
            self._ticks[number], self._served[number] = ticks, served
            if served and (changed or self._again[number] or self._sent_at[number] <= cycle - REPEATED):
                self._sent_at[number] = cycle
                due += self._record(number)
            self._again[number] = changed
        return self._dialect.sync_write_records(self.layout.address, self.layout.length, due) if due else None

    def _record(self, number: int) -> bytes:
        record = bytearray(1 + self.layout.length)
        record[0] = self.ids[number]
        for cell, tick in zip(self.cells[number], self._ticks[number], strict=True):
            at, size = 1 + cell.place.offset, cell.place.size
            record[at : at + size] = (tick & ((1 << 8 * size) - 1)).to_bytes(size, "little")
        return bytes(record)


def _cells(
    servo: ServoPlan, mode: Mode, layout: GoalLayout, limits: Mapping[str, int], fraction: float
) -> list[GoalCell]:
    """Return the goals that stand in a block, in the order of the wire.

    `limits`: the servo's own, ticks, by what they limit; `fraction`: the part of an effort's or a PWM's limit
    that may be used.
    """
    plan = servo.mode_plan(mode)

    def signed(place: Field, scale: Scale | None, of: str) -> GoalCell:
        unit, most = _reach(scale, of, limits, fraction, servo.ratio if of == "speed" else 1.0)
        row = COMMAND_INTERFACES.index(LEADS.get(mode, "position"))
        return GoalCell(place, row, False, float(servo.direction), 0.0, unit, -most, most)

    found: list[GoalCell] = []
    if layout.position is not None:
        found.append(_position(layout.position, servo, plan))
        if layout.speed is not None:
            unit, most = _reach(plan.speed, "speed", limits, fraction, servo.ratio)
            found.append(GoalCell(layout.speed, _VELOCITY, True, 1.0, 0.0, unit, 1, max(most, 1)))
    elif layout.speed is not None:
        found.append(signed(layout.speed, plan.speed, "speed"))
    elif layout.pwm is not None:
        found.append(signed(layout.pwm, plan.pwm, "pwm"))
    elif layout.effort is not None and mode is Mode.EFFORT:
        found.append(signed(layout.effort, plan.effort, "effort"))
    elif layout.effort is not None:
        unit, most = _reach(plan.effort, "effort", limits, fraction)
        effort = COMMAND_INTERFACES.index("effort")
        # Torque Limit = 0 shows a shutdown
        least = int(servo.torque_limit is not None and layout.address == servo.torque_limit.address)
        most = max(least, most)
        found.append(GoalCell(layout.effort, effort, True, 1.0, 0.0, unit, least, most, most))
    return sorted(found, key=lambda cell: cell.place.offset)


def _position(place: Field, servo: ServoPlan, plan: ModePlan) -> GoalCell:
    """Counted from the servo's raw 0, to the nearest tick, inside the joint's limits."""
    return GoalCell(
        place,
        COMMAND_INTERFACES.index("position"),
        False,
        float(servo.direction),
        servo.reference * servo.ratio,
        servo.position_per_tick,
        plan.lower_tick,
        plan.upper_tick,
    )


def _reach(
    scale: Scale | None, of: str, limits: Mapping[str, int], fraction: float, ratio: float = 1.0
) -> tuple[float, int]:
    """Return unit, as the joint counts, and highest tick of a goal; 1 and 0 where a mode has no such goal."""
    if scale is None:
        return 1.0, 0
    used = 1.0 if of == "speed" else fraction
    return scale.per_tick * ratio, math.floor(min(scale.most, limits.get(of, scale.most)) * used)
