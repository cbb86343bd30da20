"""How the joints followed their goals, and how fresh their states were."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dxlrun.recording.reader import Log


@dataclass(frozen=True, slots=True)
class Joint:
    """One joint over all cycles."""

    name: str
    invalid: int
    """Cycles without an intact reply."""
    oldest_ms: float
    """Greatest age of a state."""
    clamped: int
    """Cycles in which the last gate changed the command."""
    rms_rad: float | None
    """Of position minus the goal of the cycle before; None where there was no goal or no position.

    The servo's own lag is in it: a joint that moves is always behind its goal.
    """
    worst_rad: float | None


def tracking(log: Log) -> tuple[Joint, ...]:
    """Return freshness and tracking error of each joint; rows in the order of the log."""
    cycles = log.cycles
    joints = []
    for row, name in enumerate(log.joints):
        valid = cycles["valid"][:, row]
        error = cycles["position"][1:, row] - cycles["goal_position"][:-1, row]
        error = error[valid[1:] & np.isfinite(error)]
        ages = cycles["age_ns"][:, row]
        joints.append(
            Joint(
                name=name,
                invalid=int(np.count_nonzero(~valid)),
                oldest_ms=max(0.0, float(ages.max(initial=0)) / 1e6),
                clamped=int(np.count_nonzero(cycles["clamped"][:, row])),
                rms_rad=float(np.sqrt(np.mean(error**2))) if len(error) else None,
                worst_rad=float(np.abs(error).max()) if len(error) else None,
            )
        )
    return tuple(joints)
