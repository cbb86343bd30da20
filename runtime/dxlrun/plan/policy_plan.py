"""Policies as data: what a robot does when a run ends, or when something does not go on as planned."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Literal

import msgspec
from msgspec.structs import replace

from dxlwire.joint_unit import LINEAR, ROTARY, JointUnit

Last = Literal["limp", "hold"]  # How a robot is left: torque off, or torque on where it stands
TORQUE_STAYS = (
    "torque stays on, as the policy says: the robot holds until its power is off; "
    "the next run needs --take-over"
)
"""The remark of a run that ends with `hold`."""

SLOW_SPEED = 1.5
"""rad/s; a goal moves no faster in the first second after torque was switched on. A quarter of an AX-12's
full speed: a person beside the robot can step back, and the thesis' motions still begin on time."""
SLOW_SPEEDS: Mapping[JointUnit, float] = {
    ROTARY: SLOW_SPEED,
    LINEAR: 0.05,  # a gripper's fingers close in a second [i]
}
"""The same for each unit of joints, rad/s or m/s."""
SLOW_START_NS = 1_000_000_000  # How long after `ease_in` the slow speed holds (failures: limit violation)
_NEVER_S = 1e9  # What takes longer is as good as endless, and still a whole number of ns
SETTLE_NS = 300_000_000
"""A joint that has had its pose as goal for so long and is not there is blocked, too weak, or lost."""


def longest_pose_ns(
    distance: float,
    speed: float,
    acceleration: float = math.inf,
    highest_speed: float = 0.0,
    slow_speed: float = SLOW_SPEED,
) -> int:
    """Return how long a pose takes at the most from `distance` rad away at `speed` rad/s, ns; or m and m/s.

    The gate lets nothing go faster than `slow_speed` in the first second, and a run may be stopped in it.
    With a finite acceleration, rad/s^2, a goal of `highest_speed` comes to rest first, which takes v / a; its
    way then takes at most distance / v + v / a, whether it reaches its speed or not.
    """
    slow_s = SLOW_START_NS * 1e-9
    slow = min(speed, slow_speed)
    left = max(0.0, distance - slow * slow_s)
    ramps_s = (highest_speed + speed) / acceleration if math.isfinite(acceleration) else 0.0
    needed_s = min(distance, slow * slow_s) / slow + left / speed + ramps_s
    return round(min(needed_s, _NEVER_S) * 1e9) + SETTLE_NS


class Step(msgspec.Struct, frozen=True):
    """One thing that is done, cycle by cycle, before the robot is left: a pose, or less torque."""

    text: str  # As a person reads it: `pose home at 60 deg/s`
    longest_ns: int  # How long it takes at the most
    targets: tuple[float | None, ...] = ()
    """rad, one a joint, None where the pose says nothing; empty: this step is no pose."""
    speed: float = 0.0  # rad/s, toward the pose
    linear_speed: float | None = None  # m/s, of linear joints; None: the pose has none
    fraction: float = 1.0  # Of each servo's own torque limit, at the end of the step
    levels: int = 0  # In how many steps the torque becomes less; 0: it stays

    def speed_of(self, unit: JointUnit) -> float:
        """Return the speed toward the pose of a joint with this unit, rad/s or m/s."""
        return (self.linear_speed or 0.0) if unit is LINEAR else self.speed


class Policy(msgspec.Struct, frozen=True):
    """Steps in order, and how the robot is left."""

    steps: tuple[Step, ...] = ()
    last: Last = "limp"

    @property
    def text(self) -> str:
        """The policy in words."""
        return ", then ".join([*(step.text for step in self.steps), self.last])

    @property
    def goes_on(self) -> bool:
        """True when it does nothing but hold: where the run need not end for that, it does not."""
        return not self.steps and self.last == "hold"

    @property
    def longest_ns(self) -> int:
        """How long the steps take at the most, ns."""
        return sum(step.longest_ns for step in self.steps)


LIMP = Policy()
HOLD = Policy(last="hold")


class GroupPolicy(msgspec.Struct, frozen=True):
    """What happens when a servo of a group of joints is lost."""

    name: str
    rows: frozenset[int]  # Rows of its joints
    on_lost_servo: Literal["hold", "limp", "stop"]
    """Its controllers wait, the group loses its torque, or the run ends."""


class PolicyPlan(msgspec.Struct, frozen=True):
    """The policies of a robot whose steps may end a run."""

    on_exit: Policy = LIMP  # When a run was asked to stop, or came to its end
    on_fault: Policy = LIMP  # When the loop or a bus failed, or a controller whose fallback did not take over
    on_lost_servo: Policy = HOLD
    on_stale_command: Policy = HOLD
    groups: tuple[GroupPolicy, ...] = ()  # For joints that stand in one of them, in place of `on_lost_servo`
    limit_ns: int = 1_500_000_000
    """The steps are cut short after this time: what is left of the exit timeout is for torque off."""
    others: dict[str, Policy] = {}
    """Policies of features that have no field above."""

    @classmethod
    def collect(
        cls, policies: Mapping[str, Policy], groups: tuple[GroupPolicy, ...], limit_ns: int
    ) -> PolicyPlan:
        """Return the plan of these policies by their names."""
        own = {name: policies[name] for name in cls().by_name if name in policies}
        others = {name: policy for name, policy in policies.items() if name not in own}
        return replace(cls(groups=groups, limit_ns=limit_ns, others=others), **own)

    @property
    def by_name(self) -> dict[str, Policy]:
        """All policies by their names."""
        return {
            "on_exit": self.on_exit,
            "on_fault": self.on_fault,
            "on_lost_servo": self.on_lost_servo,
            "on_stale_command": self.on_stale_command,
            **self.others,
        }

    def slowest_period_ns(self, planned_ns: int) -> int:
        """Return the longest period in which a run ends within its exit timeout; `planned_ns` is the plan's.

        A request to stop is seen a period later, and the first step begins one after that; two planned
        periods are kept free for it beside the limit.
        """
        longest_ns = max(policy.longest_ns for policy in self.by_name.values())
        left_ns = max(0, self.limit_ns - longest_ns)
        return planned_ns + (left_ns // 2 if longest_ns else planned_ns + left_ns)

    def named(self, name: str) -> Policy:
        """Return one policy; raises KeyError if there is none of this name."""
        return self.by_name[name]
