"""Policy `on_lost_servo`: what a run does when servos of the robot or of a group stop answering.

`dynamixel` recovers a lost servo.
"""

from __future__ import annotations

from typing import Literal, Self

import msgspec
import numpy as np

from dxlrun.channels.cycle import LOST_AGE_NS, LOST_CYCLES, CycleRecord, States, Torque
from dxlrun.channels.event_records import EventCode, Severity, event_text
from dxlrun.compile.contribution import Compilation, CompileStage, Contribution
from dxlrun.control.monitors.monitor_stage import MonitorStage
from dxlrun.control.monitors.policy_actions import PolicyActions
from dxlrun.description.base_form import key
from dxlrun.description.robot import WrittenPolicy
from dxlrun.features.feature import PolicyKey
from dxlrun.plan.loop_plan import LoopPlan
from dxlrun.plan.policy_plan import HOLD

NAME = "on_lost_servo"
GroupAction = Literal["hold", "limp", "stop"]
OF_GROUP: PolicyKey[GroupAction | None] = PolicyKey(
    NAME,
    GroupAction | None,
    key(
        "Reaction to a lost servo of the group: its controllers hold, the group goes limp, or the run "
        "ends by on_fault (stop). The robot's policy by default.",
        "limp",
        None,
    ),
    before="on_returned_servo",
)
ON_LOST_SERVO: PolicyKey[WrittenPolicy] = PolicyKey(
    NAME,
    WrittenPolicy,
    key(
        "Reaction to a lost servo, after 3 missed replies in a row and 50 ms: its controllers hold "
        "until it answers, or the run ends with these steps.",
        "hold",
        "hold",
    ),
    does="hold its controllers until it answers, the others continue",
    before="on_returned_servo",
    group=OF_GROUP,
)
_ACTIONS = {
    "hold": "hold their controllers until it answers, the others continue",
    "limp": "the group goes limp, the others continue",
    "stop": "end the run by on_fault",
}


class GroupPolicy(msgspec.Struct, frozen=True):
    """Action (`hold`, `limp` or `stop`) when a servo of one group of joints is lost."""

    name: str
    rows: frozenset[int]  # Rows of its joints
    action: GroupAction = msgspec.field(name=NAME)  # In logs it has the name of the key


def compile_groups(compilation: Compilation) -> Contribution:
    """Return the groups with their own `on_lost_servo`, encoded for the run, and their texts for `check`."""
    rows = {name: row for row, name in enumerate(compilation.joints)}
    groups = tuple(
        GroupPolicy(name, frozenset(rows[joint] for joint in group.joints if joint in rows), action)
        for name, group in compilation.file.robot.policies.groups.items()
        if (action := OF_GROUP.value_of(group)) is not None
    )
    return Contribution(
        policies={f"{NAME} of {one.name}": _ACTIONS[one.action] for one in groups},
        plan=msgspec.json.encode(groups) if groups else b"",
    )


@event_text(EventCode.POLICY, Severity.ERROR)
def group_is_limp(group: str) -> str:
    """Return the event that a group was made limp because it lost a servo."""
    return f"group {group} lost a servo: the group is limp until a client requests torque"


class LostServos:
    """Carries out `on_lost_servo` in a run whenever a joint becomes lost or answers again."""

    def __init__(
        self,
        joints: tuple[str, ...],
        states: States,
        actions: PolicyActions,
        groups: tuple[GroupPolicy, ...] = (),
    ) -> None:
        self._joints = joints
        self._groups = groups
        self._states = states
        self._actions = actions
        self._all_valid = bytes([True]) * len(joints)
        self._missed = MissedReplies(len(joints))
        self._limp: set[str] = set()  # groups that have become limp after a lost servo

    @classmethod
    def build(cls, plan: LoopPlan, record: CycleRecord, actions: PolicyActions) -> Self:
        """Return the monitor for all joints of a run, with the groups' policies from the plan."""
        groups = msgspec.json.decode(plan.feature_plans.get(NAME, b"[]"), type=tuple[GroupPolicy, ...])
        return cls(tuple(one.name for one in plan.joints), record.states, actions, groups)

    def check_cycle(self, time_ns: int) -> None:
        """Count the cycle's missed replies; apply the policies if a joint became lost or came back."""
        if self._missed.none and self._states.valid.tobytes() == self._all_valid:
            return
        if self._missed.count(self._states):
            self._apply_policies()

    def _apply_policies(self) -> None:
        actions, rows = self._actions, self._missed.lost
        ending, limp = self._judge()
        for group in limp:
            actions.make_limp(group.rows)
            actions.report(group_is_limp(group.name))
        for policy, ending_rows in ending.items():
            names = ", ".join(self._joints[row] for row in ending_rows)
            actions.end_run(policy, f"{names} missed at least {LOST_CYCLES} replies in a row")
        if not ending:
            actions.hold_controllers(self, rows, "all its joints answer again")

    def _judge(self) -> tuple[dict[str, list[int]], list[GroupPolicy]]:
        """Return the rows of lost joints by the policy that ends the run, and the groups to make limp now."""
        goes_on = self._actions.policies.of_features.get(NAME, HOLD).goes_on
        ending: dict[str, list[int]] = {}
        limp: list[GroupPolicy] = []
        for row in sorted(self._missed.lost):
            group = next((one for one in self._groups if row in one.rows), None)
            if group is None:
                if not goes_on:
                    ending.setdefault(NAME, []).append(row)
            elif group.action == "stop":
                ending.setdefault("on_fault", []).append(row)
            elif group.action == "limp" and group.name not in self._limp:
                self._limp.add(group.name)
                limp.append(group)
        return ending, limp


class MissedReplies:
    """Counts the replies that each joint missed in a row; a reboot that was requested is not counted."""

    def __init__(self, joints: int) -> None:
        self.lost: frozenset[int] = frozenset()
        """Rows of the joints that count as lost: enough missed replies in a row, and an old state."""
        self.none = True
        """True if every joint answered in the cycle counted last."""
        self._missed = np.zeros(joints, dtype=np.int64)

    def count(self, states: States) -> bool:
        """Count the missed replies of a cycle; return True if a joint became lost or answers again.

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


STAGES = (ON_LOST_SERVO, CompileStage(compile_groups), MonitorStage(LostServos))
