"""Which servos move which joints, where that is more than one servo a joint; JSON in the log."""

from __future__ import annotations

import msgspec


class CouplingPlan(msgspec.Struct, frozen=True):
    """Servos that move joints together: q = M s, s = M^+ q, efforts of the joints (M^+)^T of the servos'.

    s is what a servo does at the joint or at the transmission's input: direction * (theta - reference) *
    ratio, in rad, or in m where the joint is linear. (ros2_control, DifferentialTransmission, has the same
    matrix of a differential: half of the sum and half of the difference of the inputs.)
    """

    name: str  # Of its joint or its transmission
    joints: tuple[int, ...]  # Rows of its joints in the arrays of the joints
    servos: tuple[int, ...]  # Rows of its servos in the arrays of the servos
    matrix: tuple[tuple[float, ...], ...]  # M: a row for each joint, a column for each servo
    inverse: tuple[tuple[float, ...], ...]
    """M^+, its pseudo-inverse: a row for each servo, a column for each joint."""
    tolerance: float = 0.0
    """By how much a servo's s may differ from what the others say, rad or m; 0: none can, there are as many
    joints as servos."""

    @property
    def own(self) -> bool:
        """True when it is a servo with a joint of its own."""
        return not self.name


class MechanicsPlan(msgspec.Struct, frozen=True):
    """How joints and servos belong together where a servo is not a joint; empty: each servo is one.

    With it the arrays of the servos are others than those of the joints: `ServoPlan.row` counts in them.
    """

    couplings: tuple[CouplingPlan, ...] = ()
    direct: tuple[tuple[int, int], ...] = ()  # Row of each joint with one servo, and the row of that servo
    servos: tuple[str, ...] = ()  # Names of all servos, by their rows: `head`, `hip/1`, `wrist/left`

    @property
    def coupled(self) -> bool:
        """True when there are joints that one servo alone does not move."""
        return bool(self.couplings)

    def mechanisms(self, joints: int) -> tuple[CouplingPlan, ...]:
        """Return all servos with what they move, by the number of joints: a servo's own joint is 1 x 1."""
        alone = tuple(
            CouplingPlan("", (joint,), (servo,), ((1.0,),), ((1.0,),))
            for joint, servo in self.own_servos(joints)
        )
        return alone + self.couplings

    def own_servos(self, joints: int) -> tuple[tuple[int, int], ...]:
        """Return the rows of each joint with a servo of its own and of that servo."""
        return self.direct if self.coupled else tuple((row, row) for row in range(joints))

    def moving(self, joint: int) -> list[CouplingPlan]:
        """Return what moves a joint that has no servo of its own, by its row; empty: it has one."""
        return [one for one in self.couplings if joint in one.joints]

    def servo_rows(self, joint: int) -> tuple[int, ...]:
        """Return the rows of the servos that move a joint, which is the servo's own row in an empty plan."""
        for one in self.moving(joint):
            return one.servos
        return tuple(servo for row, servo in self.direct if row == joint) or (joint,)
