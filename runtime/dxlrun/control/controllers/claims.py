"""Claims: which controllers may be active together; one commander a servo, and one a reference.

A controller that is `into` others commands their references: it is above them. It is never active without
them, so it enters after and leaves before them, in the same step.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Sequence

import msgspec

from dxlrun.channels.answers import Code, Field, Refusal
from dxlrun.control.controllers.graph import Plans, below, commander, lowers_first, uppers_first
from dxlrun.plan.loop_plan import ControllerPlan, JointPlan
from dxlwire.modes import Mode, mode_of


class Conflict(msgspec.Struct, frozen=True):
    """Two controllers that claim the same joint, or the same reference of it."""

    joint: str
    holder: str
    other: str
    reference: str = ""
    """`arm_pid/shoulder/position`, or `light/led` of a device; empty: they claim its servo."""

    def __str__(self) -> str:
        what = self.reference or f"joint {self.joint}"
        return f"controllers {self.holder} and {self.other} both command {what}"


def conflicts(claimants: Iterable[ControllerPlan]) -> tuple[Conflict, ...]:
    """Return every joint, and every reference, that a later controller claims although an earlier one has it.

    A claim of one interface of a servo keeps all others of the joint away too: position and speed of a servo
    belong together, and a stale speed of another controller would move the robot in an unexpected way. The
    interfaces of a reference are claimed one by one: the lower controller makes one command of them.
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
    """Yield joints with the claimed reference; with none where the servo is claimed.

    Of controllers that are into several ones each joint is claimed where it is exported, as far as these are
    among `named`.
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
                continue  # a mistake that is refused
            if lower is None or (joint in lower.joints and set(claimant.command) <= set(lower.reference)):
                for interface in claimant.command:
                    yield joint, f"{name}/{joint}/{interface}"


def conflicts_text(found: Iterable[Conflict]) -> str:
    """Return conflicts in words: each pair of controllers once, with its first joint; empty for none."""
    pairs: dict[tuple[str, str], list[Conflict]] = {}
    for conflict in found:
        pairs.setdefault((conflict.holder, conflict.other), []).append(conflict)
    return "; ".join(
        str(many[0]) + (f" and {len(many) - 1} more" if many[1:] else "") for many in pairs.values()
    )


def claimed_modes(claimants: Iterable[ControllerPlan]) -> dict[str, Mode]:
    """Return the mode that each claimed joint needs, by its name; other joints are not in it.

    Raises ValueError for command interfaces that no mode has together.
    """
    return {
        joint: mode_of(claimant.command)
        for claimant in claimants
        if claimant.command and not claimant.into
        for joint in claimant.joints
    }


def start_modes(joints: Iterable[JointPlan], controllers: Iterable[ControllerPlan]) -> dict[str, Mode]:
    """Return the mode in which each joint begins a run, by its name: what the controllers need that are
    active from the start, else its rest mode."""
    claimed = claimed_modes(controller for controller in controllers if controller.active)
    return {joint.name: claimed.get(joint.name, joint.rest) for joint in joints}


class Step(msgspec.Struct, frozen=True):
    """Controllers that leave and enter together, each list in the order in which they do."""

    leave: tuple[str, ...]
    enter: tuple[str, ...]


class Standing(msgspec.Struct, frozen=True):
    """The controllers as they stand, by their names: what may change from here, and what goes along."""

    known: Plans
    active: Plans
    entering: Plans = {}
    """Those that will be active when their joints are in their modes."""

    @property
    def engaged(self) -> Plans:
        """Those that have their claims: active and entering ones."""
        return {**self.active, **self.entering}

    def switch(self, activate: Sequence[str], deactivate: Sequence[str]) -> Step | Refusal:
        """Return what a switch does: those below that are not active enter too; or why it is refused."""
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
        return Step(uppers_first(deactivate, known), enter)

    def request(self, names: Sequence[str]) -> Step | Refusal:
        """Return how controllers take over because another one requests it, or why that is refused.

        All that claim what these and those below them claim leave, and those above them. What is active, or
        waits for modes, stays as it is.
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
        # none of `needed` leaves: they claim nothing twice, and what is below them is of them
        return self._step(self._displaced(enter), enter)

    def fall_back(self, fallback: str, taken: Sequence[str], failed: Collection[str]) -> Step | None:
        """Return how a fallback takes over for controllers that were taken out; None: it cannot.

        Those below them leave too where they hold what the fallback claims, unless one that goes on uses
        them. `failed` have broken their contract: none of them comes back by a fault of another.
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
        """Return the controllers below these that no other one which goes on uses."""
        plans, engaged = tuple(self.known.values()), self.engaged
        free = {lower for name in taken for lower in below(plans, name)} & engaged.keys()
        while kept := {name for name in free if commander(name, _without(engaged, free))}:
            free -= kept
        return free

    def _displaced(self, enter: Sequence[str]) -> set[str]:
        """Return the controllers that hold what these claim, and those above them."""
        engaged = self.engaged
        claimants = [*engaged.values(), *(self.known[name] for name in enter)]
        leave = {conflict.holder for conflict in conflicts(claimants)}
        while more := {upper for name in leave if (upper := commander(name, _without(engaged, leave)))}:
            leave |= more
        return leave

    def _step(self, leave: Collection[str], enter: tuple[str, ...]) -> Step:
        return Step(uppers_first([name for name in self.engaged if name in leave], self.known), enter)


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
