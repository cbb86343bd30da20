"""held_arm: what gravity_compensation gains on an arm whose bodies MuJoCo moves; its replay.

`DXLRUN_ARM_SECONDS=27 pytest -rP tests/robots/test_held_arm.py` prints the figures of the documentation.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from dxlrun.testing import read_log, simulated_robot
from dxlrun_analysis.replay import replay_log

ROBOTS = Path(__file__).parents[2] / "robots"
SECONDS = float(os.environ.get("DXLRUN_ARM_SECONDS", "10"))
pytest.importorskip("mujoco", reason="bodies of a URDF are moved by MuJoCo")


def rms(scale: float, log: Path) -> float:
    """Return the RMS error of a slow motion, rad."""
    robot = simulated_robot(
        ROBOTS / "held_arm.yaml",
        arguments={"scale": str(scale)},
        play=[ROBOTS / "motions" / "held_arm_reach.yaml"],
        duration_s=SECONDS,
        log=log,
    )
    assert robot.run().detail == ""
    cycles = read_log(log).cycles
    at = [robot.record.layout.references.index(f"gravity/{name}/position") for name in ("shoulder", "elbow")]
    desired = cycles["reference"][:, at]
    error = (desired - cycles["position"])[np.isfinite(desired).all(axis=1)]
    assert len(error) > 45 * SECONDS
    return float(np.sqrt((error**2).mean()))


@pytest.mark.campaign
def test_the_error_of_a_loaded_arm_falls_by_three(tmp_path):
    logs = tmp_path / "without.mcap", tmp_path / "with.mcap"
    without, compensated = rms(0.0, logs[0]), rms(1.0, logs[1])
    print(f"{SECONDS:g} s: RMS error {without * 1e3:.1f} mrad, compensated {compensated * 1e3:.1f} mrad")
    assert compensated < without / 3
    report = replay_log(logs[1])
    assert (report.different, report.compared) == (0, report.cycles)
