"""`dxlrun bench rate`: its words, and its result as JSON and in words."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from tests.kit.answers import result_of

from dxlrun.plan.robot_plan import Plan
from dxlrun.run.run_summary import RunSummary
from dxlrun.run.virtual_run import VirtualRobot
from dxlrun_lab import highest_rate

pytestmark = pytest.mark.long

ROBOT = Path(__file__).parents[2] / "robots" / "single_joint.yaml"


def test_the_runs_are_shown_in_a_table_and_the_rate_in_a_sentence(
    dxlrun: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def run_robot(plan: Plan, *_: object) -> RunSummary:
        path = tmp_path / f"{len(list(tmp_path.iterdir()))}.mcap"
        VirtualRobot(plan, log=path).run()
        return RunSummary(0, "ended", 1, 0, (), log=str(path))

    monkeypatch.setattr(highest_rate, "run_robot", run_robot)
    said = dxlrun("bench", "rate", ROBOT, "--duration", "0.3")
    assert (said.code, said.err) == (0, "")
    running, head, _, row, verdict = said.out.splitlines()
    assert head.split()[:4] == ["rate", "cycles", "overruns", "by"]
    assert row.split()[0] in running
    assert row.split()[-1] == "yes"
    assert verdict.startswith(f"single_joint keeps {row.split()[0]} Hz on this machine; the buses allow")
    shown = result_of(dxlrun("bench", "rate", ROBOT, "--duration", "0.3", "--json").out)
    assert (shown["robot"], shown["kept_hz"]) == ("single_joint", shown["tries"][-1]["rate_hz"])
    assert shown["tries"][-1]["rate_hz"] <= shown["computed_hz"]
