"""Lost servos: which joints have not answered for some cycles, judged by the states alone."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dxlrun.control.policy_plan import GroupPolicy, PolicyName, PolicyPlan
from dxlrun.hardware import LOST_CYCLES


class LostServos:
    """Counts the replies that each joint missed in a row."""

    __slots__ = ("_limp", "_missed", "rows")

    def __init__(self, joints: int) -> None:
        self.rows: frozenset[int] = frozenset()
        """Rows of the joints that are lost now: LOST_CYCLES missed replies, and none since."""
        self._limp: set[str] = set()  # names of groups that a lost servo has left without torque
        self._missed = np.zeros(joints, dtype=np.int64)

    def look(self, valid: NDArray[np.bool_]) -> bool:
        """Take the states of a cycle, shape (joints,); return whether `rows` is another one now."""
        if np.count_nonzero(valid) == valid.size and not self._missed.any():
            return False
        self._missed += 1
        self._missed[valid] = 0
        rows = frozenset(np.flatnonzero(self._missed >= LOST_CYCLES).tolist())
        changed = rows != self.rows
        self.rows = rows
        return changed

    def judge(self, policies: PolicyPlan) -> tuple[dict[PolicyName, list[int]], list[GroupPolicy]]:
        """Return which policies end the run, for which lost rows, and which groups become limp by now."""
        ending: dict[PolicyName, list[int]] = {}
        limp: list[GroupPolicy] = []
        for row in sorted(self.rows):
            group = policies.of_lost(row)
            if group is None:
                if not policies.on_lost_servo.goes_on:
                    ending.setdefault("on_lost_servo", []).append(row)
            elif group.on_lost_servo == "stop":
                ending.setdefault("on_fault", []).append(row)
            elif group.on_lost_servo == "limp" and group.name not in self._limp:
                self._limp.add(group.name)
                limp.append(group)
        return ending, limp
