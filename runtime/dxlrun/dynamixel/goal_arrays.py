"""Goals -> the sync writes of one bus, in whatever mode each servo is; prepared once a change of modes."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from itertools import compress
from math import isnan
from operator import ne, or_

import numpy as np
from numpy.typing import NDArray

from dxlrun.dynamixel.bus_plan import BusPlan, Field, GoalLayout, OwnLimit
from dxlrun.dynamixel.dialect import Dialect, dialect_of
from dxlrun.dynamixel.goal_ticks import Ceiling, Group
from dxlrun.dynamixel.state_arrays import rows_of
from dxlrun.interfaces import Commands, Floats
from dxlrun.mode import Mode

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

    __slots__ = (
        "_blocks",
        "_cycle",
        "_fraction",
        "_goals",
        "_limits",
        "_modes",
        "_next",
        "_own",
        "_plan",
        "_rows",
        "_seen",
        "_still",
    )

    def __init__(self, plan: BusPlan) -> None:
        self._plan = plan
        self._modes: list[Mode] = [servo.start_mode for servo in plan.servos]
        self._limits: list[dict[str, int]] = [{} for _ in plan.servos]
        self._fraction = 1.0
        self._blocks: tuple[_Block, ...] = ()
        self._cycle = 0
        self._next = 0  # cycle in which a goal that stays is due again
        self._still = 0  # cycles since anything was another than before
        self._seen: tuple[bytes, bytes, bytes] | None = None
        self._rows = rows_of([servo.row for servo in plan.servos])
        self._goals: Commands | None = None
        self._own: Floats | None = None  # the rows of this bus among these goals, where they can be shown
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

    def packets(self, goals: Commands, included: Bools, ceiling: Floats | None = None) -> Sequence[bytes]:
        """Return the packets for the servos that are `included`, shape (servos,), and whose goal is due.

        `ceiling`, shape (servos,): the highest speed toward a position, rad/s; NaN: no other than the goal's.
        """
        self._cycle = cycle = self._cycle + 1
        if goals is not self._goals:
            self._goals = goals
            self._own = goals.values[:, self._rows] if isinstance(self._rows, slice) else None
        now = (goals.values[:, self._rows] if self._own is None else self._own).tobytes()
        who = included.tobytes()
        seen = now, who, b"" if ceiling is None else ceiling.tobytes()
        if seen != self._seen:
            self._seen, self._still = seen, 0
        else:
            self._still += 1
            if self._still >= _OFTEN and cycle < self._next:
                return ()
        slowed = None if ceiling is None else ceiling.tolist()
        found: list[bytes] = []
        for block in self._blocks:
            block.packets(cycle, now, who, slowed, found)
        if self._still:  # else nobody asks for it
            self._next = min([block.next for block in self._blocks], default=cycle) + REPEATED
        return found

    def _rebuild(self) -> None:
        groups: dict[tuple[Mode, tuple[GoalLayout, ...]], list[int]] = {}
        servos = self._plan.servos
        for index, (servo, mode) in enumerate(zip(servos, self._modes, strict=True)):
            if mode is not Mode.UNKNOWN:
                groups.setdefault((mode, servo.mode_plan(mode).goals), []).append(index)
        self._blocks = tuple(
            _Block(
                dialect_of(self._plan.protocol),
                Group(
                    mode=mode,
                    servos=[servos[index] for index in members],
                    members=members,
                    count=len(servos),
                    limits=[self._limits[index] for index in members],
                    fraction=self._fraction,
                ),
            )
            for (mode, _), members in groups.items()
        )
        self._still, self._seen = 0, None


class _Block:
    """The servos of one bus that are in one mode and have one layout of its goals."""

    __slots__ = ("_everybody", "_lead", "_members", "_records")

    def __init__(self, dialect: Dialect, group: Group) -> None:
        self._lead = group.unpack(group.lead)
        self._members = None if len(group.members) == group.count else group.members
        self._everybody = b"\1" * len(group.members)
        self._records = tuple(_Records(dialect, layout, group) for layout in group.layouts)

    @property
    def next(self) -> int:
        """The cycle in which the oldest goal was sent."""
        return min([records.oldest for records in self._records])

    def packets(self, cycle: int, goals: bytes, who: bytes, ceiling: Ceiling, found: list[bytes]) -> None:
        """Add the packets, in the order of the mode's blocks of goals.

        `goals`: those of the bus, row by row; `who`: 1 for each servo of the bus that may get one.
        """
        if self._members is not None:
            who = bytes([who[member] for member in self._members])
            ceiling = None if ceiling is None else [ceiling[member] for member in self._members]
        lead = self._lead(goals)
        if isnan(sum(lead)):  # nearly never; who is it?
            who = bytes([one and not isnan(goal) for one, goal in zip(who, lead, strict=True)])
        for records in self._records:
            packet = records.packet(cycle, goals, who, who == self._everybody, ceiling)
            if packet is not None:
                found.append(packet)


class _Records:
    """One block of goals of several servos as it is sent, and what of it was sent before."""

    __slots__ = (
        "_before",
        "_dialect",
        "_head",
        "_items",
        "_layout",
        "_nobody",
        "_pack",
        "_places",
        "_seen",
        "_sent_at",
        "_values",
        "_who",
        "oldest",
    )

    def __init__(self, dialect: Dialect, layout: GoalLayout, group: Group) -> None:
        items, count, size = group.items(layout), len(group.servos), 1 + layout.length
        self._dialect, self._layout = dialect, layout
        stride = 1 + len(items)
        self._items = tuple(
            (number, slice(1 + number, None, stride), item.span, item.slowed, item.ticks)
            for number, item in enumerate(items)
        )
        self._seen = [b"" for _ in items]  # of what the ticks were made
        self._values = [0] * (stride * count)
        """ID and ticks of each servo, in the order of the wire."""
        self._values[::stride] = [servo.servo_id for servo in group.servos]
        packet = dialect.sync_write_records(layout.address, layout.length, bytes(size * count))
        self._head = packet[: -dialect.CHECKSUM - size * count]
        form = "<" + f"{len(self._head)}s" + _form([item.place for item in items], layout.length) * count
        self._pack = struct.Struct(form).pack
        first = len(self._head)
        self._places = [slice(first + size * number, first + size * (number + 1)) for number in range(count)]
        self._nobody = [False] * count
        self._before = self._nobody  # whose goal changed in the cycle before
        self._who = bytes(count)
        self._sent_at = [0] * count
        self.oldest = 0
        """The cycle in which that goal was sent whose sending is longest ago."""

    def packet(self, cycle: int, goals: bytes, who: bytes, everybody: bool, ceiling: Ceiling) -> bytes | None:
        """Return the packet with the goals that are due; None: none is."""
        changed = self._changed(goals, ceiling)
        if who != self._who:
            changed = [one or new > old for one, new, old in zip(changed, who, self._who, strict=True)]
            self._who = who
        before, self._before = self._before, changed
        if not everybody or False in changed:
            latest = cycle - REPEATED
            due = [
                one == 1 and (now or then or at <= latest)
                for one, now, then, at in zip(who, changed, before, self._sent_at, strict=True)
            ]
            if False in due:
                return self._some(cycle, due)
        self._sent_at = [cycle] * len(who)
        self.oldest = cycle
        return self._dialect.sealed(self._pack(self._head, *self._values))

    def _changed(self, goals: bytes, ceiling: Ceiling) -> list[bool]:
        """Take over the goals; return whose ticks are other ones than before."""
        changed, values = self._nobody, self._values
        for number, here, span, slowed, ticks in self._items:
            seen = b"" if slowed and ceiling is not None else goals[span]
            if not seen or seen != self._seen[number]:
                self._seen[number] = seen
                now = ticks(goals, ceiling)
                other = list(map(ne, now, values[here]))
                if True in other:
                    values[here] = now
                    changed = other if changed is self._nobody else list(map(or_, changed, other))
        return changed

    def _some(self, cycle: int, due: Sequence[bool]) -> bytes | None:
        """Return the packet with the goals of some servos, None for nobody."""
        if True in due:
            self._sent_at = [cycle if one else at for one, at in zip(due, self._sent_at, strict=True)]
        self.oldest = min(compress(self._sent_at, self._who), default=cycle)  # nobody to send to: no hurry
        if True not in due:
            return None
        packet = self._pack(self._head, *self._values)
        records = b"".join([packet[place] for place in compress(self._places, due)])
        return self._dialect.sync_write_records(self._layout.address, self._layout.length, records)


def _form(places: Sequence[Field], length: int) -> str:
    """Return how the record of one servo looks, for `struct`: its ID, and the items of a block."""
    form, end = "B", 0
    for place in places:
        letter = {1: "b", 2: "h", 4: "i"}[place.size]
        form += f"{place.offset - end}x" + (letter if place.encoding == "twos_complement" else letter.upper())
        end = place.offset + place.size
    return form + f"{length - end}x"
