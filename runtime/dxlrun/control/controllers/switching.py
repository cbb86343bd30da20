"""Switching: activate and deactivate controllers, and replace a controller that broke its contract.

A chain of controllers enters from below and leaves from above, in one step. If joints must change their modes
first, all entering controllers wait until all their joints have done so. A claimed joint enters the mode of
its claim. A joint without a claim stays in position or velocity mode, where it holds still; from other modes
it enters its rest mode.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence

import msgspec
import numpy as np
from msgspec.structs import replace

from dxlrun.channels.answers import MOST_NAMED, Acceptance, Code, CommandOutcome, Refusal, list_names
from dxlrun.channels.cycle import LIMP
from dxlrun.channels.event_records import RUN_ENDED, EventBody
from dxlrun.control import texts
from dxlrun.control.context import ControlContext
from dxlrun.control.controllers.claims import ControllerSnapshot, SwitchStep, claimed_modes
from dxlrun.control.controllers.managed import ControllerEvent, ControllerRequest, ManagedController, State
from dxlrun.control.controllers.update_order import above, lowers_first, uppers_first
from dxlrun.errors import ControllerFault
from dxlwire.modes import Mode

MODE_TIMEOUT_NS = 5_000_000_000
"""Time after which controllers that wait for mode changes are dropped. Twenty servos, one after the other in
short idle times, need less than one second; a servo after a reset needs somewhat more. [i]"""
_STILL = (Mode.POSITION, Mode.VELOCITY)
"""Modes in which a joint without commands holds still, so it stays in them when no controller claims it."""

_Failed = tuple[tuple[ManagedController, ...], str]
"""A controller that broke its contract, with the controllers that left with it, and the reason as text. The
exception is not stored: it refers to a frame, and the loop has no collector for reference cycles."""


class ActivationGroup(msgspec.Struct, frozen=True):
    """Controllers that wait for their joints' modes and then become active together."""

    entering: tuple[ManagedController, ...]
    until_ns: int
    """Time, ns of the controllers' time, at which the group is dropped if joints are not in their modes."""
    number: int | None
    """Number of the client's `switch` command to be answered; None: no command requested the switch."""
    why: str
    """Fault of the controller that the group replaces; empty: the switch was requested."""


class Switching:
    """Activates and deactivates the controllers of a run. All times are the controllers' time."""

    def __init__(self, context: ControlContext) -> None:
        self.fault: str | None = None
        """Reason to end the run; None: it continues. Set by the first controller that requested the end or
        broke its contract without a fallback that took over."""
        self.named: dict[str, ManagedController] = {}
        """Loaded controllers by name."""
        self.ended: list[tuple[int, Refusal | None]] = []
        """Answers to `switch` commands that waited for modes: number of the command, and its refusal or None
        for success.
        """
        self.groups: list[ActivationGroup] = []
        """Controllers that wait for their joints' modes, grouped by switch."""
        self.released: set[int] = set()
        """Rows of joints whose torque clients disabled; the states show it only a cycle later."""
        self.modes_requested = True
        """False if the active controllers have changed since modes were last requested from the hardware."""
        self._joints = context.plan.joints
        self._rows = {joint.name: row for row, joint in enumerate(self._joints)}
        self._states = context.record.states
        self._events = context.events
        self._hardware = context.hardware
        self._schedule = context.schedule

    @property
    def standing(self) -> ControllerSnapshot:
        """Snapshot of the loaded controllers and their states."""
        named = self.named.items()
        return ControllerSnapshot(
            {name: managed.plan for name, managed in named},
            {name: managed.plan for name, managed in named if managed.active},
            {name: managed.plan for name, managed in named if managed.state is State.ENTERING},
        )

    def start_controllers(self) -> None:
        """Activate the controllers that the plan marks as active, at the start of the run."""
        known = self.standing.known
        names = [name for name, managed in self.named.items() if managed.plan.active and not managed.active]
        self._enter([name for name in lowers_first(names, known) if name in names], None, "")

    def switch_controllers(
        self, activate: Sequence[str], deactivate: Sequence[str], number: int | None = None, why: str = ""
    ) -> Refusal | Acceptance | None:
        """Deactivate and activate controllers in one step, or refuse the whole switch.

        Claims are checked for the controllers that are active afterwards. If joints must change their modes
        first, controllers leave at once and enter together in the first cycle in which all joints are ready.

        Args:
            activate: Controllers to activate.
            deactivate: Controllers to deactivate. A controller in both lists restarts.
            number: Number of the client's command, for the result in `ended`; None: no command.
            why: Reason for which goals are aborted; empty: the deactivation itself.

        Returns:
            None if the switch is complete, `Acceptance` if it waits for modes, or the refusal.
        """
        step = self.standing.switch(activate, deactivate)
        if isinstance(step, Refusal):
            return step
        return self._refuse_limp(step.enter) or self._execute_step(step, number, why)

    def execute_request(self, request: ControllerRequest) -> None:
        """Execute the request of an active controller: a takeover, or the end of the run after this cycle.

        A refused takeover is reported as an event. The run ends by the policy for faults.
        """
        requester, names, why = request
        if not names:
            self.fault = self.fault or f"controller {requester} ended the run: {why}"
            return
        step = self.standing.request(names)
        if isinstance(step, SwitchStep) and not step.enter:
            return
        refusal = step if isinstance(step, Refusal) else self._refuse_limp(step.enter)
        if isinstance(step, Refusal) or refusal is not None:
            reason = "" if refusal is None else refusal.text
            event = texts.takeover_refused(" and ".join(names), reason, why)
            self._report_left_out(requester, event, refusal, requester)
            return
        self._events.emit_event(requester, texts.controllers_take_over(names, step.leave, why))
        self._execute_step(step, None, f"{requester}: {why}")

    def restart_controllers(self, joints: Collection[str], why: str) -> None:
        """Restart the active controllers that command one of these joints, and the controllers above them.

        Each controller starts from the current positions and goals of its joints. Its goal is aborted. After
        the end of a command stream, commands stay withheld.

        Args:
            joints: Names of the joints.
            why: Reason for the abort; follows the names of the joints in the message.
        """
        again = [managed for name in self.commanding(joints) if (managed := self.named[name]).active]
        withheld = [managed for managed in again if managed.withheld]
        for managed in again:
            # A controller above others may command none of these joints itself.
            own = [joint for joint in managed.plan.joints if joint in joints] or list(joints)
            reason = f"{list_names(own)} {why}"
            self._events.emit_event(managed.plan.name, texts.controller_restarted(reason))
            self._deactivate(managed, reason)
        if self.fault is not None:
            return
        named = {managed.plan.name: managed for managed in again}
        names = [name for name in lowers_first(list(named), self.standing.known) if name in named]
        failed: list[_Failed] = []
        self._activate_all([named[name] for name in names], failed, restarts=True)
        self._fall_back_all(failed)
        for managed in withheld:
            if managed.active:
                managed.hold_joints()

    def end_controller(self, managed: ManagedController, fault: ControllerFault) -> None:
        """Deactivate a controller that broke its contract, and activate a fallback in its place.

        The controllers above it leave too. Its own fallback is tried first, then theirs, the nearest first.
        If the controller waits for modes, the wait ends and the command is refused. An inactive controller
        holds no joints, so it needs no fallback.
        """
        if managed.state is State.INACTIVE:
            self._take_out(managed, fault)
        else:
            self._fall_back(*self._take_out_with_uppers(managed, fault))

    def deactivate_all(self) -> None:
        """Deactivate all controllers at the end of the run, upper ones first, otherwise in reverse order.

        Never raises.
        """
        standing = self.standing
        for name in uppers_first(tuple(standing.active)[::-1], standing.known):
            self._deactivate(self.named[name], RUN_ENDED)
        for group in self.groups:
            self._end_switch(group.number, Refusal(Code.RUN_ENDING))
        self.groups = []
        self.modes_requested = True  # no modes are requested any more

    # Torque

    def commanding(self, joints: Collection[str]) -> tuple[str, ...]:
        """Return the controllers that command one of these joints, directly or through other controllers.

        The result includes active controllers and those that wait for modes, upper ends of chains first.
        """
        engaged = [one.plan for one in self.named.values() if one.state is not State.INACTIVE]
        engaged.sort(key=lambda plan: self.named[plan.name].place)
        found = [
            plan.name for plan in engaged if plan.commands_servos and not set(joints).isdisjoint(plan.joints)
        ]
        for lower in found:  # the body appends to `found`
            found += [plan.name for plan in engaged if lower in plan.into and plan.name not in found]
        return tuple(reversed(found))

    def stopped_by(self, joints: Mapping[str, int]) -> tuple[str, ...]:
        """Return the controllers that must be deactivated if these joints (name: row) lose their torque.

        A `partial` controller can continue while other joints have torque.
        """
        return tuple(
            name
            for name in self.commanding(joints)
            if not self.named[name].plan.partial
            or all(row in joints.values() for row in self._torqued(self.named[name]))
        )

    def _torqued(self, managed: ManagedController) -> list[int]:
        """Return the rows of those joints of a controller that have torque or are about to get it."""
        torque = self._states.torque
        return [row for row in managed.rows.tolist() if row not in self.released and torque[row] not in LIMP]

    def _refuse_limp(self, entering: Sequence[str]) -> Refusal | None:
        """Return a refusal if controllers to be activated command joints without torque, else None."""
        limp: dict[str, str] = {}
        limp_rows: list[int] = []
        names: list[str] = []
        for managed in (self.named[name] for name in entering):
            torqued = self._torqued(managed)
            if managed.plan.commands_servos and not (managed.plan.partial and torqued):
                rows = [row for row in managed.rows.tolist() if row not in torqued]
                limp_rows += [row for row in rows if row not in limp_rows]
                limp.update((self._joints[row].name, self._joints[row].label) for row in rows)
                names += [managed.plan.name] if rows else []
        if not limp:
            return None
        named = list(limp) if len(limp) <= MOST_NAMED else names  # too many joints: name the controllers
        hint = f"switch torque on with `dxlrun torque on {' '.join(named)}`"
        outside = [self._joints[row].name for row in limp_rows if self._is_outside(row)]
        if outside:
            hint = f"move {' and '.join(outside)} inside the limits by hand, then {hint}"
        return Refusal(Code.JOINT_LIMP, {"joint": tuple(limp), "servo": tuple(limp.values()), "hint": hint})

    def _is_outside(self, row: int) -> bool:
        """Return whether a joint is beyond its position limits, where torque is not enabled."""
        joint, position = self._joints[row], float(self._states.position[row])
        return joint.bounded and (position < joint.lower or position > joint.upper)

    # Modes

    def admit_groups(self) -> None:
        """Activate the groups whose joints are in their modes, and drop the groups that cannot be activated.

        A group is dropped after the timeout, or when a joint is in a wrong mode after modes were requested.
        The mode of a joint is `UNKNOWN` during a change, so a known wrong mode means that the change failed.
        """
        ready, late = [], []
        for group in self.groups:
            missing = self._missing(group.entering)
            refused = self.modes_requested and any(now != Mode.UNKNOWN for _, now in missing.values())
            if not missing:
                ready.append(group)
            elif refused or self._schedule.time_ns >= group.until_ns:
                late.append(group)
        self.groups = [group for group in self.groups if group not in ready and group not in late]
        failed: list[_Failed] = []
        for group in ready:
            self._end_switch(group.number, self._activate_all(group.entering, failed))
        for group in late:
            problem = self._mode_problem(group)
            names = tuple(managed.plan.name for managed in group.entering)
            refusal = Refusal(Code.MODE_NOT_ENTERED, {"controller": names, "problem": problem})
            self._give_up(group, refusal, problem)
        self._fall_back_all(failed)

    def request_modes(self) -> None:
        """Ask the hardware for the joint modes that active and waiting controllers need.

        A joint without a claim keeps a mode in which it holds still. From other modes it enters its rest
        mode.
        """
        self.modes_requested = True
        claimed = claimed_modes(self.standing.engaged.values())
        modes = np.zeros(len(self._joints), dtype=np.uint8)
        for row, joint in enumerate(self._joints):
            now = self._states.mode[row]
            mode = claimed.get(joint.name)
            if mode is None:
                mode = Mode(now) if now in _STILL else joint.rest_mode
            if mode != now:
                modes[row] = mode
        if modes.any():
            self._hardware.set_modes(modes)

    def _missing(self, entering: Iterable[ManagedController]) -> dict[str, tuple[Mode, Mode]]:
        """Return required and current mode of each joint in a wrong mode for these controllers, by name."""
        claimed = claimed_modes(managed.plan for managed in entering)
        now = {joint: Mode(int(self._states.mode[self._rows[joint]])) for joint in claimed}
        return {joint: (mode, now[joint]) for joint, mode in claimed.items() if mode != now[joint]}

    def _mode_problem(self, group: ActivationGroup) -> str:
        """Return a text that names a joint which did not enter its mode, and the number of further ones."""
        missing = self._missing(group.entering)
        stays = [
            f"{joint} stays in {_shown(now)} mode instead of {_shown(mode)} mode"
            for joint, (mode, now) in missing.items()
            if now != Mode.UNKNOWN
        ]
        late = [
            f"{joint} did not enter {_shown(mode)} mode within {MODE_TIMEOUT_NS * 1e-9:g} s"
            for joint, (mode, now) in missing.items()
            if now == Mode.UNKNOWN
        ]
        return (stays or late)[0] + (f" (and {len(missing) - 1} more)" if len(missing) > 1 else "")

    def _await_no_more(self, managed: ManagedController) -> ActivationGroup | None:
        """Remove a controller from the group that waits for modes; return the rest of the group.

        None if the controller does not wait.
        """
        for index, group in enumerate(self.groups):
            if managed in group.entering:
                left = tuple(one for one in group.entering if one is not managed)
                self.groups[index] = replace(group, entering=left)
                self.groups = [one for one in self.groups if one.entering]
                return replace(group, entering=left)
        return None

    def _drop_group(self, managed: ManagedController, why: str) -> None:
        """Drop the waiting group that includes this controller, which cannot be activated any more."""
        for group in self.groups:
            if managed in group.entering:
                self.groups = [one for one in self.groups if one is not group]
                problem = texts.controller_not_activated(managed.plan.name, why).text
                self._give_up(group, fault_of(managed, problem), why)

    def _give_up(self, group: ActivationGroup, refusal: Refusal, problem: str) -> None:
        self.modes_requested = False
        self._end_switch(group.number, refusal)
        for managed in group.entering:
            managed.on(ControllerEvent.LEAVE)  # it may have left already
            name = managed.plan.name
            self._report_left_out(name, texts.controller_not_activated(name, problem), refusal)
        self.fault = self.fault or group.why or None

    # Entering and leaving

    def _execute_step(
        self, step: SwitchStep, number: int | None, why: str = ""
    ) -> Refusal | Acceptance | None:
        """Execute a step: deactivate and activate its controllers.

        Returns the same as `switch_controllers`.

        Args:
            step: The controllers that leave and enter.
            number: Number of the client's command; None: no command.
            why: Reason for the step, for aborted goals and failed activations; empty: it was requested.
        """
        for managed in (self.named[name] for name in step.leave):
            if managed.active:
                self._deactivate(managed, why)
                continue
            self.modes_requested = False
            managed.on(ControllerEvent.LEAVE)
            group = self._await_no_more(managed)
            if group is not None and not group.entering:
                self._end_switch(
                    group.number, Refusal(Code.SWITCHED_AGAIN, {"controller": managed.plan.name})
                )
        return self._enter(step.enter, number, why)

    def _enter(self, names: Sequence[str], number: int | None, why: str) -> Refusal | Acceptance | None:
        """Activate controllers with checked claims, now or as soon as their joints are in their modes.

        Returns the same as `switch_controllers`.
        """
        entering = [self.named[name] for name in names]
        self.modes_requested = False
        if not self._missing(entering):
            failed: list[_Failed] = []
            refusal = self._activate_all(entering, failed)
            self._fall_back_all(failed)
            return refusal
        until_ns = self._schedule.time_ns + MODE_TIMEOUT_NS
        self.groups.append(ActivationGroup(tuple(entering), until_ns, number, why))
        for managed in entering:
            managed.on(ControllerEvent.AWAIT)
            self._events.emit_event(managed.plan.name, texts.controller_waits_for_modes())
        return Acceptance(tuple(names))

    def _activate_all(
        self, entering: Sequence[ManagedController], failed: list[_Failed], *, restarts: bool = False
    ) -> Refusal | None:
        """Activate controllers with checked claims, and append those that raise to `failed`.

        The caller activates fallbacks after all controllers have entered. An earlier fallback could take a
        joint that belongs to a controller that has not entered yet.

        Returns:
            The first fault; None without any. Controllers above a failed one are not activated, other ones
            are.
        """
        begun = len(failed)
        for managed in entering:
            name, into = managed.plan.name, managed.plan.into
            lowers = [one for lower in into if (one := self.named.get(lower)) and one.active]
            active = {one.plan.name for one in lowers}
            if missing := [lower for lower in into if lower not in active]:
                managed.on(ControllerEvent.LEAVE)
                problem = f"its lower controller {missing[0]} is not active"
                event = texts.controller_not_activated(name, problem)
                self._report_left_out(name, event, fault_of(managed, problem))
                continue
            try:
                managed.activate(restarts=restarts)
            except ControllerFault as fault:
                self._take_out(managed, fault)
                uppers = above([one.plan for one in entering], name)
                failed.append(((managed, *(self.named[upper] for upper in uppers)), str(fault)))
                continue
            self._events.emit_event(managed.plan.name, texts.controller_activated())
            for lower in (one for one in lowers if one.active):  # commanded by this controller from now on
                try:
                    lower.follow_upper()
                except ControllerFault as fault:
                    failed.append(self._take_out_with_uppers(lower, fault))
        if len(failed) == begun:
            return None
        taken, why = failed[begun]
        return fault_of(taken[0], why)

    def _deactivate(self, managed: ManagedController, why: str = "") -> None:
        self.modes_requested = False
        try:
            managed.deactivate(why)
        except ControllerFault as fault:
            self._take_out(managed, fault)  # no fallback: the controller was to leave anyway
            self.fault = self.fault or str(fault)
        else:
            self._events.emit_event(managed.plan.name, texts.controller_deactivated())

    # Faults

    def _take_out(self, managed: ManagedController, fault: ControllerFault) -> None:
        """Deactivate a controller that broke its contract and report the fault. No fallback is activated."""
        managed.release_commands(ControllerEvent.FAULT, str(fault))
        self.modes_requested = False
        event = texts.controller_failed(str(fault), getattr(fault, "__notes__", ()))
        self._events.emit_event(managed.plan.name, event)

    def _take_out_with_uppers(self, managed: ManagedController, fault: ControllerFault) -> _Failed:
        """Deactivate a controller that broke its contract, and then those above it, the farthest first.

        A group that waits to activate one of them is dropped.

        Returns:
            All these controllers, the failed one first and the farthest last, and the text of the fault.
        """
        engaged = tuple(self.standing.engaged.values())
        uppers = [self.named[name] for name in above(engaged, managed.plan.name)]
        self._take_out(managed, fault)
        self._drop_group(managed, str(fault))
        why = f"its lower controller {managed.plan.name} failed"
        for upper in reversed(uppers):
            if upper.active:
                self._deactivate(upper, why)
            else:
                self._drop_group(upper, why)
        return (managed, *uppers), str(fault)

    def _fall_back_all(self, failed: Sequence[_Failed]) -> None:
        for taken, why in failed:
            self._fall_back(taken, why)

    def _fall_back(self, taken: Sequence[ManagedController], why: str) -> None:
        """Activate the first available fallback of these controllers.

        Without one, end the run with a fault.

        A controller that broke its contract before is not available: two that are each other's fallback would
        alternate forever. Neither is a fallback for joints without torque.
        """
        names = [managed.plan.name for managed in taken]
        failed = {name for name, managed in self.named.items() if managed.failed}
        for fallback in (managed.plan.fallback for managed in taken):
            step = self.standing.fall_back(fallback, names, failed) if fallback in self.named else None
            if step is None:
                continue
            refusal = self._refuse_limp(step.enter)
            if refusal is None:
                self._execute_step(step, None, why)
                return
            self._report_left_out(fallback, texts.fallback_refused(fallback, refusal.text), refusal)
        self.fault = self.fault or why

    # Reports

    def _end_switch(self, number: int | None, refusal: Refusal | None) -> None:
        if number is not None:
            self.ended.append((number, refusal))

    def report_refusal(self, controller: str, event: EventBody, outcome: CommandOutcome) -> None:
        """Emit the event of a refused command, with the command's outcome as JSON data."""
        self._events.emit_event(controller, event, msgspec.json.encode(outcome))

    def _report_left_out(
        self, name: str, event: EventBody, refusal: Refusal | None, requester: str = ""
    ) -> None:
        self.report_refusal(name, event, CommandOutcome("switch", requester, refusal))


def fault_of(managed: ManagedController, problem: str) -> Refusal:
    """Return the refusal for a command during which the controller broke its contract."""
    return Refusal(Code.CONTROLLER_FAULT, {"controller": managed.plan.name, "problem": problem})


def _shown(mode: Mode) -> str:
    return mode.name.lower().replace("_", " with ")
