"""Policy actions: everything that a policy may do to a running robot."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import TYPE_CHECKING

from dxlrun.channels.events import EventCode, Severity
from dxlrun.plan.policy_plan import PolicyPlan

if TYPE_CHECKING:  # `check` shows the policies and needs nothing of the run
    from dxlrun.control.context import ControlContext
    from dxlrun.control.controllers.manager import Manager
    from dxlrun.control.gate import Gate


class PolicyActions:
    """End the run, take torque from joints, hold controllers, report."""

    def __init__(self, context: ControlContext, manager: Manager, gate: Gate) -> None:
        self.policies: PolicyPlan = context.plan.policies
        self.ending: tuple[str, str] | None = None
        """The policy by which the run ends after this cycle, and a sentence; None: it goes on."""
        self._context = context
        self._manager = manager
        self._gate = gate
        self._held: dict[type, Collection[int]] = {}
        """Rows of the joints whose controllers are held, by the monitor that holds them."""

    def end_run(self, policy: str, why: str) -> None:
        """End the run after this cycle, by another policy than on_exit; the first reason counts."""
        if self.ending is None:
            self.ending = policy, f"{why}; {policy}: {self.policies.named(policy).text}"

    def make_limp(self, rows: Iterable[int]) -> None:
        """Switch the torque of joints off until a client requests it."""
        for row in sorted(rows):
            self._context.hardware.switch_torque(row, False, _ignore_answer)

    def hold_controllers(self, holder: object, rows: Collection[int], until: str) -> None:
        """Hold the controllers of these joints, and let those continue slowly that no monitor holds any more.

        Args:
            holder: The monitor itself. It releases only the joints that it holds itself.
            rows: Rows of all joints that the monitor holds now; the other joints are free of it.
            until: What ends that, as a clause of all joints of a controller: `all its joints answer again`.
        """
        self._held[type(holder)] = rows
        self._gate.ease_in(self._manager.hold_lost(frozenset().union(*self._held.values()), until))

    def report(
        self, severity: Severity, text: str, *, source: str = "loop", code: EventCode = EventCode.POLICY
    ) -> None:
        """Report what a policy does, in an event."""
        self._context.events.emit(code, severity, source, text)


def _ignore_answer(problem: str) -> None:
    """Ignore what came of a request for a servo: no client waits for it, and events report it."""
