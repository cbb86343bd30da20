"""sample_player: rows by time under scattered wake-ups; single cases are in `scripts/samples.txt`."""

from __future__ import annotations

import numpy as np
from tests.kit.stages import Stage

from dxlrun import Outcome
from dxlrun_controllers.motions.sample_player import MOST_PIECES, SamplePlayer

ROWS = [[0.3, -0.2], [0.4, -0.1]]


def player() -> Stage:
    return Stage(SamplePlayer, {"joints": ["a", "b"], "command_interface": "position"}).activate()


def test_wake_ups_that_scatter_play_each_row_once() -> None:
    stage = player()
    rng = np.random.default_rng(1)
    rows = [[0.001 * n, 0.0] for n in range(200)]
    stage.send(0.009, "samples", period=0.02, rows=rows)  # this one was late by 9 ms of 20
    times = 0.02 * np.arange(200) + rng.uniform(0, 0.009, 200)
    times[0] = 0.009
    seen = [round(float(stage.update(at)[0]) / 0.001) for at in times]
    assert seen == list(range(200))


def test_too_many_pieces_abort_their_goal_and_no_more() -> None:
    stage = player()
    for _ in range(MOST_PIECES):
        stage.send(0.0, "rows", rows=ROWS[:1])
    stage.send(0.0, "samples", period=0.02, rows=ROWS)
    assert stage.goal.ended[0][:2] == (Outcome.ABORTED, "its table has more than 256 pieces")
    stage.send(0.1, "samples", period=0.02, rows=ROWS)
    assert stage.update(0.1).tolist() == ROWS[0]
    assert not stage.goal.ended
