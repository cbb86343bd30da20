"""Goals: arrays in SI units -> the sync writes of one bus, in whatever mode each servo is."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import msgspec

from dxlwire.bus_plan import (
    BusPlan,
    Field,
    GoalLayout,
    ModePlan,
    OwnLimit,
    Scale,
    ServoPlan,
)
from dxlwire.modes import COMMAND_INTERFACES, CommandName, Mode
from dxlwire.plan.planning import goal_parts
from dxlwire.wire.dialect import dialect_of

LEADS: Mapping[Mode, CommandName] = {Mode.VELOCITY: "velocity", Mode.EFFORT: "effort", Mode.PWM: "pwm"}
"""The goal that a mode follows, where it is not the position; without it a servo is sent none."""

_VELOCITY = COMMAND_INTERFACES.index("velocity")


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


class GoalArrays:
    """The sync writes of one bus, one for all servos of one mode and layout; `build` in kernel.c fills them.

    A goal is sent when it changed, once more in the next cycle, and every 50 cycles; so what stays costs no
    time on the wire. Position: to the nearest tick, inside the joint's limits and so inside the
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
        self.own_limits: list[Mapping[OwnLimit, int]] = [{} for _ in plan.servos]
        """Limits that were read of each servo, ticks; a servo refuses a goal beyond them."""
        self.limits_changed = False  # Since the hardware handed them to the loop
        self.fraction = 1.0  # The part of a servo's limit of effort or PWM that goals may ask for
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
        """Keep the goals of a servo within the limits that were read of it, ticks.

        A limit that was not read keeps its value.
        """
        found = {**self.own_limits[index], **limits}
        if found != self.own_limits[index]:
            self.own_limits[index] = found
            self.limits_changed = True
            self.renew()

    def _ticks_of_limits(self, index: int) -> Mapping[str, int]:
        return {limit.of: value for limit, value in self.own_limits[index].items()}

    def weaken(self, fraction: float) -> None:
        """Let no goal ask for more effort or PWM than a fraction of the servo's limit."""
        self.fraction = fraction
        self.renew()

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
                layout,
                COMMAND_INTERFACES.index(LEADS.get(mode, "position")),
                tuple(part),
                tuple(servos[index].row for index in part),
                tuple(servos[index].servo_id for index in part),
                tuple(
                    _cells(servos[index], mode, layout, self._ticks_of_limits(index), self.fraction)
                    for index in part
                ),
            )
            for (mode, layouts), members in groups.items()
            for layout in layouts
            for part in goal_parts(dialect, layout, members)
        )


class SyncWrite(msgspec.Struct, frozen=True):
    """One block of goals of the servos of one bus in one mode."""

    layout: GoalLayout
    lead: int  # Row of the goals without which a servo is sent none
    members: tuple[int, ...]  # Indices of its servos on the bus
    rows: tuple[int, ...]
    ids: tuple[int, ...]
    cells: tuple[list[GoalCell], ...]  # The items of each servo, in the order of the wire


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
