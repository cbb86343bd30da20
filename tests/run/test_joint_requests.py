"""A reboot in a whole run on virtual time, and its verdict; other requests: stories/requests.txt."""

from pathlib import Path

import numpy as np
import pytest
from tests.kit.cases import read_head
from tests.kit.totals import totals_of
from tests.kit.virtual_run import VirtualRun, ask

from dxlrun.channels.cycle import Torque
from dxlrun_analysis.joints.goal_tracking import tracking
from dxlrun_analysis.verdict import judge_run

ROBOT = read_head(Path(__file__).with_name("stories") / "requests.txt")


@pytest.mark.parametrize("requested", [True, False])
def test_a_requested_reboot_is_no_fault_of_the_run(tmp_path, requested):
    """One that nothing requested counts: its invalid states too."""
    run = VirtualRun.of_text(tmp_path, ROBOT, 1.5)
    if requested:
        run.ask(400, ask("reboot", {"joints": ["wrist"], "release": True}))
    else:
        run.at(400, run.servos["wrist"].reboot)
    log = run.finish()
    away = int(np.count_nonzero(~log.cycles["valid"][:, 2]))
    assert away > 10
    totals = totals_of(log.path)
    verdict = judge_run(totals)
    assert run.result is not None
    assert run.result.invalid == totals.invalid == tuple(joint.invalid for joint in tracking(log))
    if requested:
        assert (verdict.good, totals.invalid[2] <= 2) == (True, True), verdict
        assert Torque.LOST not in log.cycles["torque"][:, 2]
    else:
        assert (verdict.good, totals.invalid[2]) == (False, away)
        assert "wrist" in verdict.sentences[0]
