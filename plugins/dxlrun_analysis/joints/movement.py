"""Movement of the joints over a run, and findings about joints that failed to follow their commands.

The rules are in failing.py and following.py, with one exception: two positions within half a second, with
torque throughout, are a *jump* if they are 9 deg and a quarter further apart than the model can turn in that
time.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dxlrun import Floats
from dxlrun.tooling.compiled_code import load_compiled, parse_structs
from dxlrun.tooling.records import Torque
from dxlrun_analysis.finding import Finding, Rank
from dxlrun_analysis.joints.bins import BINS, Bins
from dxlrun_analysis.joints.failing import (
    AWAY,
    AWAY_RAD,
    GOALS,
    MOVED_RAD,
    WORSE,
    Windows,
    distance,
    failure_of,
    joint_finding,
)
from dxlrun_analysis.joints.following import changed, followed
from dxlrun_analysis.joints.joint_columns import JointColumns
from dxlrun_analysis.joints.planned import PlannedJoint
from dxlrun_analysis.joints.trail import Trail

_NONE: Mapping[str, float] = {}
_FIELDS = (
    *("age_ns", "torque", "valid", "position", "velocity", "effort"),
    *("goal_position", "goal_effort", "reference"),
)
"""Fields of the cycles that `movement.c` uses, of each joint."""
_WINDOW_S = 0.5  # Length of the long windows
_QUANTITIES = GOALS + 1  # Rows of `Windows` and `Bins`
SOURCE = Path(__file__).with_name("movement.c")
_STRUCTS = parse_structs(SOURCE.read_text())


class _Jumps(NamedTuple):
    """Jumps in the positions of the joints, as columns of shape (joints,)."""

    number: NDArray[np.int64]
    first_ns: NDArray[np.int64]  # Time of the first jump
    read_ns: NDArray[np.int64]  # Time of the last position
    longest: Floats  # Greatest distance of a jump
    position: Floats  # Last position; NaN, which is not compared, while the joint has no torque

    @classmethod
    def of_joints(cls, joints: int) -> _Jumps:
        """Return the state before the first position."""
        number, first_ns, read_ns = np.zeros((3, joints), np.int64)
        return cls(number, first_ns, read_ns, np.zeros(joints), np.full(joints, np.nan))

    def finding(self, row: int, joint: PlannedJoint, begin_ns: int) -> Finding:
        """Return the finding that the position of joint number `row` jumped; the run begins at `begin_ns`."""
        number = int(self.number[row])
        jumps = "a position jump" if number == 1 else f"{number} position jumps"
        most, since_s = distance(joint, float(self.longest[row])), (int(self.first_ns[row]) - begin_ns) * 1e-9
        text = f"reported {jumps} of up to {most}, faster than its servo model can turn"
        return joint_finding("position_jumped", joint, text, since_s, brief=True)


class Movement:
    """Accumulator of the movement of all joints, which then reports failures to follow. Its memory does
    not grow with the log."""

    def __init__(
        self, joints: Sequence[PlannedJoint] = (), begin_ns: int = 0, references: Sequence[str] = ()
    ) -> None:
        self._joints = joints
        found = {name.partition("/")[2]: column for column, name in enumerate(references)}
        self._settings = {
            "share": np.array([joint.share for joint in joints], np.float64),
            "top_speed": np.array([joint.logged.top_speed or 0.0 for joint in joints], np.float64),
            "turn_speed": np.array([_turn_speed(joint) for joint in joints], np.float64),
            "least_jump": np.array([MOVED_RAD * joint.share for joint in joints], np.float64),
            "reference": np.array([found.get(f"{joint.name}/position", -1) for joint in joints], np.int64),
            "fastest": np.zeros(len(joints)),
        }
        self._jumps = _Jumps.of_joints(len(joints))
        self.bins = Bins(_QUANTITIES, len(joints), begin_ns)
        self._trail = Trail(len(joints), begin_ns)

    def add_cycles(self, columns: JointColumns, way: Floats, known: int) -> None:
        """Add the cycles from number `known` on; the first `known` were already added, and are used for
        speeds only.

        Args:
            columns: Cycles of the log.
            way: Reachable trajectories, rad or m; shape (joints, cycles).
            known: Number of cycles that were added before.
        """
        read_ns, count = columns["read_ns"], len(columns) - known
        if count <= 0:
            return
        way = np.ascontiguousarray(way)
        rate = 1e9 / max(float(np.median(np.diff(read_ns[known:]))), 1.0) if count > 2 else 0.0
        values, free = np.empty((_QUANTITIES, count)), np.empty((len(way), count))
        off, led, marks = np.empty((3, count))
        used = {name: columns[name] for name in _FIELDS}
        times = {"read_ns": read_ns, "bin": self.bins.find_bins(read_ns[known:]), "steps": columns.steps}
        numbers = {"count": len(columns), "known": known, "torque_on": int(Torque.ON)}
        scratch = {"values": values, "off": off, "led": led, "marks": marks, "free": free}
        structures = (
            _structure("Cycles", used | times | {"way": way}, rate=rate, **numbers),
            _structure("Joints", self._settings, count=len(way)),
            _structure("Jumps", self._jumps._asdict()),
            _structure("Bins", self.bins.columns, bins=BINS),
            _structure("Scratch", scratch),
        )
        _library().movement_add(*map(ctypes.byref, structures))
        self._trail.add_cycles(read_ns[known:], way[:, known:].T, free.T, columns["effort"][:, known:].T)

    def findings(self, reached_off: Mapping[str, float] = _NONE) -> Iterable[Finding]:
        """Report joints that stand still, oscillate, or follow worse than before, and positions that jumped.

        Args:
            reached_off: Largest distance from the target at the end of a reached goal, rad or m, by joint
                name. Errors up to this distance or up to the joint's tolerance in the robot file, whichever
                is larger, do not count.
        """
        allowed = [max(reached_off.get(one.name, 0.0), one.logged.tolerance or 0.0) for one in self._joints]
        short, windows = self._windows(0.0, allowed), self._windows(_WINDOW_S, allowed)
        found = [failure_of(brief, each) for brief, each in zip(short, windows, strict=True)]
        shared = sum(failing is not None and failing.shared for _, failing in found)
        # The cause is then the line, the supply, the load or the motion.
        together = shared > max(1, len(found) // 2)
        named: set[int] = set()
        for row, (one, failing) in enumerate(found):
            if self._jumps.number[row]:
                yield self._jumps.finding(row, one.joint, self.bins.begin_ns)
            if self._jumps.number[row] or failing is not None:
                named.add(row)
            if failing is None or (failing.shared and together):
                continue
            peers = [each for each in (short if one is short[row] else windows) if each is not one]
            usual = [each.typical(AWAY, failing.when) for each in peers] if failing.shared else []
            if not (usual and one.typical(AWAY, failing.when) < WORSE * float(np.nanmedian(usual))):
                yield failing.finding(one)
        if together:
            buses = {one.joint.bus for one, failing in found if failing is not None and failing.shared}
            yield Finding(
                "follows_worse",
                buses.pop() if len(buses) == 1 else "",
                f"{shared} of {len(found)} joints followed badly at once, or worse than before: the cause "
                "is common, such as line, supply, load or motion.",
                rank=Rank.SERVO,
            )
        else:
            yield from changed(followed(self._joints, self._trail.samples()), named)

    def _windows(self, seconds: float, allowed: Sequence[float]) -> list[Windows]:
        length_s, *values = self.bins.joined(seconds)
        away = values[1][AWAY]
        wide = np.where(
            [off > AWAY_RAD * one.share for off, one in zip(allowed, self._joints, strict=True)], allowed, 0.0
        )
        away[away <= wide] = 0.0
        return [
            Windows(joint, length_s, *(each[:, :, row] for each in values))
            for row, joint in enumerate(self._joints)
        ]


def _turn_speed(joint: PlannedJoint) -> float:
    top = joint.logged.top_speed
    return math.nan if top is None or joint.wraps else top


def _structure(name: str, columns: Mapping[str, NDArray[Any]], **numbers: float) -> ctypes.Structure:
    return _STRUCTS[name](**{key: one.ctypes.data for key, one in columns.items()}, **numbers)


@cache
def _library() -> ctypes.CDLL:
    found = load_compiled(SOURCE, ctypes.CDLL)
    found.movement_add.argtypes, found.movement_add.restype = (ctypes.c_void_p,) * 5, None
    return found
