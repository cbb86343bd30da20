"""held_arm: what gravity_compensation gains on an arm whose bodies MuJoCo moves; its replay.

`pytest --campaign=release -rP tests/robots/test_held_arm.py` prints the figures of the documentation.
"""

from pathlib import Path

import numpy as np
import pytest
from tests.kit.campaigns import campaign
from tests.kit.virtual_run import VirtualRun

pytestmark = pytest.mark.long
ROBOTS = Path(__file__).parents[2] / "robots"
pytest.importorskip("mujoco", reason="bodies of a URDF are moved by MuJoCo")


def rms(scale: float, seconds: float, log: Path) -> float:
    """Return the RMS error of a slow motion, rad."""
    play = [ROBOTS / "motions" / "held_arm_reach.yaml"]
    arguments = {"scale": str(scale)}
    run = VirtualRun(ROBOTS / "held_arm.yaml", log, arguments=arguments, play=play, duration_s=seconds)
    cycles = run.finish().cycles
    at = [run.record.layout.references.index(f"gravity/{name}/position") for name in ("shoulder", "elbow")]
    desired = cycles["reference"][:, at]
    error = (desired - cycles["position"])[np.isfinite(desired).all(axis=1)]
    assert len(error) > 45 * seconds
    return float(np.sqrt((error**2).mean()))


@campaign(ci=10, night=27, release=27)
def test_gravity_compensation_reduces_the_error_of_a_loaded_arm_by_three(tmp_path, amount):
    without, compensated = (rms(scale, amount, tmp_path / "run.mcap") for scale in (0.0, 1.0))
    print(f"{amount:g} s: RMS error {without * 1e3:.1f} mrad, compensated {compensated * 1e3:.1f} mrad")
    assert compensated < without / 3
