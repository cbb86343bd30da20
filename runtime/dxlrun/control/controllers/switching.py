"""Switching: which controllers are active; one that breaks its contract leaves, and a fallback takes over."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import msgspec

from dxlrun.channels.answers import Code, CommandOutcome, Refusal, Waiting
from dxlrun.channels.events import EventCode, EventSink, Severity
from dxlrun.control.controllers.claims import Step, request_step, switch_step, takeover_step
from dxlrun.control.controllers.graph import above, lowers_first, uppers_first
from dxlrun.control.controllers.managed import Managed
from dxlrun.control.controllers.mode_switch import Group, ModeSwitch
from dxlrun.errors import ControllerFault
from dxlrun.plan.loop_plan import ControllerPlan

_Failed = tuple[tuple[Managed, ...], str]
"""A controller that broke its contract, those that left with it, and why; not the fault itself, which holds
a frame: the collector is off, so such a circle would stay."""


class Switching:
    """Activates and deactivates controllers; a chain enters from below and leaves from above, in one step.

    `fault` is None, or why the run is to end: the sentence of the first controller that requested it, or that
    broke its contract and for which no other one took over.
    """

    def __init__(
        self,
        modes: ModeSwitch,
        events: EventSink,
        refuse_limp: Callable[[Sequence[str]], Refusal | None],
    ) -> None:
        """`refuse_limp` refuses controllers that would command joints without torque."""
        self.fault: str | None = None
        self.named: dict[str, Managed] = {}
        """The controllers that are loaded."""
        self.ended: list[tuple[int, Refusal | None]] = []
        """Switches that waited and have ended: the command's number, and why not; for the loop to answer."""
        self._modes = modes
        self._refuse_limp = refuse_limp
        self._events = events

    @property
    def known(self) -> dict[str, ControllerPlan]:
        """The plans of the loaded controllers."""
        return {name: managed.plan for name, managed in self.named.items()}

    @property
    def active(self) -> dict[str, ControllerPlan]:
        """The plans of the active controllers."""
        return {name: managed.plan for name, managed in self.named.items() if managed.active}

    @property
    def waiting(self) -> dict[str, ControllerPlan]:
        """The plans of those that are active as soon as their joints are in their modes."""
        return {managed.plan.name: managed.plan for managed in self._modes.entering}

    def start(self, time_ns: int) -> None:
        """Activate the controllers that are active from the start."""
        names = [name for name, managed in self.named.items() if managed.plan.active and not managed.active]
        enter = [name for name in lowers_first(names, self.known) if name in names]
        self._enter(enter, time_ns, None, "")

    def planned(self, activate: Sequence[str], deactivate: Sequence[str]) -> Step | Refusal:
        """Return what a switch of these controllers does, with those below, or why it is refused."""
        return switch_step(activate, deactivate, self.known, self.active, self.waiting)

    def admit(self, time_ns: int) -> None:
        """Activate controllers whose modes are there now; give up those that waited too long."""
        ready, late = self._modes.due(time_ns)
        failed: list[_Failed] = []
        for group in ready:
            self._end_switch(group.number, self._activate_all(group.entering, time_ns, failed))
        for group in late:
            problem = self._modes.problem(group)
            self._give_up(
                group,
                Refusal(Code.MODE_NOT_ENTERED, {"controller": group.names, "problem": problem}),
                problem,
            )
        self._fall_back_all(failed, time_ns)

    def end(self, managed: Managed, fault: ControllerFault, time_ns: int) -> None:
        """Take a controller that broke its contract out of the robot, and let a fallback take over.

        Those above it leave too. Its own fallback comes first, then theirs, the nearest first. One that waits
        for modes waits no more, and the command that asked for it is refused.
        """
        self._fall_back(self._take_out_with_uppers(managed, fault, time_ns), str(fault), time_ns)

    def take_over(self, requester: str, names: Sequence[str], why: str, time_ns: int) -> None:
        """Let controllers take over because another one requests it, or report why they do not."""
        step = request_step(names, self.known, self.active, self.waiting)
        if isinstance(step, Step) and not step.enter:
            return
        taken, verb = " and ".join(names), "take" if names[1:] else "takes"
        refusal = step if isinstance(step, Refusal) else self._refuse_limp(step.enter)
        if isinstance(step, Refusal) or refusal is not None:
            reason = "" if refusal is None else refusal.text
            text = f"takeover by {taken} refused: {reason} (requested because of {why})"
            self.report_refusal(requester, text, CommandOutcome("switch", requester, refusal))
            return
        instead = f" from {', '.join(step.leave)}" if step.leave else ""
        text = f"{taken} {verb} over{instead}: {why}"
        self._events.emit(EventCode.TAKEOVER, Severity.WARNING, requester, text)
        self.take(step, time_ns, None, f"{requester}: {why}")

    def end_run(self, requester: str, why: str) -> None:
        """End the run behind this cycle, by the policy for faults."""
        self.fault = self.fault or f"controller {requester} ended the run: {why}"

    def _take_out_with_uppers(
        self, managed: Managed, fault: ControllerFault, time_ns: int
    ) -> tuple[Managed, ...]:
        """Take out one that broke its contract, and those above it; return them, the nearest first."""
        uppers = [self.named[name] for name in above(self._engaged(), managed.plan.name)]
        self.take_out(managed, fault)
        self._drop_group(managed, str(fault))
        why = f"{managed.plan.name}, whose references it commands, broke its contract"
        for upper in reversed(uppers):
            if upper.active:
                self._deactivate(upper, time_ns, why)
            else:
                self._drop_group(upper, why)
        return (managed, *uppers)

    def take_out(self, managed: Managed, fault: ControllerFault) -> None:
        """Take a controller that broke its contract out of the robot, and nothing else."""
        managed.release(str(fault))
        self._modes.changed()
        text = "\n".join([str(fault), *getattr(fault, "__notes__", ())])
        self._events.emit(EventCode.CONTROLLER_FAULT, Severity.ERROR, managed.plan.name, text)
        managed.failed = True

    def deactivate_all(self, time_ns: int) -> None:
        """Deactivate all controllers, those above first, else the last one first; raises nothing."""
        for name in uppers_first(tuple(reversed(self.active)), self.known):
            self._deactivate(self.named[name], time_ns, "the run ended")
        for number in self._modes.end():
            self._end_switch(number, Refusal(Code.RUN_ENDING))

    def report_refusal(self, controller: str, text: str, outcome: CommandOutcome) -> None:
        """Leave in the log that a command was refused."""
        data = msgspec.json.encode(outcome)
        self._events.emit(EventCode.COMMAND_REFUSED, Severity.WARNING, controller, text, data)

    # Inside

    def _engaged(self) -> list[ControllerPlan]:
        return [*self.active.values(), *self.waiting.values()]

    def _end_switch(self, number: int | None, refusal: Refusal | None) -> None:
        if number is not None:
            self.ended.append((number, refusal))

    def take(self, step: Step, time_ns: int, number: int | None, why: str = "") -> Refusal | Waiting | None:
        """Deactivate and activate controllers as planned; None: it is done (see Manager.switch).

        `why`: the fault for which these take over; empty: they were asked for.
        """
        for managed in (self.named[name] for name in step.leave):
            if managed.active:
                self._deactivate(managed, time_ns)
            else:
                refusal = Refusal(Code.SWITCHED_AGAIN, {"controller": managed.plan.name})
                self._end_switch(self._modes.drop(managed), refusal)
        return self._enter(step.enter, time_ns, number, why)

    def _enter(
        self, names: Sequence[str], time_ns: int, number: int | None, why: str
    ) -> Refusal | Waiting | None:
        """Activate controllers whose claims were checked together, at once or when their modes are there.

        `why`: the fault of the controller that these stand in for; empty: they were asked for.
        """
        entering = [self.named[name] for name in names]
        self._modes.changed()
        if self._modes.ready(entering):
            failed: list[_Failed] = []
            refusal = self._activate_all(entering, time_ns, failed)
            self._fall_back_all(failed, time_ns)
            return refusal
        self._modes.await_modes(entering, time_ns, number, why)
        for managed in entering:
            self._log(EventCode.MODE, managed, "waits until its joints are in their modes")
        return Waiting(tuple(names))

    def _activate_all(
        self, entering: Sequence[Managed], time_ns: int, failed: list[_Failed]
    ) -> Refusal | None:
        """Activate controllers whose claims were checked together; add what fails to `failed`.

        Their fallbacks come when all have entered: one that came before could have a joint that belongs to
        another. Returns the first fault; the other controllers are active all the same, but for those above.
        """
        begun = len(failed)
        plans = [managed.plan for managed in entering]
        for managed in entering:
            missing = [name for name in managed.plan.into if name not in self.active]
            if missing:
                why = f"{missing[0]}, whose references it commands, is not active"
                self._report_left_out(managed, why)
                continue
            try:
                managed.activate(time_ns)
            except ControllerFault as fault:
                self.take_out(managed, fault)
                uppers = [self.named[name] for name in above(plans, managed.plan.name)]
                failed.append(((managed, *uppers), str(fault)))
            else:
                self._log(EventCode.CONTROLLER_ACTIVATED, managed, "active")
                self._command_lowers(managed, time_ns, failed)
        if len(failed) == begun:
            return None
        taken, why = failed[begun]
        return refused_by(taken[0], why)

    def _command_lowers(self, upper: Managed, time_ns: int, failed: list[_Failed]) -> None:
        """End what clients had those below do: from now on this one commands them."""
        for lower in (self.named[name] for name in upper.plan.into):
            try:
                lower.follow(time_ns)
            except ControllerFault as fault:
                failed.append((self._take_out_with_uppers(lower, fault, time_ns), str(fault)))

    def _fall_back_all(self, failed: Sequence[_Failed], time_ns: int) -> None:
        for taken, why in failed:
            self._fall_back(taken, why, time_ns)

    def _report_left_out(self, managed: Managed, why: str) -> None:
        name = managed.plan.name
        refusal = Refusal(Code.CONTROLLER_FAULT, {"controller": name, "problem": why})
        self.report_refusal(name, f"{name} is not activated: {why}", CommandOutcome("switch", "", refusal))

    def _drop_group(self, managed: Managed, why: str) -> None:
        for group in self._modes.groups:
            if managed in group.entering:
                self._modes.give_up(group)
                problem = f"{managed.plan.name} is not activated: {why}"
                refusal = Refusal(
                    Code.CONTROLLER_FAULT, {"controller": managed.plan.name, "problem": problem}
                )
                self._give_up(group, refusal, why)
                return

    def _give_up(self, group: Group, refusal: Refusal, problem: str) -> None:
        self._end_switch(group.number, refusal)
        for name in group.names:
            text = f"{name} is not activated: {problem}"
            self.report_refusal(name, text, CommandOutcome("switch", "", refusal))
        self.fault = self.fault or group.why or None

    def _deactivate(self, managed: Managed, time_ns: int, why: str = "") -> None:
        self._modes.changed()
        try:
            managed.deactivate(time_ns, why)
        except ControllerFault as fault:
            self.take_out(managed, fault)  # without a fallback: it was leaving anyway
            self.fault = self.fault or str(fault)
        else:
            self._log(EventCode.CONTROLLER_DEACTIVATED, managed, "inactive")

    def _fall_back(self, taken: Sequence[Managed], why: str, time_ns: int) -> None:
        """Let the first fallback of these take over that can, else the policy for faults applies.

        None can that broke its own contract before: two that fall back on each other would do so for ever.
        Nor one for joints without torque.
        """
        names = [managed.plan.name for managed in taken]
        failed = {name for name, managed in self.named.items() if managed.failed}
        for fallback in (managed.plan.fallback for managed in taken):
            if fallback not in self.named:
                continue
            step = takeover_step(fallback, names, self.known, self.active, self.waiting, failed)
            if step is None:
                continue
            refusal = self._refuse_limp(step.enter)
            if refusal is None:
                self.take(step, time_ns, None, why)
                return
            text = f"{fallback} does not take over: {refusal.text}"
            self.report_refusal(fallback, text, CommandOutcome("switch", "", refusal))
        self.fault = self.fault or why

    def _log(self, code: EventCode, managed: Managed, text: str) -> None:
        self._events.emit(code, Severity.INFO, managed.plan.name, text)


def refused_by(managed: Managed, problem: str) -> Refusal:
    """Return the refusal of a command that a controller broke its contract with."""
    return Refusal(Code.CONTROLLER_FAULT, {"controller": managed.plan.name, "problem": problem})
