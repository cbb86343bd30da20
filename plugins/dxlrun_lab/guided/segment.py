"""Segments: tables of goals that an experiment has played, and what was recorded meanwhile."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, Self

import numpy as np
from numpy.typing import NDArray

from dxlrun.channels.cycle import Floats

Interface = Literal["position", "posvel", "velocity", "effort", "pwm"]
"""What a table commands; see sample_player."""


@dataclass(frozen=True, slots=True)
class Guard:
    """What ends a segment early, beside a joint that leaves its range; None: not checked."""

    temperature: float | None = 70.0
    """The highest, deg C. Dynamixels shut down at 70 to 80 deg C (e-Manual, Temperature Limit)."""
    effort: float | None = None
    """The highest measured one, Nm, A or the fraction of maximum."""
    age_s: float | None = 0.1
    """The greatest age of a joint's state."""


@dataclass(frozen=True, slots=True)
class Segment:
    """One table: goals of joints, one row each period, by time."""

    title: str
    """What it is for, as the progress shows it: `top speed, 20 deg up`."""
    period_s: float
    rows: Mapping[str, Floats]
    """By joint, each of shape (rows,): rad, rad/s, the joint's effort unit, or the fraction of full voltage.
    The joints of the experiment that are missing hold (position), or get 0."""
    interface: Interface = "position"
    speeds: Mapping[str, Floats] = field(default_factory=dict)
    """Of posvel: the speeds toward the positions, rad/s, shape (rows,); by joint, all that `rows` has."""
    begin: Mapping[str, float] = field(default_factory=dict)
    """Where joints are led slowly before, rad; those of a position table go to its first row anyway."""
    settle_s: float = 0.0
    """For which the last row is commanded still, and recorded."""
    loop_rate: float | None = None
    """Hz of the loop for this segment; None: the run's own."""
    guard: Guard = field(default_factory=Guard)

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


@dataclass(frozen=True, slots=True)
class Recorded:
    """What the log has of a segment: a row a cycle, from the one that took the goal to the one that ended it.

    `cycles` has the whole record of each cycle (see channels/cycle.py); the other columns are taken from
    it, for `joints`. Times of the run's clock in ns; the wake-up is when the cycle began.
    """

    joints: tuple[str, ...]
    """The columns of what has shape (cycles, joints)."""
    cycles: NDArray[np.void]
    columns: tuple[int, ...]
    """The place of each joint in the rows of `cycles`."""
    segment: Segment | None = None
    """What was played; None: a piece of another log."""
    outcome: str = "reached"
    """How its goal ended: `reached`, or why it is not whole: `aborted`, `cancelled`, `lost`."""
    text: str = ""
    """The sentence with which it ended early."""

    @classmethod
    def of(cls, cycles: NDArray[np.void], all_joints: Sequence[str], joints: Sequence[str]) -> Self:
        """Return cycles of any log, for some of its joints."""
        return cls(tuple(joints), cycles, tuple(all_joints.index(joint) for joint in joints))

    @property
    def whole(self) -> bool:
        """True when all of the segment was played."""
        return self.outcome == "reached"

    def __len__(self) -> int:
        return len(self.cycles)

    @property
    def time(self) -> Floats:
        """Wake-up of each cycle, s since the first one; shape (cycles,)."""
        since_ns = self.woken_ns - self.woken_ns[:1]
        return since_ns.astype(np.float64) * 1e-9

    @property
    def cycle(self) -> NDArray[np.int64]:
        """Number of each cycle; those of skipped periods are missing."""
        return self._scalar("cycle")

    @property
    def scheduled_ns(self) -> NDArray[np.int64]:
        """When each cycle was due."""
        return self._scalar("scheduled_ns")

    @property
    def woken_ns(self) -> NDArray[np.int64]:
        """When each cycle began."""
        return self._scalar("woken_ns")

    @property
    def read_ns(self) -> NDArray[np.int64]:
        """When the states were read; a state arrived `age_ns` before that, and is that of shortly before."""
        return self._scalar("read_ns")

    @property
    def written_ns(self) -> NDArray[np.int64]:
        """When the goals had been sent."""
        return self._scalar("written_ns")

    @property
    def goal(self) -> Floats:
        """What was sent to the servos in the segment's interface (of posvel the position), by the gate."""
        interface = self.segment.interface if self.segment is not None else "position"
        return self.goal_of("position" if interface == "posvel" else interface)

    def goal_of(self, quantity: Literal["position", "velocity", "effort", "pwm"]) -> Floats:
        """Return what was sent of one quantity, shape (cycles, joints); NaN where nothing was."""
        return self._rows(f"goal_{quantity}")

    @property
    def position(self) -> Floats:
        """rad, shape (cycles, joints); as all states the last that is known, where `valid` is False."""
        return self._rows("position")

    @property
    def velocity(self) -> Floats:
        """rad/s, as the servo reports it."""
        return self._rows("velocity")

    @property
    def effort(self) -> Floats:
        """Nm, A or the fraction of maximum, as the model measures it."""
        return self._rows("effort")

    @property
    def voltage(self) -> Floats:
        """V, read now and then; NaN until it was."""
        return self._rows("voltage")

    @property
    def temperature(self) -> Floats:
        """deg C, read now and then; NaN until it was."""
        return self._rows("temperature")

    @property
    def valid(self) -> NDArray[np.bool_]:
        """True where the cycle's reply arrived intact."""
        return self._rows("valid").astype(np.bool_)

    @property
    def age_ns(self) -> NDArray[np.int64]:
        """How long before `read_ns` the state arrived; -1: none ever did."""
        return self._rows("age_ns").astype(np.int64)

    def _scalar(self, name: str) -> NDArray[np.int64]:
        values: NDArray[np.int64] = self.cycles[name]
        return values

    def _rows(self, name: str) -> Floats:
        values: Floats = self.cycles[name][:, list(self.columns)]
        return values
