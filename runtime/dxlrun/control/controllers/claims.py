"""Claims: which controller may command which joint; one active controller a joint."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Protocol

from dxlrun.control.loop_plan import ControllerPlan, JointPlan
from dxlrun.description.modes import Mode, mode_of


class Claimant(Protocol):
    """What may claim joints; a ControllerPlan is one."""

    @property
    def name(self) -> str:
        """The controller's name in the robot file."""
        ...

    @property
    def joints(self) -> tuple[str, ...]:
        """The joints it works on."""
        ...

    @property
    def command(self) -> tuple[str, ...]:
        """The command interfaces that it claims on each of them; empty: it only reads."""
        ...

    @property
    def into(self) -> tuple[str, ...]:
        """The controllers whose references it claims; empty: it claims the servos."""
        ...

    @property
    def reference(self) -> tuple[str, ...]:
        """The interfaces that it exports on each of its joints."""
        ...


@dataclass(frozen=True, slots=True)
class Conflict:
    """Two controllers that claim the same joint, or the same reference of it."""

    joint: str
    holder: str
    other: str
    reference: str = ""
    """`arm_pid/shoulder/position`; empty: they claim its servo."""

    def __str__(self) -> str:
        what = self.reference or f"joint {self.joint}"
        return f"controllers {self.holder} and {self.other} both command {what}"


def conflicts(claimants: Iterable[Claimant]) -> tuple[Conflict, ...]:
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


def _claims(claimant: Claimant, named: Mapping[str, Claimant]) -> Iterator[tuple[str, str]]:
    """Yield joints with the claimed reference; with none where the servo is claimed.

    Of controllers that are into several ones each joint is claimed where it is exported, as far as these are
    among `named`.
    """
    if not claimant.command:
        return
    for joint in claimant.joints:
        if not claimant.into:
            yield joint, ""
        for name in claimant.into:
            lower = named.get(name)
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


def claimed_modes(claimants: Iterable[Claimant]) -> dict[str, Mode]:
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
