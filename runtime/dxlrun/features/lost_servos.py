"""Policy `on_lost_servo`: reaction of a run to servos that do not answer, of the robot and of its groups.

`dynamixel` recovers a lost servo.
"""

from __future__ import annotations

from typing import Literal, Self

import msgspec
import numpy as np

from dxlrun.channels.cycle import LOST_AGE_NS, LOST_CYCLES, CycleRecord, States, Torque
from dxlrun.channels.events import EventCode, Severity, event_text
from dxlrun.compile.contribution import Compilation, CompileStage, Contribution
from dxlrun.control.monitors.monitor import MonitorStage
from dxlrun.control.monitors.policy_actions import PolicyActions
from dxlrun.description.form import key
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
        "until it answers, or the run ends by these steps.",
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
    """Policy for the loss of a servo in a group of joints."""

    name: str
    rows: frozenset[int]  # Rows of its joints
    action: GroupAction = msgspec.field(name=NAME)  # In logs it has the name of the key


def compile_groups(compilation: Compilation) -> Contribution:
    """Return the policies of the groups that have their own."""
    rows = {name: row for row, name in enumerate(compilation.joints)}
    groups = tuple(
        GroupPolicy(name, frozenset(rows[joint] for joint in group.joints if joint in rows), action)
        for name, group in compilation.file.robot.policies.groups.items()
        if (action := OF_GROUP.of(group)) is not None
    )
    return Contribution(
        policies={f"{NAME} of {one.name}": _ACTIONS[one.action] for one in groups},
        plan=msgspec.json.encode(groups) if groups else b"",
    )


@event_text(EventCode.POLICY, Severity.ERROR)
def group_is_limp(group: str) -> str:
    """Event of a group that has become limp."""
    return f"group {group} lost a servo: it is limp until a client requests torque"


class LostServos:
    """Applies the policies for lost servos when the set of lost joints has changed."""

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
        """Return the monitor of all joints."""
        groups = msgspec.json.decode(plan.feature_plans.get(NAME, b"[]"), type=tuple[GroupPolicy, ...])
        return cls(tuple(one.name for one in plan.joints), record.states, actions, groups)

    def check(self, time_ns: int) -> None:
        """Count missed replies, and apply the policies if the set of lost joints has changed."""
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
        """Return the policies that end the run with their lost rows, and the groups that become limp now."""
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


STAGES = (ON_LOST_SERVO, CompileStage(compile_groups), MonitorStage(LostServos))
