"""The program of docs/how-to/many-runs.md."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from tests.kit.awaited import DEADLINE_S
from tests.kit.pages import page_text

from dxlrun.testing import read_log, simulated_robot

pytestmark = pytest.mark.long
ROOT = Path(__file__).parents[2]
ROBOT, MOTION = ROOT / "robots/effort_arm.yaml", ROOT / "robots/motions/effort_arm_lift.yaml"
PROGRAM, _ = re.findall(r"```python\n(.*?)```", page_text("many-runs.md"), re.DOTALL)
SMALL = 'GRID = {"p": (2, 10, "high"), "d": (0.05,)}'


def test_program_ranks_the_runs_by_tracking_error(tmp_path: Path) -> None:
    (tmp_path / "robots").symlink_to(ROOT / "robots")
    small, count = re.subn(r"^GRID = .*$", SMALL, PROGRAM, flags=re.MULTILINE)
    assert count == 1
    (tmp_path / "gains.py").write_text(small)
    ran = subprocess.run(
        [sys.executable, "gains.py"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=DEADLINE_S,
        check=False,
    )
    assert ran.returncode == 0, ran.stderr
    refused = [line for line in ran.stdout.splitlines() if line.startswith("{")]
    assert "'p': 'high'" in refused[0]
    assert "gains.p" in ran.stdout
    heading, *rows, best = ran.stdout.splitlines()[-5:]
    assert heading.split("\t") == ["p", "d", "error (deg)"]
    assert [row.split("\t")[:2] for row in rows] == [["10", "0.05"], ["2", "0.05"], ["high", "0.05"]]
    assert float(rows[0].split("\t")[2]) == pytest.approx(shoulder_error_deg(tmp_path, "10"), rel=0.01)
    assert rows[2].endswith("\tinf")
    assert best == "best: p:=10 d:=0.05"


def shoulder_error_deg(tmp_path: Path, p: str) -> float:
    """Return the RMS tracking error from the references and positions of the cycles."""
    log = tmp_path / "judge.mcap"
    simulated_robot(ROBOT, arguments={"p": p, "d": "0.05"}, play=[MOTION], log=log).run()
    cycles = read_log(log).cycles
    reference, position = cycles["reference"][:, 0], cycles["position"][:, 0]
    known = np.isfinite(reference)
    return float(np.degrees(np.sqrt(np.mean((reference - position)[known] ** 2))))
