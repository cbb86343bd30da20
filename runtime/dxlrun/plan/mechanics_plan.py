"""Mechanics plan: servos that move joints together, for joints with more than one servo; JSON in the log."""

from __future__ import annotations

import msgspec


class CouplingPlan(msgspec.Struct, frozen=True):
    """Servos that move joints together: q = M s, s = M^+ q, efforts of the joints (M^+)^T of the servos'.

    s is the position of a servo at the joint or at the input of the transmission: direction * (theta -
    reference) * ratio, in rad, or in m for a linear joint. (DifferentialTransmission of ros2_control has the
    same matrix for a differential: half of the sum and half of the difference of the inputs.)
    """

    name: str  # Name of the joint or of the transmission
    joints: tuple[int, ...]  # Rows of its joints in the arrays of the joints
    servos: tuple[int, ...]  # Rows of its servos in the arrays of the servos
    matrix: tuple[tuple[float, ...], ...]  # M: a row for each joint, a column for each servo
    inverse: tuple[tuple[float, ...], ...]
    """M^+, the pseudo-inverse of M: a row for each servo, a column for each joint."""
    tolerance: float = 0.0
    """Largest difference between a servo's s and the value from the other servos, rad or m. 0: not checked,
    because there are as many joints as servos."""

    @property
    def own(self) -> bool:
        """True for the trivial coupling of one servo with one joint."""
        return not self.name


class MechanicsPlan(msgspec.Struct, frozen=True):
    """Assignment of servos to joints. Empty: each joint has one servo, with the same row.

    Otherwise servos and joints have separate arrays, and `ServoPlan.row` is an index of the servos' arrays.
    """

    couplings: tuple[CouplingPlan, ...] = ()
    direct: tuple[tuple[int, int], ...] = ()  # Rows of joint and servo, for each joint with one servo
    servos: tuple[str, ...] = ()  # Names of all servos by row: `head`, `hip/1`, `wrist/left`

    @property
    def coupled(self) -> bool:
        """True if any joints of the robot share servos or have several."""
        return bool(self.couplings)

    def mechanisms(self, joints: int) -> tuple[CouplingPlan, ...]:
        """Return the couplings of all joints. A joint with one servo has a 1 x 1 matrix.

        Args:
            joints: Number of joints.
        """
        alone = tuple(
            CouplingPlan("", (joint,), (servo,), ((1.0,),), ((1.0,),))
            for joint, servo in self.own_servos(joints)
        )
        return alone + self.couplings

    def own_servos(self, joints: int) -> tuple[tuple[int, int], ...]:
        """Return the rows of joint and servo for each joint with one servo.

        Args:
            joints: Number of joints.
        """
        return self.direct if self.coupled else tuple((row, row) for row in range(joints))

    def moving(self, joint: int) -> list[CouplingPlan]:
        """Return the couplings that include a joint, by its row; empty if it has its own servo."""
        return [one for one in self.couplings if joint in one.joints]

    def servo_rows(self, joint: int) -> tuple[int, ...]:
        """Return the rows of the servos that move a joint; in an empty plan, the row of the joint."""
        for one in self.moving(joint):
            return one.servos
        return tuple(servo for row, servo in self.direct if row == joint) or (joint,)
