"""Claims: check which controllers may be active together: each servo and reference has one commander.

A controller that is `into` others commands their references: it is above them. It is never active without
them, so it enters after them and leaves before them, in the same step.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Sequence

import msgspec

from dxlrun.channels.answers import Code, Field, Refusal
from dxlrun.control.controllers.update_order import Plans, below, commander, lowers_first, uppers_first
from dxlrun.plan.loop_plan import ControllerPlan, JointPlan
from dxlwire.modes import Mode, mode_of


class Conflict(msgspec.Struct, frozen=True):
    """Two controllers that claim the same joint or the same reference."""

    joint: str
    holder: str
    other: str
    reference: str = ""
    """Name of the contested reference, `arm_pid/shoulder/position`, or of a device's command, `light/led`;
    empty: both controllers command the servo of the joint.
    """

    def __str__(self) -> str:
        what = self.reference or f"joint {self.joint}"
        return f"controllers {self.holder} and {self.other} both command {what}"


def conflicts(claimants: Iterable[ControllerPlan]) -> tuple[Conflict, ...]:
    """Return a conflict for each joint or reference that two of these controllers claim.

    A claim of one interface of a servo claims the whole joint: a servo combines position and speed, so a
    stale speed of another controller would move the robot unexpectedly. Interfaces of a reference are claimed
    one by one: the lower controller combines them into one command.
    """
    holders: dict[tuple[str, str], str] = {}
    found: list[Conflict] = []
    claimants = list(claimants)
    named = {claimant.name: claimant for claimant in claimants}
    for claimant in claimants:
        for joint, reference in _claims(claimant, named):
            holder = holders.setdefault((joint, reference), claimant.name)
            if holder != claimant.name:
                found.append(Conflict(joint, holder, claimant.name, reference))
    return tuple(found)


def _claims(claimant: ControllerPlan, named: Plans) -> Iterator[tuple[str, str]]:
    """Yield pairs of joint and reference that a controller claims. The reference is empty for a servo.

    A controller above several others claims each joint at the controller in `named` that exports it.
    """
    for command in claimant.source_commands:
        yield "", command
    if not claimant.command:
        return
    for joint in claimant.joints:
        if not claimant.into:
            yield joint, ""
        for name in claimant.into:
            lower = named.get(name)
            if lower is claimant:
                continue  # invalid, and refused elsewhere: `update_order` finds the circle
            if lower is None or (joint in lower.joints and set(claimant.command) <= set(lower.reference)):
                for interface in claimant.command:
                    yield joint, f"{name}/{joint}/{interface}"


def conflicts_text(found: Iterable[Conflict]) -> str:
    """Return the conflicts as text: each pair of controllers once, with its first joint.

    Empty without conflicts.
    """
    pairs: dict[tuple[str, str], list[Conflict]] = {}
    for conflict in found:
        pairs.setdefault((conflict.holder, conflict.other), []).append(conflict)
    return "; ".join(
        str(many[0]) + (f" and {len(many) - 1} more" if many[1:] else "") for many in pairs.values()
    )


def claimed_modes(claimants: Iterable[ControllerPlan]) -> dict[str, Mode]:
    """Return the servo mode that each joint needs for the commands of these controllers, by joint name.

    Controllers that command references only are ignored.

    Raises: ValueError: No mode has this combination of command interfaces.
    """
    return {
        joint: mode_of(claimant.command)
        for claimant in claimants
        if claimant.command and not claimant.into
        for joint in claimant.joints
    }


def start_modes(joints: Iterable[JointPlan], controllers: Iterable[ControllerPlan]) -> dict[str, Mode]:
    """Return the servo mode of each joint at the start of a run, by joint name.

    That is the mode that an initially active controller requires, otherwise the joint's rest mode.
    """
    claimed = claimed_modes(controller for controller in controllers if controller.active)
    return {joint.name: claimed.get(joint.name, joint.rest_mode) for joint in joints}


class SwitchStep(msgspec.Struct, frozen=True):
    """One step of a switch: names of the controllers to deactivate and to activate, in execution order."""

    leave: tuple[str, ...]
    enter: tuple[str, ...]


class ControllerSnapshot(msgspec.Struct, frozen=True):
    """Snapshot of all loaded controllers (`known`), and of the active and the waiting ones, by name.

    Its methods plan switches without executing them.
    """

    known: Plans
    active: Plans
    entering: Plans = {}
    """Controllers that wait for joint modes and then become active."""

    @property
    def engaged(self) -> Plans:
        """Plans of the controllers that hold claims on joints: the active and the entering ones."""
        return {**self.active, **self.entering}

    def switch(self, activate: Sequence[str], deactivate: Sequence[str]) -> SwitchStep | Refusal:
        """Return the step that activates and deactivates these controllers, or the refusal.

        Inactive controllers below the activated ones are activated too.
        """
        known, engaged = self.known, self.engaged
        for code, names in (
            (Code.UNKNOWN_CONTROLLER, [name for name in (*activate, *deactivate) if name not in known]),
            (Code.NAMED_TWICE, {name for name in activate if activate.count(name) > 1}),
            (Code.NAMED_TWICE, {name for name in deactivate if deactivate.count(name) > 1}),
            (Code.INACTIVE_ALREADY, [name for name in deactivate if name not in engaged]),
            (Code.ACTIVE_ALREADY, [one for one in activate if one in engaged and one not in deactivate]),
        ):
            if names:
                return Refusal(code, {"controller": tuple(names)})
        staying = {name: plan for name, plan in engaged.items() if name not in deactivate}
        enter = lowers_first(activate, known, staying)
        fresh = [known[name] for name in enter if name not in deactivate]
        for name in deactivate:
            upper = commander(name, [*staying.values(), *(() if name in activate else fresh)])
            if upper:
                hint = f"deactivate {upper} in the same switch"
                return Refusal(Code.COMMANDED, {"controller": name, "upper": upper, "hint": hint})
        for lower in (lower for name in enter for lower in known[name].into):
            if lower not in known:
                return Refusal(Code.UNKNOWN_CONTROLLER, {"controller": lower})
            if lower in staying and lower in self.entering:
                return Refusal(Code.NOT_ACTIVE_YET, {"controller": lower})
        if found := conflicts([*staying.values(), *(known[name] for name in enter)]):
            return _clash(found)
        return SwitchStep(uppers_first(deactivate, known), enter)

    def request(self, names: Sequence[str]) -> SwitchStep | Refusal:
        """Return the step by which the named controllers take over at a controller's request, or its refusal.

        Controllers leave if they hold a claim that the requested ones or those below them need, together with
        the controllers above them. Requested controllers that are already active or entering stay as they
        are.
        """
        known = self.known
        needed = [known[name] for name in lowers_first(names, known)]
        for missing in (
            [name for name in names if name not in known],
            [lower for plan in needed for lower in plan.into if lower not in known],
        ):
            if missing:
                return Refusal(Code.UNKNOWN_CONTROLLER, {"controller": tuple(missing)})
        if found := conflicts(needed):
            return _clash(found)
        engaged = self.engaged
        enter = tuple(plan.name for plan in needed if plan.name not in engaged)
        if late := tuple(lower for name in enter for lower in known[name].into if lower in self.entering):
            return Refusal(Code.NOT_ACTIVE_YET, {"controller": late})
        # None of `needed` leaves: their claims are free of conflicts, and all controllers below are included.
        return self._step(self._displaced(enter), enter)

    def fall_back(self, fallback: str, taken: Sequence[str], failed: Collection[str]) -> SwitchStep | None:
        """Return the step by which a fallback replaces controllers, or None if it cannot take over.

        Controllers below the replaced ones leave too if they hold a claim of the fallback. They must not be
        in use by a controller that stays.

        Args:
            fallback: Name of the fallback controller.
            taken: Controllers that were deactivated because of a fault.
            failed: Controllers that have broken their contract. The fault of another one never reactivates
                them.
        """
        known, engaged = self.known, self.engaged
        if fallback in engaged:
            return None
        enter = lowers_first([fallback], known, engaged)
        leave = self._displaced(enter)
        needed = {lower for name in enter for lower in known[name].into}
        if not leave <= self.only_under(taken) or needed & leave or not needed <= known.keys():
            return None
        if any(name in failed for name in enter) or needed & self.entering.keys():
            return None
        return self._step(leave, enter)

    def only_under(self, taken: Sequence[str]) -> set[str]:
        """Return the active or entering controllers below these that no other controller commands."""
        plans, engaged = tuple(self.known.values()), self.engaged
        free = {lower for name in taken for lower in below(plans, name)} & engaged.keys()
        while kept := {name for name in free if commander(name, _without(engaged, free))}:
            free -= kept
        return free

    def _displaced(self, enter: Sequence[str]) -> set[str]:
        """Return the controllers that must leave so that these can enter.

        They have conflicting claims, or are above controllers with conflicting claims.
        """
        engaged = self.engaged
        claimants = [*engaged.values(), *(self.known[name] for name in enter)]
        leave = {conflict.holder for conflict in conflicts(claimants)}
        while more := {upper for name in leave if (upper := commander(name, _without(engaged, leave)))}:
            leave |= more
        return leave

    def _step(self, leave: Collection[str], enter: tuple[str, ...]) -> SwitchStep:
        return SwitchStep(uppers_first([name for name in self.engaged if name in leave], self.known), enter)


def _clash(found: Sequence[Conflict]) -> Refusal:
    fields: dict[str, Field] = {
        "conflict": conflicts_text(found),
        "joints": tuple(conflict.joint for conflict in found),
        "holders": tuple(conflict.holder for conflict in found),
        "others": tuple(conflict.other for conflict in found),
    }
    return Refusal(Code.JOINTS_CLAIMED, fields)


def _without(plans: Plans, names: Collection[str]) -> list[ControllerPlan]:
    return [plan for name, plan in plans.items() if name not in names]
