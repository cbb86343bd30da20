"""Commands: what the samples of a motion are called in the typed commands of a controller.

A controller can be played when it takes a command `trajectory` (points: time s, positions, velocities,
accelerations; start_in s) or one whose fields are `positions`, `velocities` or both: values in rad and rad/s
in the order of its joints. The standard controllers do; anybody's may.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from dxlrun.compile.samples import Quantity, Sample, Target
from dxlrun.control.controller import Controller
from dxlrun.errors import Mark

TRAJECTORY = "trajectory"
_FIELDS: dict[Quantity, str] = {
    "position": "positions",
    "velocity": "velocities",
    "acceleration": "accelerations",
}


class UnfitError(ValueError):
    """A sample cannot be said in the controller's command."""

    def __init__(self, mark: Mark, what: str, mend: str) -> None:
        super().__init__(what)
        self.mark = mark
        self.what = what
        self.mend = mend


def command_kind(controller: type[Controller[Any]]) -> str | None:
    """Return the name of the command by which motions are played; None when the controller takes none."""
    if TRAJECTORY in controller.Commands:
        return TRAJECTORY
    for kind, model in controller.Commands.items():
        if model.model_fields and set(model.model_fields) <= {"positions", "velocities"}:
            return kind
    return None


def group_command(
    controller: type[Controller[Any]], kind: str, joints: Sequence[str], sample: Sample
) -> dict[str, object]:
    """Return one command with a value for each joint; raises UnfitError."""
    wanted = controller.Commands[kind].model_fields
    quantities = [quantity for quantity, name in _FIELDS.items() if name in wanted]
    for joint, target in sample.targets.items():
        for quantity in _FIELDS:
            if quantity not in quantities and target.get(quantity) is not None:
                raise UnfitError(
                    target.mark,
                    f"{joint} has a target {quantity}, which this controller does not take",
                    f"take the {quantity} out, or choose another controller",
                )
    return {
        _FIELDS[quantity]: [_value(sample, joint, quantity) for joint in joints] for quantity in quantities
    }


def trajectory_command(joints: Sequence[str], samples: Sequence[Sample], lead_ns: int) -> dict[str, object]:
    """Return a trajectory through all samples, starting `lead_ns` after it was taken; raises UnfitError."""
    quantities: list[Quantity] = ["position"]
    derivatives: tuple[Quantity, ...] = ("velocity", "acceleration")
    for quantity in derivatives:
        if any(target.get(quantity) is not None for sample in samples for target in sample.targets.values()):
            quantities.append(quantity)
    points: list[dict[str, object]] = [
        {
            "time": sample.t_ns * 1e-9,
            **{
                _FIELDS[quantity]: [_value(sample, joint, quantity) for joint in joints]
                for quantity in quantities
            },
        }
        for sample in samples
    ]
    return {"points": points, "start_in": lead_ns * 1e-9}


def _value(sample: Sample, joint: str, quantity: Quantity) -> float:
    """Return one value; who is sent somewhere must be sent there completely."""
    target: Target | None = sample.targets.get(joint)
    value = None if target is None else target.get(quantity)
    if value is None:
        raise UnfitError(
            sample.mark if target is None else target.mark,
            f"{joint} has no target {quantity} at {sample.t_ns * 1e-9:g} s",
            f"give it one; every joint of the controller needs its {quantity}, here or, "
            "for a group controller, in a point before",
        )
    return value
