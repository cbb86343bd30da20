"""Joint arrays: convert states of servos into states of joints, and goals of joints into goals of servos.

Positions and speeds are converted by q = M s and s = M^+ q, efforts by (M^+)^T and M^T, so that the power is
equal on both sides. All couplings are computed at once: their matrices are padded with zeros to one size and
stacked.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dxlrun.channels.cycle import Commands, Floats, States, Torque
from dxlrun.plan.mechanics_plan import MechanicsPlan
from dxlwire.modes import Mode

_WORSE: tuple[Torque, ...] = (
    Torque.ON,
    Torque.DOUBT,
    Torque.GIVEN,
    Torque.RELEASED,
    Torque.OFF,
    Torque.REBOOTING,
    Torque.LOST,
    Torque.UNKNOWN,
)
"""Torque states from best to worst; a joint has the worst torque state among its servos."""
_LEAST_SHARE = 0.05
"""Lowest speed of a servo relative to its speed if all of its joints move: a load may have moved a servo that
need not move."""


class CoupledJointArrays:
    """States and goals of all servos and all joints of a robot, with the conversion between them.

    The servos' arrays have one row per servo, in the order of the plan's `servos`. A joint's row is valid if
    the rows of all its servos are valid; otherwise it keeps its values. It has the age of the oldest of these
    rows.
    """

    def __init__(self, plan: MechanicsPlan, states: States, goals: Commands) -> None:
        self.states = states
        self.goals = goals
        self.servo_states = States.empty(len(plan.servos))  # filled by the servos' hardware
        self.servo_goals = Commands.empty(len(plan.servos))  # sent by the servos' hardware
        self._direct_joints = np.array([joint for joint, _ in plan.direct], dtype=np.intp)
        self._direct_servos = np.array([servo for _, servo in plan.direct], dtype=np.intp)
        count = len(plan.couplings)
        joints = max(len(one.joints) for one in plan.couplings)
        servos = max(len(one.servos) for one in plan.couplings)
        self._joint_rows = np.zeros((count, joints), dtype=np.intp)
        self._servo_rows = np.zeros((count, servos), dtype=np.intp)
        self._no_joint = np.ones((count, joints), dtype=np.bool_)
        """True in the padding: places that a coupling with fewer joints than the largest does not use."""
        self._no_servo = np.ones((count, servos), dtype=np.bool_)
        self._matrix: Floats = np.zeros((count, joints, servos))
        self._inverse: Floats = np.zeros((count, servos, joints))
        for index, one in enumerate(plan.couplings):
            here, there = len(one.joints), len(one.servos)
            self._joint_rows[index, :here] = one.joints
            self._servo_rows[index, :there] = one.servos
            self._no_joint[index, :here] = False
            self._no_servo[index, :there] = False
            self._matrix[index, :here, :there] = one.matrix
            self._inverse[index, :there, :here] = one.inverse
        self._efforts = np.ascontiguousarray(self._inverse.transpose(0, 2, 1))
        self._coupling, self._column = np.nonzero(~self._no_joint)
        self._rows = self._joint_rows[self._coupling, self._column]
        """Rows of all coupled joints in the joints' arrays; `_coupling` and `_column` are their places in the
        stacked matrices."""
        self._single = np.array([len(one.joints) == 1 for one in plan.couplings])[:, None]
        self._rank = np.zeros(len(Torque), dtype=np.uint8)
        for rank, torque in enumerate(_WORSE):
            self._rank[torque] = rank
        self.residual: Floats = np.zeros((count, servos))
        """Difference between each servo's position and the one that fits the joints' positions, rad or m."""
        self._offset: Floats = np.zeros((count, servos))
        self._fade: Floats = np.zeros((count, 1))
        """Share of `_offset` that is still added to the servos' goals, 1 falling to 0."""
        self._last_goal: Floats = np.full((count, joints), np.nan)
        self._last_speed: Floats = np.full((count, joints), np.nan)
        self._speeds: Floats = np.full((count, servos), np.nan)

    def fill_joint_goals(self) -> None:
        """Set the joints' goals at start-up such that every servo keeps the goal that it has.

        Small deviations of the servos are kept as offsets at first; `fade` removes them.
        """
        self.goals.values[:, self._direct_joints] = self.servo_goals.values[:, self._direct_servos]
        given = self.servo_goals.values[:, self._servo_rows]
        given[:, self._no_servo] = 0.0
        found = self._times(self._matrix, given)
        self.goals.values[:, self._rows] = found[:, self._coupling, self._column]
        self._offset[:] = given[0] - self._times(self._inverse, found[0])
        # A servo without a position goal (NaN) has no offset.
        self._offset[~np.isfinite(self._offset)] = 0.0
        self._fade.fill(1.0)

    def fade(self, share: float) -> None:
        """Reduce the offsets in the servos' goals by `share` of their initial value, until they are 0."""
        np.maximum(0.0, self._fade - share, out=self._fade)

    def anchor(self, index: int) -> None:
        """Make the servos of a coupling hold their present positions, although these do not fit each other.

        Their deviations are added to their goals as offsets; `fade` removes them.
        """
        self._offset[index] = np.nan_to_num(self.residual[index])
        self._fade[index] = 1.0

    def fill_joint_states(self) -> None:
        """Compute the joints' states from the servos' states of this cycle."""
        to, of = self.states, self.servo_states
        joints, servos = self._direct_joints, self._direct_servos
        to.motion[:, joints] = of.motion[:, servos]
        to.valid[joints] = of.valid[servos]
        to.age_ns[joints] = of.age_ns[servos]
        to.temperature[joints] = of.temperature[servos]
        to.voltage[joints] = of.voltage[servos]
        to.hardware_error[joints] = of.hardware_error[servos]
        to.mode[joints] = of.mode[servos]
        to.torque[joints] = of.torque[servos]
        self._read_coupled(to, of)

    def _read_coupled(self, to: States, of: States) -> None:
        rows, absent, coupling = self._servo_rows, self._no_servo, self._coupling
        motion = of.motion[:, rows]
        # The matrices have zeros in the padding, but NaN * 0 is NaN.
        motion[:, absent] = 0.0
        valid = np.all(of.valid[rows] | absent, axis=1)
        moved = self._times(self._matrix, motion[:2])
        self.residual[:] = motion[0] - self._times(self._inverse, moved[0])
        effort = self._times(self._efforts, motion[2])
        shown = valid[coupling]
        joints, which, column = self._rows[shown], coupling[shown], self._column[shown]
        to.position[joints] = moved[0, which, column]
        to.velocity[joints] = moved[1, which, column]
        to.effort[joints] = effort[which, column]
        age = of.age_ns[rows]
        never = np.any((age < 0) & ~absent, axis=1)
        age[absent] = 0
        to.valid[self._rows] = shown
        to.age_ns[self._rows] = np.where(never, -1, age.max(axis=1))[coupling]
        # fmax and fmin skip NaN: the hottest known servo and the lowest known voltage count.
        to.temperature[self._rows] = np.fmax.reduce(np.where(absent, np.nan, of.temperature[rows]), axis=1)[
            coupling
        ]
        to.voltage[self._rows] = np.fmin.reduce(np.where(absent, np.nan, of.voltage[rows]), axis=1)[coupling]
        errors = np.where(absent, 0, of.hardware_error[rows]).astype(np.uint8)
        to.hardware_error[self._rows] = np.bitwise_or.reduce(errors, axis=1)[coupling]
        mode = of.mode[rows]
        alike = np.all((mode == mode[:, :1]) | absent, axis=1)
        to.mode[self._rows] = np.where(alike, mode[:, 0], Mode.UNKNOWN)[coupling]
        torque = of.torque[rows]
        ranks = self._rank[torque]
        # Padding has the best rank, so that it is never the worst servo.
        ranks[absent] = 0
        worst = np.take_along_axis(torque, ranks.argmax(axis=1)[:, None], axis=1)[:, 0]
        to.torque[self._rows] = worst[coupling]

    def fill_servo_goals(self) -> None:
        """Compute the servos' goals from the joints' goals; if a joint has no goal, its servos have none."""
        to, of = self.servo_goals, self.goals
        to.values[:, self._direct_servos] = of.values[:, self._direct_joints]
        wanted = of.values[:, self._joint_rows]
        # NaN * 0 is NaN, as in `_read_coupled`.
        wanted[:, self._no_joint] = 0.0
        position, velocity, effort, pwm = wanted
        here, rows = ~self._no_servo, self._servo_rows
        mode = self.servo_states.mode[rows]
        goal = self._times(self._inverse, position) + self._fade * self._offset
        to.position[rows[here]] = goal[here]
        self._divide_speeds(position, velocity)
        speed = np.where(mode == Mode.VELOCITY, self._times(self._inverse, velocity), self._speeds)
        to.velocity[rows[here]] = speed[here]
        across = self._matrix.transpose(0, 2, 1)
        most = self._times(np.abs(across), np.abs(effort))
        torque = np.where(mode == Mode.EFFORT, self._times(across, effort), most)
        to.effort[rows[here]] = torque[here]
        # A PWM goal is the same for all servos of one joint, and undefined for a transmission.
        to.pwm[rows[here]] = np.where(self._single, pwm[:, :1], np.nan).repeat(rows.shape[1], axis=1)[here]

    def _divide_speeds(self, position: Floats, velocity: Floats) -> None:
        """Compute servo speeds for position goals such that all servos of a coupling arrive at the same time.

        The speed next to a position goal is the joint's speed on its way. The duration is that of the slowest
        joint, and each servo gets the speed with which its own way takes that long.
        """
        same = _same(position, self._last_goal) & _same(velocity, self._last_speed)
        changed = ~np.all(same, axis=1)
        if not changed.any():
            return
        present = self.states.position[self._joint_rows]
        way = np.where(np.isfinite(present), position - present, 0.0)
        way[self._no_joint] = 0.0
        together = self._times(np.abs(self._inverse), np.abs(velocity))
        with np.errstate(divide="ignore", invalid="ignore"):
            # A joint without a speed moves as fast as the other joints permit.
            time = np.nanmax(np.where(way == 0.0, 0.0, np.abs(way) / np.abs(velocity)), axis=1, initial=0.0)
            own = np.abs(self._times(self._inverse, way)) / time[:, None]
        own = np.where((time == 0.0)[:, None] | self._single, together, np.fmax(own, _LEAST_SHARE * together))
        self._speeds[changed] = own[changed]
        self._last_goal[changed] = position[changed]
        self._last_speed[changed] = velocity[changed]

    def joint_requests(self, requested: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Convert requested modes of joints into modes of servos; UNKNOWN: no change.

        The joints of one coupling must have one mode: a request that would leave one of them in another mode
        is ignored.
        """
        modes = np.zeros(len(self.servo_states.mode), dtype=np.uint8)
        modes[self._direct_servos] = requested[self._direct_joints]
        for rows, servos, none, absent in zip(
            self._joint_rows, self._servo_rows, self._no_joint, self._no_servo, strict=True
        ):
            here = rows[~none]
            wanted = {
                *np.where(requested[here] == Mode.UNKNOWN, self.states.mode[here], requested[here]).tolist()
            }
            if len(wanted) == 1 and requested[here].any():
                modes[servos[~absent]] = wanted.pop()
        return modes

    @staticmethod
    def _times(matrices: Floats, vectors: Floats) -> Floats:
        """Multiply each coupling's matrix with its vector; shape (..., couplings, rows)."""
        product: Floats = np.matmul(matrices, vectors[..., None])[..., 0]
        return product


def _same(one: Floats, other: Floats) -> NDArray[np.bool_]:
    """Compare elements of two arrays; NaN equals NaN."""
    same: NDArray[np.bool_] = (one == other) | (np.isnan(one) & np.isnan(other))
    return same
