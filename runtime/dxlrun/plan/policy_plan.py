"""Policy plan: actions of a robot at the end of a run, after faults, and by features."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Literal

import msgspec

from dxlwire.joint_unit import LINEAR, ROTARY, JointUnit

Last = Literal["limp", "hold"]  # Final state of a robot: torque off, or torque on at its position
TORQUE_STAYS = (
    "torque stays on by the policy: the robot holds until its power is off; give --take-over to the next run"
)
"""Remark at the end of a run with `hold`."""

SLOW_SPEED = 1.5
"""Speed limit of goals in the first second after torque was enabled, rad/s. A quarter of an AX-12's full
speed: a person next to the robot can step back, and the thesis' motions still begin on time."""
SLOW_SPEEDS: Mapping[JointUnit, float] = {
    ROTARY: SLOW_SPEED,
    LINEAR: 0.05,  # a gripper's fingers close in a second [i]
}
"""Speed limit of goals in the first second after torque was enabled, by unit of the joint, rad/s or m/s."""
SLOW_START_NS = 1_000_000_000  # Duration of the slow speed after `ease_in` (failures: limit violation)
_NEVER_S = 1e9  # Upper bound of durations, so that they fit an int of ns
SETTLE_NS = 300_000_000
"""Settling time of a pose. A joint that arrives later is blocked, too weak, or lost."""


def longest_pose_ns(
    distance: float,
    speed: float,
    acceleration: float = math.inf,
    highest_speed: float = 0.0,
    slow_speed: float = SLOW_SPEED,
) -> int:
    """Return the longest duration of a pose, ns.

    The slow start of the gate is included, because a run may be stopped in its first second. With a finite
    acceleration, a goal that moves at `highest_speed` first comes to rest, which takes v / a. Its way then
    takes at most distance / v + v / a, even if it does not reach its speed.

    Args:
        distance: Distance to the pose, rad or m.
        speed: Speed toward the pose, rad/s or m/s.
        acceleration: Acceleration limit, rad/s^2 or m/s^2.
        highest_speed: Highest speed of the goal at the begin, rad/s or m/s.
        slow_speed: Speed limit in the first second, rad/s or m/s.
    """
    slow_s = SLOW_START_NS * 1e-9
    slow = min(speed, slow_speed)
    left = max(0.0, distance - slow * slow_s)
    ramps_s = (highest_speed + speed) / acceleration if math.isfinite(acceleration) else 0.0
    needed_s = min(distance, slow * slow_s) / slow + left / speed + ramps_s
    return round(min(needed_s, _NEVER_S) * 1e9) + SETTLE_NS


class PolicyStepPlan(msgspec.Struct, frozen=True):
    """Step of a policy: a pose, or a reduction of torque."""

    text: str  # Text for people: `pose home at 60 deg/s`
    longest_ns: int  # Longest duration
    targets: tuple[float | None, ...] = ()
    """Target position of each joint, rad or m; None: not in the pose. Empty: the step reduces torque
    instead."""
    speed: float = 0.0  # Speed toward the pose, rad/s
    linear_speed: float | None = None  # Speed of linear joints, m/s; None: not in the pose
    fraction: float = 1.0  # Torque limit at the end of the step, as a share of each servo's own limit
    levels: int = 0  # Number of reductions of the torque limit; 0: none

    def speed_of(self, unit: JointUnit) -> float:
        """Return the speed toward the pose for joints with this unit, rad/s or m/s."""
        return (self.linear_speed or 0.0) if unit is LINEAR else self.speed


class Policy(msgspec.Struct, frozen=True):
    """Steps that a robot executes, such as at the end of a run, and its final state: limp or hold."""

    steps: tuple[PolicyStepPlan, ...] = ()
    last: Last = "limp"

    @property
    def text(self) -> str:
        """Steps and final state of the policy as text for messages."""
        return ", then ".join([*(step.text for step in self.steps), self.last])

    @property
    def goes_on(self) -> bool:
        """True if the policy only holds. A run continues if the cause does not require its end."""
        return not self.steps and self.last == "hold"

    @property
    def longest_ns(self) -> int:
        """Longest duration of all steps together, ns."""
        return sum(step.longest_ns for step in self.steps)


LIMP = Policy()
HOLD = Policy(last="hold")


class PolicyPlan(msgspec.Struct, frozen=True):
    """Compiled policies of a robot: for the end of a run, for faults, and for events of features."""

    on_exit: Policy = LIMP  # After a stop request, or at the end of the plan
    on_fault: Policy = LIMP  # After a fault of the loop, a bus, or a controller without an available fallback
    limit_ns: int = 1_500_000_000
    """Time limit of the steps. The rest of the exit timeout is reserved for torque off."""
    of_features: dict[str, Policy] = {}
    """Policies of features by name; those with `hold` do not end the run."""

    @property
    def by_name(self) -> dict[str, Policy]:
        """All policies of the robot by name, such as `on_exit`."""
        return {"on_exit": self.on_exit, "on_fault": self.on_fault, **self.of_features}

    def slowest_period_ns(self, planned_ns: int) -> int:
        """Return the longest period with which a run ends within its exit timeout.

        The loop sees a stop request up to a period later, and the first step begins in the cycle after that.
        Two planned periods are reserved for that in addition to the limit.

        Args:
            planned_ns: Period of the plan.
        """
        longest_ns = max(policy.longest_ns for policy in self.by_name.values())
        left_ns = max(0, self.limit_ns - longest_ns)
        return planned_ns + (left_ns // 2 if longest_ns else planned_ns + left_ns)

    def named(self, name: str) -> Policy:
        """Return the policy of this name, such as `on_exit`. Raises KeyError for an unknown name."""
        return self.by_name[name]
