"""Overrun: who decides what becomes of deadlines that passed while a cycle was late."""

from __future__ import annotations

from typing import cast, get_args

from dxlrun.control.controllers.plugins import OverrunHook
from dxlrun.control.loop_plan import OverrunPolicy
from dxlrun.run.channels.events import EventCode, EventSink, Severity


class Overruns:
    """Asks the plug-ins in turn, and goes by the robot file where none has an answer.

    A hook that raises, or answers with something else, is told in an event and never asked again.
    """

    __slots__ = ("_events", "_hooks", "_policy")

    def __init__(self, policy: OverrunPolicy, hooks: tuple[OverrunHook, ...], events: EventSink) -> None:
        self._policy = policy
        self._hooks = list(hooks)
        self._events = events

    def decide(self, cycle: int, scheduled_ns: int, actual_ns: int) -> OverrunPolicy:
        """Return the policy for a cycle that was due at `scheduled_ns` and can begin at `actual_ns`."""
        for hook in tuple(self._hooks):
            try:
                answer = hook.decide(cycle, scheduled_ns, actual_ns)
            except (Exception, SystemExit) as error:  # foreign code: it must not take the loop along
                self._dismiss(hook, f"raised {type(error).__name__}: {error}")
                continue
            if answer is None:
                continue
            if isinstance(answer, str) and answer in get_args(OverrunPolicy):
                return cast("OverrunPolicy", answer)
            self._dismiss(hook, f"returned {answer!r}, which is none of {', '.join(get_args(OverrunPolicy))}")
        return self._policy

    def _dismiss(self, hook: OverrunHook, why: str) -> None:
        self._hooks.remove(hook)
        self._events.emit(
            EventCode.OVERRUN,
            Severity.ERROR,
            hook.plugin,
            f"dxlrun_overrun {why}; it is not asked again in this run",
        )
