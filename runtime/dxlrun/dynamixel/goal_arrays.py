"""Goals -> the sync writes of one bus, in whatever mode each servo is; prepared once a change of modes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from dxlrun.dynamixel.bus_plan import BusPlan, Field, GoalLayout, ModePlan, OwnLimit, ServoPlan
from dxlrun.dynamixel.dialect import dialect_of
from dxlrun.dynamixel.state_arrays import rows_of
from dxlrun.interfaces import Commands, Floats
from dxlrun.mode import Mode

_CLOCKWISE = 0x400
"""Direction bit of sign-magnitude goals: bit 10 (e-Manual AX-12A, Moving Speed (32))."""
REPEATED = 50
"""Cycles after which a goal that stays is sent again: nobody acknowledges a sync write."""
_OFTEN = 2
"""So many times a goal that changed is sent: in this cycle and in the next."""

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

    __slots__ = ("_blocks", "_cycle", "_fraction", "_limits", "_modes", "_next", "_plan", "_seen", "_still")

    def __init__(self, plan: BusPlan) -> None:
        self._plan = plan
        self._modes: list[Mode] = [servo.start_mode for servo in plan.servos]
        self._limits: list[dict[str, int]] = [{} for _ in plan.servos]
        self._fraction = 1.0
        self._blocks: tuple[_Block, ...] = ()
        self._cycle = 0
        self._next = 0  # cycle in which a goal that stays is due again
        self._still = 0  # cycles since anything was another than before
        self._seen: tuple[bytes, ...] = ()
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
        self._cycle += 1
        seen = (
            goals.position.tobytes(),
            goals.velocity.tobytes(),
            goals.effort.tobytes(),
            goals.pwm.tobytes(),
            included.tobytes(),
            b"" if ceiling is None else ceiling.tobytes(),
        )
        self._still = self._still + 1 if seen == self._seen else 0
        if self._still >= _OFTEN and self._cycle < self._next:
            return []
        self._seen = seen
        found: list[bytes] = []
        for block in self._blocks:
            block.packets(self._cycle, goals, included, ceiling, found)
        self._next = min((block.next for block in self._blocks), default=self._cycle) + REPEATED
        return found

    def _rebuild(self) -> None:
        groups: dict[tuple[Mode, tuple[GoalLayout, ...]], list[int]] = {}
        for index, (servo, mode) in enumerate(zip(self._plan.servos, self._modes, strict=True)):
            if mode is not Mode.UNKNOWN:
                groups.setdefault((mode, servo.mode_plan(mode).goals), []).append(index)
        self._blocks = tuple(
            _Block(self._plan, mode, members, self._limits, self._fraction)
            for (mode, _), members in groups.items()
        )
        self._still, self._seen = 0, ()


class _Block:
    """The servos of one bus that are in one mode and have one layout of its goals."""

    __slots__ = (
        "_all",
        "_chosen",
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
        "_velocity",
        "_work",
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
        self._members = rows_of(members)
        self._rows = rows_of([servo.row for servo in mine])
        self._direction = np.array([float(servo.direction) for servo in mine])
        self._reference = np.array([servo.reference for servo in mine])
        self._position = np.array([servo.rad_per_tick for servo in mine])
        self._lowest = np.array([plan.lower_tick for plan in modes], dtype=np.float64)
        self._highest = np.array([plan.upper_tick for plan in modes], dtype=np.float64)
        self._speed, self._most_speed = _scale("speed", modes, own)
        self._effort, self._most_effort = _scale("effort", modes, own, fraction)
        self._pwm, self._most_pwm = _scale("pwm", modes, own, fraction)
        self._work = np.zeros(len(mine))
        self._chosen = np.zeros(len(mine), dtype=np.bool_)
        self._all = b"\1" * len(mine)
        self._velocity: tuple[bytes, bytes] | None = None

    @property
    def next(self) -> int:
        """The cycle in which the oldest goal was sent."""
        return min(records.oldest for records in self._records)

    def packets(
        self, cycle: int, goals: Commands, included: Bools, ceiling: Floats | None, found: list[bytes]
    ) -> None:
        """Add the packets, in the order of the mode's blocks of goals."""
        goal, chosen = self._goal(goals), self._chosen
        np.isnan(goal, chosen)
        np.greater(included[self._members], chosen, chosen)  # included and not NaN
        who = chosen.tobytes()
        if 1 not in who:
            for records in self._records:
                records.nobody()
            return
        some = None if who == self._all else chosen
        for records in self._records:
            fields = records.fields
            if "position" in fields:
                records.put("position", self._ticks(goal), some)
                if "speed" in fields and self._other_speeds(goals, ceiling, who):
                    records.put("speed", self._speeds(goals, ceiling), some)
            elif "speed" in fields:
                records.put("speed", self._signed(goal, self._speed, self._most_speed), some)
            elif "pwm" in fields:
                records.put("pwm", self._signed(goal, self._pwm, self._most_pwm), some)
            elif self._mode is Mode.EFFORT:
                records.put("effort", self._signed(goal, self._effort, self._most_effort), some)
            else:
                records.put("effort", self._efforts(goals), some)
            packet = records.packet(cycle, who, some)
            if packet is not None:
                found.append(packet)

    def _goal(self, goals: Commands) -> Floats:
        """Return the goals by which the mode goes."""
        if self._mode is Mode.VELOCITY:
            return goals.velocity[self._rows]
        if self._mode is Mode.EFFORT:
            return goals.effort[self._rows]
        if self._mode is Mode.PWM:
            return goals.pwm[self._rows]
        return goals.position[self._rows]

    def _ticks(self, goal: Floats) -> Floats:
        work = self._work
        np.multiply(self._direction, goal, work)
        np.add(work, self._reference, work)
        np.divide(work, self._position, work)
        np.rint(work, work)
        np.maximum(work, self._lowest, out=work)
        return np.minimum(work, self._highest, out=work)

    def _signed(self, goal: Floats, unit: Floats, most: Floats) -> Floats:
        work = self._work
        np.multiply(self._direction, goal, work)
        np.divide(work, unit, work)
        np.rint(work, work)
        np.maximum(work, -most, out=work)
        return np.minimum(work, most, out=work)

    def _other_speeds(self, goals: Commands, ceiling: Floats | None, who: bytes) -> bool:
        """Say whether the speeds toward positions are other ones than before: mostly they are not."""
        if ceiling is not None:
            self._velocity = None
            return True
        now = goals.velocity.tobytes(), who
        if now == self._velocity:
            return False
        self._velocity = now
        return True

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
        "_changed",
        "_chosen",
        "_layout",
        "_magnitude",
        "_records",
        "_rows",
        "_sent",
        "_sent_at",
        "_sync_write",
        "_views",
        "fields",
        "oldest",
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
        self.oldest = 0
        """The cycle in which that goal was sent whose sending is longest ago."""
        self._magnitude = {name for name, place in places.items() if place.encoding == "sign_magnitude"}
        self._layout = layout
        self._sync_write = dialect_of(plan.protocol).sync_write_records
        self._records = np.zeros(len(servos), dtype=record)
        self._records["id"] = [servo.servo_id for servo in servos]
        self._views = {name: self._records[name] for name in places}
        self._rows = self._records.view(np.dtype((np.void, record.itemsize)))
        self._sent = self._rows.copy()
        self._changed = np.zeros(len(servos), dtype=np.bool_)
        self._chosen = b""
        self._sent_at = np.zeros(len(servos), dtype=np.int64)

    def put(self, name: str, ticks: Floats, some: Bools | None) -> None:
        """Fill in one goal of everybody, or of some; the others have 0."""
        if some is not None:
            ticks = np.where(some, ticks, 0)
        if name in self._magnitude:
            ticks = np.where(ticks < 0, _CLOCKWISE - ticks, ticks)
        np.copyto(self._views[name], ticks, casting="unsafe")

    def packet(self, cycle: int, who: bytes, some: Bools | None) -> bytes | None:
        """Return the packet with the goals that are due; None: none is."""
        changed = self._rows != self._sent
        if who != self._chosen:
            now, before = (
                np.frombuffer(who, np.bool_),
                np.frombuffer(self._chosen or bytes(len(who)), np.bool_),
            )
            changed |= now & ~before
            self._chosen = who
        self._sent[:] = self._rows
        due = changed | self._changed
        due |= self._sent_at <= cycle - REPEATED
        self._changed = changed
        if some is not None:
            due &= some
        flags = due.tobytes()
        if 1 not in flags:
            return None
        every = 0 not in flags
        sent = self._records if every else self._records[due]
        self._sent_at[due] = cycle
        self.oldest = (
            cycle if every else int(self._sent_at.min() if some is None else self._sent_at[some].min())
        )
        return self._sync_write(self._layout.address, self._layout.length, sent.tobytes())

    def nobody(self) -> None:
        """Take note that nobody is chosen: whoever is next gets its goal at once."""
        self._chosen = b""


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
