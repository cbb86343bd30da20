"""Joint requests: torque, reboots and registers of single joints, as clients request them of a running loop.

Decided by the record of the cycle that takes them, so that a replay decides alike; carried out by the
hardware in idle time, and answered when that has come to an end.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import msgspec

from dxlrun.channels.answers import Answer, Code, Done, Refusal, Waiting
from dxlrun.channels.cycle import LIMP, OFFLINE, Torque
from dxlrun.channels.loop_requests import RebootRequest, Register, RegisterReading, TorqueRequest
from dxlrun.control.context import ControlContext
from dxlrun.control.controllers.switching import Switching


class _Pending(msgspec.Struct):
    """A request for several joints that is not answered yet."""

    code: Code
    """Of the refusal, where a servo did not do it."""
    left: int
    """Joints that are not answered."""
    joints: list[str] = msgspec.field(default_factory=list)
    problems: list[str] = msgspec.field(default_factory=list)
    deactivated: tuple[str, ...] = ()
    """Controllers that commanded the joints."""


class JointRequests:
    """Decides on requests for joints, hands them to the hardware, and answers them."""

    def __init__(
        self, context: ControlContext, switching: Switching, answer: Callable[[int, Answer], None]
    ) -> None:
        """`answer` sends a client an answer, by the number of its command."""
        self._joints = context.plan.joints
        self._rows = {joint.name: row for row, joint in enumerate(self._joints)}
        self._hardware = context.hardware
        self._record = context.record
        self._switching = switching
        self._answer = answer
        self._pending: dict[int, _Pending] = {}

    def execute_request(
        self, number: int, request: TorqueRequest | RebootRequest | Register | RegisterReading
    ) -> Refusal | None:
        """Execute a request by its command's number; None: it is answered later.

        What is about several joints is done to all of them, or to none.
        """
        match request:
            case TorqueRequest():
                return self._torque(number, request)
            case RebootRequest():
                return self._reboot(number, request)
        row = request.row
        if row is None:
            rows = self._known((request.joint,))
            if isinstance(rows, Refusal):
                return rows
            row = rows[request.joint]
        if isinstance(request, Register):
            done = partial(self._answer_register, number, Code.REGISTER_NOT_WRITTEN)
            self._hardware.set_register(row, request.item, request.value, done)
        else:
            done = partial(self._answer_register, number, Code.REGISTER_NOT_READ)
            self._hardware.read_register(row, request.item, done)
        return None

    def _torque(self, number: int, request: TorqueRequest) -> Refusal | None:
        rows = self._known(request.joints)
        if isinstance(rows, Refusal):
            return rows
        if request.on:
            if refusal := self._refuse_lost(rows) or self._refuse_broken(rows):
                return refusal
            names = self._switching.commanding(self._limp(rows)) if request.release else ()
            released = self._release(rows, names, request.release)
        else:
            released = self._release(rows, self._switching.stopped_by(rows), request.release)
        if isinstance(released, Refusal):
            return released
        if request.on:
            self._switching.released.difference_update(rows.values())
        else:
            self._switching.released.update(rows.values())
        for row, done in self._await(number, Code.TORQUE_NOT_SWITCHED, rows, released):
            self._hardware.switch_torque(row, request.on, done)
        return None

    def _reboot(self, number: int, request: RebootRequest) -> Refusal | None:
        rows = self._known(request.joints)
        if isinstance(rows, Refusal):
            return rows
        names = self._switching.commanding(rows)
        released = self._refuse_lost(rows) or self._release(rows, names, request.release)
        if isinstance(released, Refusal):
            return released
        for row, done in self._await(number, Code.NOT_REBOOTED, rows, released):
            self._hardware.reboot(row, done)
        return None

    def _await(
        self, number: int, code: Code, rows: dict[str, int], released: tuple[str, ...]
    ) -> list[tuple[int, Callable[[str], None]]]:
        """Let a client wait; return the rows, each with what takes what came of it."""
        pending = self._pending[number] = _Pending(code, len(rows), deactivated=released)
        self._answer(number, Waiting(()))
        return [(row, partial(self._done, number, pending, joint)) for joint, row in rows.items()]

    def end(self) -> None:
        """Answer what the run's end interrupts."""
        for number in self._pending:
            self._answer(number, Refusal(Code.RUN_ENDING))
        self._pending.clear()

    # Inside

    def _known(self, joints: Sequence[str]) -> dict[str, int] | Refusal:
        """Return the rows of joints, with those that the same servos move: what is done to one is done to
        all."""
        unknown = tuple(joint for joint in joints if joint not in self._rows)
        if unknown or not joints:
            return Refusal(Code.UNKNOWN_JOINT, {"joint": unknown})
        together = (name for joint in joints for name in self._joints[self._rows[joint]].coupled)
        return {name: self._rows[name] for name in (*joints, *together)}

    def _refuse_lost(self, rows: dict[str, int]) -> Refusal | None:
        torque = self._record.states.torque
        lost = tuple(joint for joint, row in rows.items() if torque[row] in OFFLINE)
        if not lost:
            return None
        reboots = all(torque[rows[joint]] == Torque.REBOOTING for joint in lost)
        hint = "try again when it is back; it is probed once a second"
        if reboots:
            hint = "it reboots as requested: try again when it is back"
        return Refusal(Code.JOINT_LOST, {"joint": lost, "servo": self._labels(lost), "hint": hint})

    def _refuse_broken(self, rows: dict[str, int]) -> Refusal | None:
        states = self._record.states
        broken = tuple(
            joint for joint, row in rows.items() if states.hardware_error[row] and states.torque[row] in LIMP
        )
        if not broken:
            return None
        hint = f"find the cause, then `dxlrun reboot {' '.join(broken)}` (Protocol 1.0: power off and on)"
        return Refusal(Code.HARDWARE_ERROR, {"joint": broken, "servo": self._labels(broken), "hint": hint})

    def _labels(self, joints: Sequence[str]) -> tuple[str, ...]:
        return tuple(self._joints[self._rows[joint]].label for joint in joints)

    def _limp(self, rows: dict[str, int]) -> dict[str, int]:
        torque = self._record.states.torque
        return {joint: row for joint, row in rows.items() if torque[row] in LIMP}

    def _release(
        self, rows: dict[str, int], names: tuple[str, ...], release: bool
    ) -> tuple[str, ...] | Refusal:
        """Deactivate controllers that command joints and return them, or refuse because of them."""
        if not names:
            return ()
        if release:
            answer = self._switching.switch_controllers((), names)
            return answer if isinstance(answer, Refusal) else names
        joints = tuple(
            joint for joint in rows if not set(names).isdisjoint(self._switching.commanding((joint,)))
        )
        return Refusal(Code.JOINT_COMMANDED, {"joint": joints, "controller": names})

    def _done(self, number: int, pending: _Pending, joint: str, problem: str) -> None:
        """Take what came of one joint's request; the last one answers, until then the client waits on."""
        pending.left -= 1
        if problem:
            pending.joints.append(joint)
            pending.problems.append(problem)
        if self._pending.get(number) is not pending:
            return  # the run's end has answered it
        if pending.left:
            self._answer(number, Waiting(()))
            return
        del self._pending[number]
        answer: Answer = Done(self._record.cycle, deactivated=pending.deactivated)
        if pending.problems:
            problems = "; ".join(dict.fromkeys(pending.problems))  # joints of a transmission have the same
            answer = Refusal(pending.code, {"joint": tuple(pending.joints), "problem": problems})
        self._answer(number, answer)

    def _answer_register(self, number: int, code: Code, problem: str, found: int | None) -> None:
        """Answer when the servo has a register, or what it has was read, or when that failed."""
        refusal = Refusal(code, {"problem": problem}) if problem else None
        self._answer(number, refusal or Done(self._record.cycle, value=found))
