"""Segments: tables of goals that an experiment has played, and what was recorded meanwhile."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from dxlrun import Floats

Interface = Literal["position", "posvel", "velocity", "effort", "pwm"]
"""What a table commands; see sample_player."""


class Guard(msgspec.Struct, frozen=True):
    """What ends a segment early, beside a joint that leaves its range; None: not checked."""

    temperature: float | None = 70.0
    """The highest, deg C. Dynamixels shut down at 70 to 80 deg C (e-Manual, Temperature Limit)."""
    effort: float | None = None
    """The highest measured one, Nm, A or the fraction of maximum."""
    age_s: float | None = 0.1
    """The greatest age of a joint's state."""


class Segment(msgspec.Struct, frozen=True):
    """One table: goals of joints, one row each period, by time."""

    title: str
    """What it is for, as the progress shows it: `top speed, 20 deg up`."""
    period_s: float
    rows: Mapping[str, Floats]
    """By joint, each of shape (rows,): rad, rad/s, the joint's effort unit, or the fraction of full voltage.
    The joints of the experiment that are missing hold (position), or get 0."""
    interface: Interface = "position"
    speeds: Mapping[str, Floats] = msgspec.field(default_factory=dict)
    """Of posvel: the speeds toward the positions, rad/s, shape (rows,); by joint, all that `rows` has."""
    begin: Mapping[str, float] = msgspec.field(default_factory=dict)
    """Where joints are led slowly before, rad; those of a position table go to its first row anyway."""
    settle_s: float = 0.0
    """For which the last row is commanded still, and recorded."""
    loop_rate: float | None = None
    """Hz of the loop for this segment; None: the run's own."""
    guard: Guard = msgspec.field(default_factory=Guard)

    def __post_init__(self) -> None:
        """Raise ValueError for rows of different lengths, none, or such that are not finite."""
        lengths = {len(values) for values in (*self.rows.values(), *self.speeds.values())}
        if len(lengths) != 1 or 0 in lengths:
            raise ValueError(f"{self.title}: each joint needs as many rows, at least one, not {lengths}")
        if not all(np.isfinite(values).all() for values in (*self.rows.values(), *self.speeds.values())):
            raise ValueError(f"{self.title}: a row has a number that is not finite")
        if self.interface == "posvel" and set(self.speeds) != set(self.rows):
            raise ValueError(f"{self.title}: posvel needs speeds of the same joints as positions")

    @property
    def count(self) -> int:
        """How many rows it has."""
        return len(next(iter(self.rows.values())))

    @property
    def duration_s(self) -> float:
        """How long it takes."""
        return self.count * self.period_s + self.settle_s


class Recorded(msgspec.Struct, frozen=True):
    """What the log has of a segment: a row a cycle, from the one that took the goal to the one that ended it.

    `cycles` has the whole record of each cycle (see channels/cycle.py); times of the run's clock in ns.
    """

    joints: tuple[str, ...]
    """The columns of what has shape (cycles, joints)."""
    cycles: NDArray[np.void]
    columns: tuple[int, ...]
    """The place of each joint in the rows of `cycles`."""
    segment: Segment
    outcome: str = "reached"
    """How its goal ended: `reached`, or why it is not whole: `aborted`, `cancelled`, `lost`."""
    text: str = ""
    """The sentence with which it ended early."""

    @property
    def whole(self) -> bool:
        """True when all of the segment was played."""
        return self.outcome == "reached"

    def __len__(self) -> int:
        return len(self.cycles)

    def of_cycles(self, name: str) -> NDArray[np.int64]:
        """Return a column of the record with one number a cycle, such as `woken_ns`; shape (cycles,)."""
        values: NDArray[np.int64] = self.cycles[name]
        return values

    def of_joints(self, name: str) -> Floats:
        """Return a column with one number a joint, such as `position`, in the record's unit; shape (cycles,
        joints). A state is the last that is known, where `valid` is False."""
        values: Floats = self.cycles[name][:, list(self.columns)]
        return values

    @property
    def time(self) -> Floats:
        """Wake-up of each cycle, s since the first one; shape (cycles,)."""
        since_ns = self.of_cycles("woken_ns") - self.of_cycles("woken_ns")[:1]
        return since_ns.astype(np.float64) * 1e-9

    @property
    def goal(self) -> Floats:
        """What was sent in the segment's interface (of posvel the position); NaN: nothing."""
        interface = self.segment.interface
        return self.of_joints(f"goal_{'position' if interface == 'posvel' else interface}")

    @property
    def position(self) -> Floats:
        """rad"""
        return self.of_joints("position")

    @property
    def valid(self) -> NDArray[np.bool_]:
        """True where the cycle's reply arrived intact; shape (cycles, joints)."""
        return self.of_joints("valid").astype(np.bool_)
