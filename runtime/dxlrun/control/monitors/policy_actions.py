"""Policy actions: what monitors can do to a running robot when a policy requires it."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import TYPE_CHECKING

from dxlrun.channels.event_records import EventBody
from dxlrun.plan.policy_plan import PolicyPlan

if TYPE_CHECKING:  # `check` shows the policies and needs nothing of the run
    from dxlrun.control.context import ControlContext
    from dxlrun.control.controllers.manager import Manager
    from dxlrun.control.gate import Gate


class PolicyActions:
    """Actions for monitors and steering: end the run, disable torque, hold controllers, report an event."""

    def __init__(self, context: ControlContext, manager: Manager, gate: Gate) -> None:
        self.policies: PolicyPlan = context.plan.policies
        self.ending: tuple[str, str] | None = None
        """Name of the policy that ends the run after this cycle, and the reason as text; None: the run
        continues.
        """
        self._context = context
        self._manager = manager
        self._gate = gate
        self._held: dict[int, Collection[int]] = {}
        """Rows of the joints whose controllers each monitor holds, by the monitor's `id`."""

    def end_run(self, policy: str, why: str) -> None:
        """End the run after this cycle by the named policy, not on_exit.

        Only the first call has an effect.
        """
        if self.ending is None:
            self.ending = policy, f"{why}; {policy}: {self.policies.named(policy).text}"

    def make_limp(self, rows: Iterable[int]) -> None:
        """Disable the torque of joints until a client enables it."""
        for row in sorted(rows):
            self._context.hardware.switch_torque(row, False, _ignore_answer)

    def hold_controllers(self, holder: object, rows: Collection[int], until: str) -> None:
        """Hold the controllers of these joints only.

        Controllers that no monitor holds any more resume slowly.

        Args:
            holder: The monitor. It can release only joints that it holds itself.
            rows: Rows of all joints that the monitor holds now.
            until: End of the hold as a clause for events: `all its joints answer again`.
        """
        self._held[id(holder)] = rows
        self._gate.ease_in(self._manager.hold_lost(frozenset().union(*self._held.values()), until))

    def report(self, event: EventBody, *, source: str = "loop") -> None:
        """Emit an event about an action of a policy."""
        self._context.events.emit_event(source, event)


def _ignore_answer(problem: str) -> None:
    """Ignore the result of a servo request: no client waits for it, and events report failures."""
