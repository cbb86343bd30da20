"""Halt: the client command that stops and holds all joints within their limits while the run continues."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from dxlrun.channels.answers import Acceptance, Answer, Code, Completion, Halted, Refusal
from dxlrun.channels.cycle import LIMP, OFFLINE
from dxlrun.control.context import ControlContext
from dxlrun.control.controllers.switching import Switching
from dxlwire.joint_unit import LINEAR, ROTARY, JointUnit
from dxlwire.modes import Mode

STILL_SPEEDS: Mapping[JointUnit, float] = {ROTARY: 0.1, LINEAR: 0.003}
"""Speed below which a joint counts as at rest, rad/s or m/s. Servos report velocity in steps of 0.024 rad/s
(XM430) or less, with noise of some steps. [i]"""
STILL_NS = 100_000_000
"""Time for which all joints must be at rest, with unchanged goals, before a halt is answered as done."""
HALT_NS = 5_000_000_000
"""Time after which a halt is refused if joints still move. Joints may need that long to change their
modes."""
_HOLDING = (Mode.POSITION, Mode.VELOCITY)
_FREE = (*LIMP, *OFFLINE)
"""Torque states (limp or offline) of joints that a halt ignores: the run does not move them."""


class Halt:
    """Deactivates all controllers that command joints, and watches the joints until they are at rest.

    Without a command, the gate brings goals to rest within `limits.acceleration` and velocities to 0. Joints
    in other modes enter their rest modes, as after any deactivation. The goal of a joint without an
    acceleration limit may be far ahead of a slow servo. While that joint moves toward its goal, its goal is
    set to the measured position.

    Args:
        context: The run.
        switching: Deactivates the controllers.
        answer: Sends the answer to a command, by the command's number.
    """

    def __init__(
        self, context: ControlContext, switching: Switching, answer: Callable[[int, Answer], None]
    ) -> None:
        joints = context.plan.joints
        self._joints = tuple(joint.name for joint in joints)
        self._stops = np.array([joint.acceleration is None for joint in joints], dtype=np.bool_)
        self._still = np.array([STILL_SPEEDS[joint.unit] for joint in joints])
        """Speed below which each joint counts as at rest, rad/s or m/s."""
        self._switching = switching
        self._record = context.record
        self._answer = answer
        self.waiting: list[int] = []
        """Numbers of the `halt` commands that are answered when the joints are at rest."""
        self._began_ns = self._still_ns = 0
        self._before = b""

    def halt_joints(self, number: int) -> Refusal | Acceptance:
        """Deactivate all controllers that command joints, and watch until the joints are at rest.

        Returns `Acceptance`, or the refusal.
        """
        refusal = self._switching.switch_controllers((), self._switching.commanding(self._joints))
        if isinstance(refusal, Refusal):
            return refusal
        self.waiting.append(number)
        self._began_ns = self._still_ns = self._record.woken_ns
        self._before = b""
        self.check_rest()
        return Acceptance(())

    def check_rest(self) -> None:
        """Check if all joints are at rest, and answer the waiting commands when they are or at the timeout.

        Called after a read while commands wait. Rest must last STILL_NS.
        """
        record, now_ns = self._record, self._record.woken_ns
        states, goals = record.states, record.goals
        count = ~np.isin(states.torque, _FREE)
        speed = np.where(count & states.valid, np.abs(states.velocity), 0.0)
        speed = np.nan_to_num(speed)  # a servo that reports no speed is judged by its goals alone
        position = states.mode == Mode.POSITION
        ahead = position & self._stops & (speed > self._still)
        ahead &= (goals.position - states.position) * states.velocity > 0
        np.copyto(goals.position, states.position, where=ahead)
        goal = goals.values[:2, count].tobytes()
        ready = np.isin(states.mode, _HOLDING) & states.valid & (speed <= self._still)
        if goal != self._before or not np.all(ready | ~count):
            self._still_ns = now_ns
        self._before = goal
        row = int(np.argmax(speed / self._still))
        measured = Halted((now_ns - self._began_ns) * 1e-9, self._joints[row], float(speed[row]))
        if now_ns - self._still_ns >= STILL_NS:
            self._answer_waiting(Completion(record.cycle, halted=measured))
        elif now_ns - self._began_ns >= HALT_NS:
            late = tuple(self._joints[index] for index in np.flatnonzero(count & ~ready).tolist())
            self._answer_waiting(
                Refusal(
                    Code.STILL_MOVING,
                    {
                        "joint": late or self._joints[row],
                        "seconds": measured.seconds,
                        "velocity": measured.velocity,
                    },
                )
            )

    def refuse_waiting(self) -> None:
        """Refuse the waiting `halt` commands because the run ends."""
        self._answer_waiting(Refusal(Code.RUN_ENDING))

    def _answer_waiting(self, answer: Answer) -> None:
        for number in self.waiting:
            self._answer(number, answer)
        self.waiting.clear()
