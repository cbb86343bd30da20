"""Goals -> the sync writes of one bus, in whatever mode each servo is; prepared once a change of modes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from dxlrun.dynamixel.bus_plan import BusPlan, Field, GoalLayout, ModePlan, OwnLimit, ServoPlan
from dxlrun.dynamixel.dialect import dialect_of
from dxlrun.interfaces import Commands, Floats
from dxlrun.mode import Mode

_CLOCKWISE = 0x400
"""Direction bit of sign-magnitude goals: bit 10 (e-Manual AX-12A, Moving Speed (32))."""
REPEATED = 50
"""Cycles after which a goal that stays is sent again: nobody acknowledges a sync write."""
_OFTEN = 2
"""A goal that changed is sent so many times: in this cycle and in the next."""

Bools = NDArray[np.bool_]


class GoalArrays:
    """Builds the goal packets of one bus: one sync write for all servos of one mode and layout.

    A goal is sent when it changed, once more in the next cycle, and every `REPEATED` cycles; so what stays
    costs no time on the wire. Position: to the nearest tick, inside the joint's limits and so inside the
    servo's range, never wraps. Speed toward a position: magnitude; 0 rad/s is 1 tick, because 0 ticks mean
    the maximum in joint mode and no limit in a profile; NaN is 0 ticks; too fast is the highest tick.
    Velocity, effort and PWM as goals of their own: to the nearest tick with their sign, no more than the
    servo's own limit, beyond which it would refuse the goal as a whole; NaN: the servo gets none. Effort
    beside a position: the most that it may take, NaN = all that the servo's own limit lets it.
    """

    __slots__ = ("_blocks", "_fraction", "_limits", "_modes", "_plan")

    def __init__(self, plan: BusPlan) -> None:
        self._plan = plan
        self._modes: list[Mode] = [servo.start_mode for servo in plan.servos]
        self._limits: list[dict[str, int]] = [{} for _ in plan.servos]
        self._fraction = 1.0
        self._blocks: tuple[_Block, ...] = ()
        self._rebuild()

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
            self._rebuild()

    def set_limits(self, index: int, limits: Mapping[OwnLimit, int]) -> None:
        """Keep the goals of a servo within the limits that were read of it, ticks."""
        self._limits[index] = {limit.of: value for limit, value in limits.items()}
        self._rebuild()

    def weaken(self, fraction: float) -> None:
        """Let no goal ask for more effort or PWM than a fraction of the servo's limit."""
        self._fraction = fraction
        self._rebuild()

    def packets(self, goals: Commands, included: Bools, ceiling: Floats | None = None) -> list[bytes]:
        """Return the packets for the servos that are `included`, shape (servos,), and whose goal is due.

        `ceiling`, shape (servos,): the highest speed toward a position, rad/s; NaN: no other than the goal's.
        """
        return [packet for block in self._blocks for packet in block.packets(goals, included, ceiling)]

    def _rebuild(self) -> None:
        groups: dict[tuple[Mode, tuple[GoalLayout, ...]], list[int]] = {}
        for index, (servo, mode) in enumerate(zip(self._plan.servos, self._modes, strict=True)):
            if mode is not Mode.UNKNOWN:
                groups.setdefault((mode, servo.mode_plan(mode).goals), []).append(index)
        self._blocks = tuple(
            _Block(self._plan, mode, members, self._limits, self._fraction)
            for (mode, _), members in groups.items()
        )


class _Block:
    """The servos of one bus that are in one mode and have one layout of its goals."""

    __slots__ = (
        "_direction",
        "_effort",
        "_highest",
        "_lowest",
        "_members",
        "_mode",
        "_most_effort",
        "_most_pwm",
        "_most_speed",
        "_position",
        "_pwm",
        "_records",
        "_reference",
        "_rows",
        "_speed",
    )

    def __init__(
        self,
        plan: BusPlan,
        mode: Mode,
        members: Sequence[int],
        limits: Sequence[Mapping[str, int]],
        fraction: float,
    ) -> None:
        mine = [plan.servos[index] for index in members]
        modes = [servo.mode_plan(mode) for servo in mine]
        own = [limits[index] for index in members]
        self._mode = mode
        self._records = tuple(_Records(plan, layout, mine) for layout in modes[0].goals)
        self._members = np.array(members, dtype=np.intp)
        self._rows = np.array([servo.row for servo in mine], dtype=np.intp)
        self._direction = np.array([float(servo.direction) for servo in mine])
        self._reference = np.array([servo.reference for servo in mine])
        self._position = np.array([servo.rad_per_tick for servo in mine])
        self._lowest = np.array([plan.lower_tick for plan in modes], dtype=np.float64)
        self._highest = np.array([plan.upper_tick for plan in modes], dtype=np.float64)
        self._speed, self._most_speed = _scale("speed", modes, own)
        self._effort, self._most_effort = _scale("effort", modes, own, fraction)
        self._pwm, self._most_pwm = _scale("pwm", modes, own, fraction)

    def packets(self, goals: Commands, included: Bools, ceiling: Floats | None) -> Iterator[bytes]:
        """Return the packets, in the order of the mode's blocks of goals."""
        goal = self._goal(goals)
        chosen = included[self._members] & ~np.isnan(goal)
        if not chosen.any():
            for records in self._records:
                records.nobody()
            return
        for records in self._records:
            fields = records.fields
            if "position" in fields:
                ticks = np.rint((self._direction * goal + self._reference) / self._position)
                records.put("position", np.clip(ticks, self._lowest, self._highest), chosen)
                if "speed" in fields:
                    records.put("speed", self._speeds(goals, ceiling), chosen)
            elif "speed" in fields:
                records.put("speed", self._signed(goal, self._speed, self._most_speed), chosen)
            elif "pwm" in fields:
                records.put("pwm", self._signed(goal, self._pwm, self._most_pwm), chosen)
            elif self._mode is Mode.EFFORT:
                records.put("effort", self._signed(goal, self._effort, self._most_effort), chosen)
            else:
                records.put("effort", self._efforts(goals), chosen)
            packet = records.packet(chosen)
            if packet is not None:
                yield packet

    def _goal(self, goals: Commands) -> Floats:
        """Return the goals by which the mode goes."""
        if self._mode is Mode.VELOCITY:
            return goals.velocity[self._rows]
        if self._mode is Mode.EFFORT:
            return goals.effort[self._rows]
        if self._mode is Mode.PWM:
            return goals.pwm[self._rows]
        return goals.position[self._rows]

    def _signed(self, goal: Floats, unit: Floats, most: Floats) -> Floats:
        return np.clip(np.rint(self._direction * goal / unit), -most, most)

    def _speeds(self, goals: Commands, ceiling: Floats | None) -> Floats:
        """Return the speeds toward a position: 0 rad/s is 1 tick, NaN is 0."""
        velocity = np.abs(goals.velocity[self._rows])
        if ceiling is not None:
            velocity = np.fmin(velocity, ceiling[self._members])
        speed = np.rint(velocity / self._speed)
        return np.where(np.isnan(speed), 0, np.clip(speed, 1, np.maximum(self._most_speed, 1)))

    def _efforts(self, goals: Commands) -> Floats:
        """Return the most effort on the way to a position."""
        effort = np.rint(np.abs(goals.effort[self._rows]) / self._effort)
        return np.fmin(effort, self._most_effort)


class _Records:
    """One block of goals of several servos as it is sent, and what of it was sent before."""

    __slots__ = (
        "_age",
        "_bytes",
        "_chosen",
        "_layout",
        "_magnitude",
        "_records",
        "_sent",
        "_sync_write",
        "fields",
    )

    def __init__(self, plan: BusPlan, layout: GoalLayout, servos: Sequence[ServoPlan]) -> None:
        places = {
            name: place
            for name, place in (
                ("position", layout.position),
                ("speed", layout.speed),
                ("effort", layout.effort),
                ("pwm", layout.pwm),
            )
            if place is not None
        }
        record = np.dtype(
            {
                "names": ["id", *places],
                "formats": ["u1", *map(_format, places.values())],
                "offsets": [0, *(1 + place.offset for place in places.values())],
                "itemsize": 1 + layout.length,
            }
        )
        self.fields = frozenset(places)
        self._magnitude = {name for name, place in places.items() if place.encoding == "sign_magnitude"}
        self._layout = layout
        self._sync_write = dialect_of(plan.protocol).sync_write_records
        self._records = np.zeros(len(servos), dtype=record)
        self._records["id"] = [servo.servo_id for servo in servos]
        self._bytes = self._records.view(np.uint8).reshape(len(servos), -1)
        self._sent = self._bytes.copy()
        self._chosen = np.zeros(len(servos), dtype=np.bool_)
        self._age = np.zeros(len(servos), dtype=np.int64)

    def put(self, name: str, ticks: Floats, chosen: Bools) -> None:
        """Fill in one goal of everybody who is chosen."""
        ticks = np.where(chosen, ticks, 0)
        if name in self._magnitude:
            ticks = np.where(ticks < 0, _CLOCKWISE - ticks, ticks)
        self._records[name] = ticks

    def packet(self, chosen: Bools) -> bytes | None:
        """Return the packet with the goals that are due; None: none is."""
        changed = (self._bytes != self._sent).any(axis=1)
        changed |= chosen & ~self._chosen
        self._sent[:] = self._bytes
        self._chosen = chosen
        age = self._age
        age += 1
        age[changed] = 0
        due = chosen & ((age < _OFTEN) | (age % REPEATED == 0))
        if not due.any():
            return None
        sent = self._records if due.all() else self._records[due]
        return self._sync_write(self._layout.address, self._layout.length, sent.tobytes())

    def nobody(self) -> None:
        """Take note that nobody is chosen: whoever is next gets its goal at once."""
        self._chosen[:] = False


def _scale(
    of: str, modes: Sequence[ModePlan], own: Sequence[Mapping[str, int]], fraction: float = 1.0
) -> tuple[Floats, Floats]:
    """Return units and highest ticks of one kind of goal; 1 and 0 where a mode has none."""
    units, most = np.ones(len(modes)), np.zeros(len(modes))
    for index, (mode, limits) in enumerate(zip(modes, own, strict=True)):
        scale = mode.speed if of == "speed" else mode.effort if of == "effort" else mode.pwm
        if scale is not None:
            units[index] = scale.per_tick
            most[index] = np.floor(min(scale.most, limits.get(of, scale.most)) * fraction)
    return units, most


def _format(field: Field) -> str:
    return f"<{'i' if field.encoding == 'twos_complement' else 'u'}{field.size}"
