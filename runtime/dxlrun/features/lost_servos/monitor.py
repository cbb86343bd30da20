"""Monitor of lost servos: applies the policies of the robot and of its groups."""

from __future__ import annotations

from typing import Self

import numpy as np

from dxlrun.channels.cycle import LOST_AGE_NS, LOST_CYCLES, CycleRecord, States, Torque
from dxlrun.control.monitors.monitor import MonitorStage
from dxlrun.control.monitors.policy_actions import PolicyActions
from dxlrun.features.lost_servos import texts
from dxlrun.plan.loop_plan import LoopPlan
from dxlrun.plan.policy_plan import GroupPolicy, PolicyPlan


class LostServos:
    """Applies the policies for lost servos when the set of lost joints has changed."""

    def __init__(self, joints: tuple[str, ...], states: States, actions: PolicyActions) -> None:
        self._joints = joints
        self._states = states
        self._actions = actions
        self._all_valid = bytes([True]) * len(joints)
        self._missed = MissedReplies(len(joints))
        self._limp: set[str] = set()  # groups that have become limp after a lost servo

    @classmethod
    def build(cls, plan: LoopPlan, record: CycleRecord, actions: PolicyActions) -> Self:
        """Return the monitor of all joints."""
        return cls(tuple(one.name for one in plan.joints), record.states, actions)

    def check(self, time_ns: int) -> None:
        """Count missed replies, and apply the policies if the set of lost joints has changed."""
        if self._missed.none and self._states.valid.tobytes() == self._all_valid:
            return
        if self._missed.count(self._states):
            self._apply_policies()

    def _apply_policies(self) -> None:
        actions, rows = self._actions, self._missed.lost
        ending, limp = self._judge(actions.policies)
        for group in limp:
            actions.make_limp(group.rows)
            actions.report(texts.group_is_limp(group.name))
        for policy, ending_rows in ending.items():
            names = ", ".join(self._joints[row] for row in ending_rows)
            actions.end_run(policy, f"{names} missed at least {LOST_CYCLES} replies in a row")
        if not ending:
            actions.hold_controllers(self, rows, "all its joints answer again")

    def _judge(self, policies: PolicyPlan) -> tuple[dict[str, list[int]], list[GroupPolicy]]:
        """Return the policies that end the run with their lost rows, and the groups that become limp now."""
        ending: dict[str, list[int]] = {}
        limp: list[GroupPolicy] = []
        for row in sorted(self._missed.lost):
            group = next((one for one in policies.groups if row in one.rows), None)
            if group is None:
                if not policies.on_lost_servo.goes_on:
                    ending.setdefault("on_lost_servo", []).append(row)
            elif group.on_lost_servo == "stop":
                ending.setdefault("on_fault", []).append(row)
            elif group.on_lost_servo == "limp" and group.name not in self._limp:
                self._limp.add(group.name)
                limp.append(group)
        return ending, limp


class MissedReplies:
    """Counts the consecutive missed replies of each joint; a reboot by request does not count."""

    def __init__(self, joints: int) -> None:
        self.lost: frozenset[int] = frozenset()
        """Rows of the joints that are lost now."""
        self.none = True
        """True if no joint missed a reply in the last counted cycle."""
        self._missed = np.zeros(joints, dtype=np.int64)

    def count(self, states: States) -> bool:
        """Count the states of a cycle; return True if the set of lost joints has changed.

        Cycles without a missed reply may be skipped while `none` is true.
        """
        valid, age_ns = states.valid, states.age_ns
        self._missed += 1
        self._missed[valid | (states.torque == Torque.REBOOTING)] = 0
        self.none = not self._missed.any()
        # A negative age means that no state was read yet.
        lost = (self._missed >= LOST_CYCLES) & ((age_ns >= LOST_AGE_NS) | (age_ns < 0))
        rows = frozenset(np.flatnonzero(lost).tolist())
        changed = rows != self.lost
        self.lost = rows
        return changed


STAGE = MonitorStage(LostServos)
