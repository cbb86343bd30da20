"""Lost servos: which joints have not answered for some cycles, judged by the states alone."""

from __future__ import annotations

import numpy as np

from dxlrun.control.policy_plan import GroupPolicy, PolicyName, PolicyPlan
from dxlrun.interfaces import LOST_AGE_NS, LOST_CYCLES, States


class LostServos:
    """Counts the replies that each joint missed in a row."""

    __slots__ = ("_all", "_limp", "_missed", "_missing", "rows")

    def __init__(self, joints: int) -> None:
        self.rows: frozenset[int] = frozenset()
        """Rows of the joints that are lost now, as `hardware` says it."""
        self._limp: set[str] = set()  # names of groups that a lost servo has left without torque
        self._missed = np.zeros(joints, dtype=np.int64)
        self._missing = False
        """Whether anybody had missed a reply when it was looked last."""
        self._all = bytes([True]) * joints

    def look(self, states: States) -> bool:
        """Take the states of a cycle; return whether `rows` is another one now."""
        valid, age_ns = states.valid, states.age_ns
        everybody = valid.tobytes() == self._all
        if everybody and not self._missing:
            return False
        self._missing = not everybody
        self._missed += 1
        self._missed[valid] = 0
        lost = (self._missed >= LOST_CYCLES) & ((age_ns >= LOST_AGE_NS) | (age_ns < 0))
        rows = frozenset(np.flatnonzero(lost).tolist())
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
