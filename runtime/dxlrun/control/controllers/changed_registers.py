"""Changed registers: values that controllers write into servos for a time, and the values from before.

Writes are the same as those of clients: in idle time, read back, and written again if the servo is reset. A
servo that does not answer gets its newest value when it is back.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial

import msgspec

from dxlrun.channels.cycle import OFFLINE
from dxlrun.control.context import ControlContext
from dxlrun.errors import ControllerFault
from dxlrun.plan.loop_plan import ControllerPlan

RESTORE_NS = 500_000_000
"""Time after which registers of a whole robot have their values from before: three transactions each. [i]"""
Values = Mapping[str, Mapping[str, int | str]]
SetRegisters = Callable[[Values], None]


class _Register(msgspec.Struct):
    """One register of one servo that a controller may change."""

    joint: int  # Row of the joint in the record
    row: int  # Row of the servo in register requests
    item: str
    wanted: int | None = None  # None: the value from before
    owner: str = ""  # Controller that set the wanted value
    before: int | None = None  # None: not changed
    written: int | None = None  # Value that was read back last; None: not known
    is_busy: bool = False
    has_failed: bool = False  # The servo refused; the next attempt follows another request or a loss

    @property
    def due(self) -> int | None:
        """Value to write next; None: the register has its value."""
        value = self.before if self.wanted is None else self.wanted
        return None if value == self.written else value


class ChangedRegisters:
    """Registers of a robot's servos that its controllers change during a run."""

    def __init__(self, context: ControlContext) -> None:
        self._hardware = context.hardware
        self._record = context.record
        self._torque = context.record.states.torque
        self._joints = {joint.name: row for row, joint in enumerate(context.plan.joints)}
        self._registers: dict[tuple[int, str], _Register] = {}
        self._restored_ns = -RESTORE_NS  # Time of the last request for values from before
        self.waiting: list[_Register] = []
        """Registers of servos that did not answer or refused a value; few, and each once."""

    def open_setter(self, plan: ControllerPlan) -> SetRegisters:
        """Return `Context.set_registers` of a controller. Allocates its registers, before real time."""
        written = {(one.joint, one.item, one.value): one.writes for one in plan.registers}
        own: dict[tuple[int, str], _Register] = {}
        for one in plan.registers:
            for row, _ in one.writes:
                register = _Register(self._joints[one.joint], row, one.item)
                own[row, one.item] = self._registers.setdefault((row, one.item), register)
        return partial(self._set, plan.name, written, own)

    def _set(
        self,
        name: str,
        written: Mapping[tuple[str, str, int | str], tuple[tuple[int, int], ...]],
        own: Mapping[tuple[int, str], _Register],
        values: Values,
    ) -> None:
        """Set the registers of a controller to these values, and its others to those from before."""
        wanted: dict[tuple[int, str], int] = {}
        for joint, items in values.items():
            for item, value in items.items():
                if (writes := written.get((joint, item, value))) is None:
                    why = f"{item} = {value} of {joint}, which its interfaces do not name"
                    raise ControllerFault(f"set {why}; add it to `registers`")
                wanted.update(((row, item), raw) for row, raw in writes)
        for key, register in own.items():
            if key in wanted:
                register.wanted, register.owner = wanted[key], name
            elif register.owner == name:
                register.wanted, register.owner = None, ""
                self._restored_ns = self._record.woken_ns
            else:
                continue
            register.has_failed = False
            self._write(register)

    def keep_value(self, row: int, item: str, value: int) -> None:
        """Use a value that a client wrote as the one from before; a later change of a controller replaces it.

        Args:
            row: Row of the joint, or of one servo, in register requests.
            item: Control table item.
            value: Integer on the wire, which was read back.
        """
        for register in self._registers.values():
            if (
                item == register.item
                and row in (register.row, register.joint)
                and register.before is not None
            ):
                register.before = register.written = value

    @property
    def time_left_ns(self) -> int:
        """Time that the last values from before still need, ns; the same in a replay."""
        return max(0, self._restored_ns + RESTORE_NS - self._record.woken_ns)

    def retry(self) -> None:
        """Write the values that wait, once their servos are back."""
        waiting, self.waiting = self.waiting, []
        for register in waiting:
            self._write(register)

    def _write(self, register: _Register) -> None:
        """Write a register's value if it differs, unless a write is under way or the servo is offline."""
        if register.is_busy or (value := register.due) is None:
            return
        is_offline = self._torque[register.joint] in OFFLINE
        register.has_failed &= not is_offline
        if is_offline or register.has_failed:
            if register not in self.waiting:
                self.waiting.append(register)
            return
        register.is_busy = True
        self._hardware.write_register(
            register.row, register.item, value, partial(self._finish_write, register, value)
        )

    def _finish_write(self, register: _Register, value: int, problem: str, found: int | None) -> None:
        register.is_busy = False
        if register.before is None:
            register.before = found
        register.written = None if problem else value
        register.has_failed = bool(problem)
        if register.wanted is None and register.written == register.before:
            register.before = register.written = None
        self._write(register)
