"""Joint requests: client requests for torque, reboots and registers of single joints of a running loop.

The record of the cycle that receives a request decides about it, so a replay makes the same decision. The
hardware executes the request in idle time, and the answer follows after that.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import msgspec

from dxlrun.channels.answers import Acceptance, Answer, Code, Completion, Refusal
from dxlrun.channels.cycle import LIMP, OFFLINE, Torque
from dxlrun.channels.loop_requests import RebootRequest, Register, RegisterReading, TorqueRequest
from dxlrun.control.context import ControlContext
from dxlrun.control.controllers.changed_registers import ChangedRegisters
from dxlrun.control.controllers.switching import Switching


class _PendingRequest(msgspec.Struct):
    """A torque or reboot request that waits for the results of its joints."""

    code: Code
    """Code of the refusal that the client gets if any servo fails."""
    left: int
    """Number of joints whose result is missing."""
    joints: list[str] = msgspec.field(default_factory=list)
    problems: list[str] = msgspec.field(default_factory=list)
    deactivated: tuple[str, ...] = ()
    """Controllers that commanded the joints and were deactivated for the request."""


class JointRequests:
    """Passes client requests for torque, reboots and registers to the hardware, and answers them.

    Args:
        context: The run.
        switching: Deactivates controllers that command the joints.
        registers: Registers that controllers change.
        answer: Sends the answer to a command, by the command's number.
    """

    def __init__(
        self,
        context: ControlContext,
        switching: Switching,
        registers: ChangedRegisters,
        answer: Callable[[int, Answer], None],
    ) -> None:
        self._joints = context.plan.joints
        self._rows = {joint.name: row for row, joint in enumerate(self._joints)}
        self._hardware = context.hardware
        self._record = context.record
        self._switching = switching
        self._registers = registers
        self._answer = answer
        self._pending: dict[int, _PendingRequest] = {}

    def execute_request(
        self, number: int, request: TorqueRequest | RebootRequest | Register | RegisterReading
    ) -> Refusal | None:
        """Check a request and pass it to the hardware.

        With several joints, it applies to all of them or to none.

        Args:
            number: Number of the client's command.
            request: The request.

        Returns:
            The refusal; None if the request is answered later.
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
            done = partial(self._finish_write, number, row, request)
            self._hardware.write_register(row, request.item, request.value, done)
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
            self._hardware.reboot_servo(row, done)
        return None

    def _await(
        self, number: int, code: Code, rows: dict[str, int], released: tuple[str, ...]
    ) -> list[tuple[int, Callable[[str], None]]]:
        """Answer `Acceptance` to a request; return each joint's row with the callback for its result."""
        pending = self._pending[number] = _PendingRequest(code, len(rows), deactivated=released)
        self._answer(number, Acceptance(()))
        return [(row, partial(self._done, number, pending, joint)) for joint, row in rows.items()]

    def refuse_pending(self) -> None:
        """Refuse the pending torque and reboot requests because the run ends."""
        for number in self._pending:
            self._answer(number, Refusal(Code.RUN_ENDING))
        self._pending.clear()

    # Inside

    def _known(self, joints: Sequence[str]) -> dict[str, int] | Refusal:
        """Return the rows of the joints and of all joints that the same servos move; refuse unknown names."""
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
        hint = "try again when it answers; dxlrun probes it once a second"
        if reboots:
            hint = "it is rebooting, as requested; try again when it answers"
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
        """Deactivate the named controllers and return their names.

        Refuse if the client does not allow that.

        Args:
            rows: Rows of the joints by name.
            names: Controllers that command the joints.
            release: Whether the client allows the deactivation.
        """
        if not names:
            return ()
        if release:
            answer = self._switching.switch_controllers((), names)
            return answer if isinstance(answer, Refusal) else names
        joints = tuple(
            joint for joint in rows if not set(names).isdisjoint(self._switching.commanding((joint,)))
        )
        return Refusal(Code.JOINT_COMMANDED, {"joint": joints, "controller": names})

    def _done(self, number: int, pending: _PendingRequest, joint: str, problem: str) -> None:
        """Store the result for one joint; an empty problem is a success.

        The last result answers the request.
        """
        pending.left -= 1
        if problem:
            pending.joints.append(joint)
            pending.problems.append(problem)
        if self._pending.get(number) is not pending:
            return  # answered by the end of the run
        if pending.left:
            self._answer(number, Acceptance(()))
            return
        del self._pending[number]
        answer: Answer = Completion(self._record.cycle, deactivated=pending.deactivated)
        if pending.problems:
            # Joints of one transmission report the same problem, which is named once.
            problems = "; ".join(dict.fromkeys(pending.problems))
            answer = Refusal(pending.code, {"joint": tuple(pending.joints), "problem": problems})
        self._answer(number, answer)

    def _finish_write(
        self, number: int, row: int, request: Register, problem: str, found: int | None
    ) -> None:
        if not problem:
            self._registers.keep_value(row, request.item, request.value)
        self._answer_register(number, Code.REGISTER_NOT_WRITTEN, problem, found)

    def _answer_register(self, number: int, code: Code, problem: str, found: int | None) -> None:
        """Answer a register request with the value read, None after a write, or with the problem."""
        refusal = Refusal(code, {"problem": problem}) if problem else None
        self._answer(number, refusal or Completion(self._record.cycle, value=found))
