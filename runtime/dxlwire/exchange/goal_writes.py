"""Goals: converts goals in SI units to the sync writes of one bus, in the current mode of each servo."""

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
"""Goal that each mode follows if it is not the position. A servo for which this goal is NaN gets no goals."""

_VELOCITY = COMMAND_INTERFACES.index("velocity")


class GoalCell(msgspec.Struct, frozen=True):
    """One goal item of one servo, with the conversion of a goal in SI units to the integer in the packet.

    Signed: tick = (sign * goal + offset) / unit, rounded to the nearest and clamped to `low` and `high`.
    Magnitude: tick = |goal| / unit, clamped to `low` and `high`, and `free` where the goal is NaN. The
    magnitude of a speed is rounded down, because it is a limit."""

    place: Field  # Position of the item in the servo's block
    interface: int  # Row of the goals, an index into COMMAND_INTERFACES
    magnitude: bool
    sign: float
    offset: float
    unit: float
    low: int
    high: int
    free: int = 0


class GoalArrays:
    """Sync writes of one bus, one for all servos of one mode and layout; `build` in kernel.c fills them.

    A goal is sent when it changes, once more in the next cycle, and every 50 cycles. A constant goal
    therefore costs almost no time on the wire.

    Position: rounded to the nearest tick and clamped to the joint's limits, which lie within the servo's
    range; never wraps.

    Speed toward a position: magnitude, rounded down. 0 rad/s is 1 tick, because 0 ticks mean the maximum in
    joint mode and no limit in a profile. NaN is 0 ticks. A speed above the range is the highest tick.

    Velocity, effort and PWM as leading goals: rounded to the nearest tick with their sign, and clamped to the
    servo's own limit, because the servo refuses a goal beyond that limit. NaN: the servo gets no goal.

    Effort in addition to a position: the maximum effort; NaN means the servo's own limit.
    """

    def __init__(self, plan: BusPlan) -> None:
        self._plan = plan
        self._modes: list[Mode] = [servo.start_mode for servo in plan.servos]
        self.own_limits: list[Mapping[OwnLimit, int]] = [{} for _ in plan.servos]
        """Limits read from each servo, ticks, by servo index; a servo refuses a goal beyond them."""
        # True when limits have changed since the hardware passed them to the loop.
        self.limits_changed = False
        self.fraction = 1.0  # Fraction of a servo's effort or PWM limit that goals may use
        self.sync_writes: tuple[SyncWrite, ...] = ()
        """One sync write per mode and block of goals, in the order of sending; replaced when a mode or
        limit changes."""
        self.rebuild_writes()

    @property
    def modes(self) -> Sequence[Mode]:
        """Current mode of each servo; a servo in UNKNOWN gets no goals."""
        return self._modes

    def place_servos(self, plan: BusPlan) -> None:
        """Send goals from now on to servos that count from another zero; `plan` differs only in that."""
        self._plan = plan
        self.rebuild_writes()

    def set_mode(self, index: int, mode: Mode) -> None:
        """Send goals in another mode from now on to the servo at this index in the plan; UNKNOWN: no
        goals.

        Raises:
            LookupError: The servo does not have the mode.
        """
        if mode != self._modes[index]:
            if mode is not Mode.UNKNOWN:
                self._plan.servos[index].mode_plan(mode)
            self._modes[index] = mode
            self.rebuild_writes()

    def set_limits(self, index: int, limits: Mapping[OwnLimit, int]) -> None:
        """Clamp the goals of a servo to the limits that were read from its registers, ticks.

        A limit that is missing in `limits` keeps its value."""
        found = {**self.own_limits[index], **limits}
        if found != self.own_limits[index]:
            self.own_limits[index] = found
            self.limits_changed = True
            self.rebuild_writes()

    def _ticks_of_limits(self, index: int) -> Mapping[str, int]:
        return {limit.of: value for limit, value in self.own_limits[index].items()}

    def weaken(self, fraction: float) -> None:
        """Limit the effort and PWM goals of all servos to a fraction of each servo's limit.

        Args:
            fraction: 0 to 1.
        """
        self.fraction = fraction
        self.rebuild_writes()

    def rebuild_writes(self) -> None:
        """Rebuild the sync writes, after which every goal is sent again. Also used when a lost line is
        back."""
        # A sync write has one address and one length, so servos are grouped by their blocks of goals.
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
    """One block of goals that one packet writes to servos of one bus which are in the same mode."""

    layout: GoalLayout
    lead: int  # Row of the leading goal; a servo for which it is NaN gets no goals
    members: tuple[int, ...]  # Indices of the servos on the bus
    rows: tuple[int, ...]
    ids: tuple[int, ...]
    cells: tuple[list[GoalCell], ...]  # Goal items of each servo, in the order of the wire
    leads: int = 1  # Rows that are leading goals, from `lead` on
    always: bool = False  # Send every goal in every call, changed or not


def _cells(
    servo: ServoPlan, mode: Mode, layout: GoalLayout, limits: Mapping[str, int], fraction: float
) -> list[GoalCell]:
    """Return the conversions for the goals of one servo in a block, in the order of the wire.

    Args:
        limits: The servo's own limits, ticks, by limited quantity.
        fraction: Usable fraction of an effort or PWM limit.
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
        # A Torque Limit of 0 means a shutdown, so the goal must not reach 0.
        least = int(servo.torque_limit is not None and layout.address == servo.torque_limit.address)
        most = max(least, most)
        found.append(GoalCell(layout.effort, effort, True, 1.0, 0.0, unit, least, most, most))
    return sorted(found, key=lambda cell: cell.place.offset)


def _position(place: Field, servo: ServoPlan, plan: ModePlan) -> GoalCell:
    """Return the conversion of a position goal to ticks from the servo's raw 0."""
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
    """Return unit (in the joint's terms, per tick) and highest tick of a goal; 1 and 0 if the mode lacks
    the goal."""
    if scale is None:
        return 1.0, 0
    used = 1.0 if of == "speed" else fraction
    return scale.per_tick * ratio, math.floor(min(scale.most, limits.get(of, scale.most)) * used)
