"""Segments: tables of goals that an experiment sends to joints, and the recordings of the cycles."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from dxlrun import Floats

Interface = Literal["position", "posvel", "velocity", "effort", "pwm"]
"""Command interface of a segment's table: the quantity that a sample_player commands"""


class Guard(msgspec.Struct, frozen=True):
    """Limits that end a segment early, in addition to the ranges of joints; None disables a limit."""

    temperature: float | None = 70.0
    """Highest temperature, deg C. Dynamixels shut down at 70 to 80 deg C (e-Manual, Temperature Limit)."""
    effort: float | None = None
    """Highest measured effort, Nm, A or the fraction of maximum"""
    age_s: float | None = 0.1
    """Largest age of a joint's newest state, s: an older one means that its servo does not respond"""


class Segment(msgspec.Struct, frozen=True):
    """Table of goals of joints, one row per period, which a sample_player plays"""

    title: str
    """Description in the progress output, such as `top speed, 20 deg up`"""
    period_s: float
    """Time between two rows, s"""
    rows: Mapping[str, Floats]
    """Values by joint, shape (rows,): rad, rad/s, the joint's effort unit, or the fraction of full voltage.
    Joints of the experiment that are missing hold their position, or get 0."""
    interface: Interface = "position"
    speeds: Mapping[str, Floats] = msgspec.field(default_factory=dict)
    """With posvel: speeds by joint, rad/s, shape (rows,), for the same joints as in `rows`"""
    begin: Mapping[str, float] = msgspec.field(default_factory=dict)
    """Positions to which joints move slowly first, rad. With a table of positions it is the first row anyway.
    """
    settle_s: float = 0.0
    """Time for which the last row is still commanded and recorded, s"""
    loop_rate: float | None = None
    """Loop rate for this segment, Hz; None for that of the run"""
    guard: Guard = msgspec.field(default_factory=Guard)

    def __post_init__(self) -> None:
        """Raise ValueError if rows are missing, have different lengths, or are not finite."""
        lengths = {len(values) for values in (*self.rows.values(), *self.speeds.values())}
        if len(lengths) != 1 or 0 in lengths:
            raise ValueError(
                f"{self.title}: all joints need the same number of rows, 1 or more, not {lengths}"
            )
        if not all(np.isfinite(values).all() for values in (*self.rows.values(), *self.speeds.values())):
            raise ValueError(f"{self.title}: a number is not finite")
        if self.interface == "posvel" and set(self.speeds) != set(self.rows):
            raise ValueError(f"{self.title}: posvel needs a speed and a position for each joint")

    @property
    def count(self) -> int:
        """Number of rows of the table"""
        return len(next(iter(self.rows.values())))

    @property
    def duration_s(self) -> float:
        """Duration of the rows and of `settle_s`, s"""
        return self.count * self.period_s + self.settle_s


class SegmentRecording(msgspec.Struct, frozen=True):
    """Recording of a segment, one row per cycle from the acceptance to the end of its goal

    `cycles` has the complete record of each cycle (see channels/cycle.py), with times of the run's clock in
    ns.
    """

    joints: tuple[str, ...]
    """Joints of the columns of all arrays of shape (cycles, joints)"""
    cycles: NDArray[np.void]
    columns: tuple[int, ...]
    """Index of each joint in the fields of `cycles`"""
    segment: Segment
    outcome: str = "reached"
    """Outcome of the goal: `reached`, or for an incomplete segment `aborted`, `cancelled` or `lost`"""
    text: str = ""
    """Reason for an early end, one sentence"""

    @property
    def whole(self) -> bool:
        """True if the whole segment was played"""
        return self.outcome == "reached"

    def __len__(self) -> int:
        return len(self.cycles)

    def of_cycles(self, name: str) -> NDArray[np.int64]:
        """Return the field of the record with this name, one number per cycle, such as `woken_ns`."""
        values: NDArray[np.int64] = self.cycles[name]
        return values

    def of_joints(self, name: str) -> Floats:
        """Return the field with this name, such as `position`, for `joints`; shape (cycles, joints).

        Where `valid` is False, a state is the last known one.
        """
        values: Floats = self.cycles[name][:, list(self.columns)]
        return values

    @property
    def time(self) -> Floats:
        """Time of each cycle's wake-up since the first one, s; shape (cycles,)"""
        since_ns = self.of_cycles("woken_ns") - self.of_cycles("woken_ns")[:1]
        return since_ns.astype(np.float64) * 1e-9

    @property
    def goal(self) -> Floats:
        """Goals of the segment's interface (positions with posvel), shape (cycles, joints); NaN if none"""
        interface = self.segment.interface
        return self.of_joints(f"goal_{'position' if interface == 'posvel' else interface}")

    @property
    def position(self) -> Floats:
        """Measured positions, rad; shape (cycles, joints)"""
        return self.of_joints("position")

    @property
    def valid(self) -> NDArray[np.bool_]:
        """True where the cycle has an intact reply of the joint's servo; shape (cycles, joints)"""
        return self.of_joints("valid").astype(np.bool_)
