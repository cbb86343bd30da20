"""sample_player: rows by time, the table's pieces, bounds, and how the joints come to rest."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from tests.kit.stages import Stage

from dxlrun import Outcome
from dxlrun_controllers.motions.sample_player import MOST_PIECES, SamplePlayer


@pytest.fixture
def player() -> Any:
    """Return a function that stages an active player of joints a and b."""

    def make(interface: str = "position", **bounds: object) -> Any:
        parameters = {"joints": ["a", "b"], "command_interface": interface, "bounds": bounds}
        return Stage(SamplePlayer, parameters).activate()

    return make


ROWS = [[0.3, -0.2], [0.4, -0.1], [0.5, 0.0], [0.6, 0.1]]


def test_rows_are_played_by_time_whatever_the_joints_answer(player: Any) -> None:
    stage = player()
    stage.send(1.0, "samples", period=0.02, rows=ROWS, settle=0.04)
    seen = [stage.update(1.0 + 0.02 * n, follow=False).tolist() for n in range(6)]
    assert seen == [*ROWS, ROWS[-1], ROWS[-1]]
    assert not stage.goal.ended
    stage.update(1.12)
    assert stage.goal.ended == [(Outcome.REACHED, "after 0.120 s", "a", 0.0)]
    assert stage.update(1.2).tolist() == ROWS[-1]


def test_a_late_cycle_leaves_rows_out_and_delays_none(player: Any) -> None:
    stage = player()
    stage.send(0.0, "samples", period=0.02, rows=ROWS)
    assert stage.update(0.0).tolist() == ROWS[0]
    assert stage.update(0.0601).tolist() == ROWS[3], "two rows are left out"
    stage.update(0.08)
    assert stage.goal.ended[0][0] is Outcome.REACHED


def test_wake_ups_that_scatter_play_each_row_once(player: Any) -> None:
    stage = player()
    rng = np.random.default_rng(1)
    rows = [[0.001 * n, 0.0] for n in range(200)]
    stage.send(0.009, "samples", period=0.02, rows=rows)  # this one was late by 9 ms of 20
    times = 0.02 * np.arange(200) + rng.uniform(0, 0.009, 200)
    times[0] = 0.009
    seen = [round(float(stage.update(at)[0]) / 0.001) for at in times]
    assert seen == list(range(200))


def test_a_slower_loop_takes_every_second_row_and_a_faster_one_repeats(player: Any) -> None:
    stage = player()
    stage.send(0.0, "samples", period=0.01, rows=[[0.01 * n, 0.0] for n in range(10)])
    assert [round(float(stage.update(0.02 * n)[0]), 3) for n in range(5)] == [0, 0.02, 0.04, 0.06, 0.08]
    stage = player()
    stage.send(0.0, "samples", period=0.04, rows=ROWS[:2])
    assert [stage.update(0.02 * n).tolist() for n in range(3)] == [ROWS[0], ROWS[0], ROWS[1]]


def test_pieces_are_one_table(player: Any) -> None:
    stage = player()
    rows = [[0.01 * n, -0.01 * n] for n in range(20)]
    stage.send(0.0, "rows", rows=rows[:1])
    stage.send(0.0, "rows", rows=rows[1:9])
    assert stage.update(0.0).tolist() == [0.3, -0.2], "nothing moves before the goal"
    stage.send(0.02, "samples", period=0.02, rows=rows[9:])
    seen = [stage.update(0.02 + 0.02 * n).tolist() for n in range(20)]
    assert seen == rows
    stage.update(0.42)
    assert stage.goal.ended[0][0] is Outcome.REACHED
    stage.send(0.5, "samples", period=0.02, rows=ROWS)  # the pieces were used up
    assert stage.update(0.5).tolist() == ROWS[0]


def test_too_many_pieces_abort_their_goal_and_no_more(player: Any) -> None:
    stage = player()
    for _ in range(MOST_PIECES):
        stage.send(0.0, "rows", rows=ROWS[:1])
    stage.send(0.0, "samples", period=0.02, rows=ROWS)
    assert stage.goal.ended[0][:2] == (Outcome.ABORTED, "its table has more than 256 pieces")
    stage.send(0.1, "samples", period=0.02, rows=ROWS)
    assert stage.update(0.1).tolist() == ROWS[0]
    assert not stage.goal.ended


@pytest.mark.parametrize("fault", [False, True], ids=["switched", "ended by a fault"])
def test_rows_of_a_deactivated_player_are_forgotten(player: Any, fault: bool) -> None:
    stage = player()
    stage.send(0.0, "rows", rows=[[9.0, 9.0]])
    if not fault:  # then it is not called
        stage.controller.on_deactivate(0)
    stage.activate()
    stage.send(0.0, "samples", period=0.02, rows=ROWS)
    assert stage.update(0.0).tolist() == ROWS[0]


@pytest.mark.parametrize(
    ("bounds", "breach", "sentence"),
    [
        (
            {"range": {"b": ("-0.5 rad", "0.5 rad")}},
            ("position", 0.6),
            "joint b is at 0.6 rad, outside its range of -0.5 to 0.5 rad",
        ),
        ({"temperature": 60.0}, ("temperature", 61.0), "joint b has 61 deg C, more than 60"),
        ({"effort": {"b": 1.0}}, ("effort", -1.5), "joint b exerts 1.5, more than 1"),
        ({"age": "100 ms"}, ("age_ns", 120_000_000), "joint b has not answered for 120 ms"),
    ],
)
def test_beyond_a_bound_the_goal_ends_and_the_joints_rest(
    player: Any, bounds: dict[str, object], breach: tuple[str, float], sentence: str
) -> None:
    stage = player(**bounds)
    stage.send(0.0, "samples", period=0.02, rows=ROWS)
    stage.update(0.0)
    assert not stage.goal.ended, "inside its bounds nothing ends"
    states = stage.states
    getattr(states, breach[0])[1] = breach[1]
    states.velocity[:] = 0.0
    states.velocity[0] = 1.0  # 1 rad/s, and 20 rad/s^2: at rest 25 mrad further
    held = stage.update(0.02, follow=False)
    assert stage.goal.ended[0][:3] == (Outcome.ABORTED, sentence, "b")
    assert held[0] == pytest.approx(states.position[0])
    assert stage.update(0.2, follow=False)[0] == pytest.approx(states.position[0] + 0.025)
    assert stage.update(0.3, follow=False)[1] == pytest.approx(states.position[1])


def test_a_joint_that_is_lost_beyond_its_range_is_not_judged_by_its_last_position(player: Any) -> None:
    stage = player(range={"b": ("-0.5 rad", "0.5 rad")})
    stage.send(0.0, "samples", period=0.02, rows=ROWS)
    stage.states.position[1], stage.states.valid[1] = 9.0, False
    stage.update(0.0, follow=False)
    assert not stage.goal.ended


@pytest.mark.parametrize("way", [1, -1])
def test_a_cancel_comes_to_rest_inside_the_range(player: Any, way: int) -> None:
    stage = player(range={"a": ("0.29 rad", "0.31 rad")})
    stage.send(0.0, "samples", period=0.02, rows=[[0.3, -0.2]] * 50)
    stage.update(0.0)
    stage.states.velocity[:] = (4.0 * way, 0.0)  # 0.4 rad at 20 rad/s^2, but the range ends in 0.01
    stage.cancel(0.02)
    assert not stage.goal.ended, "it ends when the joints are at rest"
    places = [stage.update(0.02 + 0.02 * n, follow=False)[0] for n in range(30)]
    assert stage.goal.ended[0][0] is Outcome.CANCELLED
    assert 0.29 - 1e-9 <= min(places) < max(places) <= 0.31 + 1e-9
    assert places[-1] == places[-5]


@pytest.mark.parametrize("interface", ["effort", "pwm"])
def test_efforts_become_0_at_the_end_and_beyond_a_bound(player: Any, interface: str) -> None:
    stage = player(interface, temperature=60.0)
    output = getattr(stage.commands, interface)
    assert output.tolist() == [0.0, 0.0]
    stage.send(0.0, "samples", period=0.02, rows=[[0.3, -0.2]] * 2, settle=0.02)
    for at in (0.0, 0.02, 0.04):
        stage.update(at)
        assert output.tolist() == [0.3, -0.2]
    stage.update(0.06)
    assert (output.tolist(), stage.goal.ended[0][0]) == ([0.0, 0.0], Outcome.REACHED)
    stage.send(0.1, "samples", period=0.02, rows=[[0.3, -0.2]] * 9)
    stage.update(0.1)
    stage.states.temperature[0] = 70.0
    stage.update(0.12)
    assert (output.tolist(), stage.goal.ended[0][0]) == ([0.0, 0.0], Outcome.ABORTED)


def test_velocities_decelerate_to_0(player: Any) -> None:
    stage = player("velocity")
    stage.send(0.0, "samples", period=0.02, rows=[[2.0, -1.0]])
    stage.update(0.0)
    assert stage.commands.velocity.tolist() == [2.0, -1.0]
    seen = []
    for at in (0.02, 0.04, 0.06, 0.08, 0.1, 0.12, 0.14):
        stage.update(at)
        seen.append(stage.commands.velocity[0])
    assert stage.goal.ended[0][0] is Outcome.REACHED
    assert seen == pytest.approx([2.0, 1.6, 1.2, 0.8, 0.4, 0.0, 0.0])


def test_speeds_stand_behind_the_positions(player: Any) -> None:
    stage = player("posvel")
    stage.send(0.0, "samples", period=0.02, rows=[[0.3, -0.2, 1.0, 2.0]])
    stage.update(0.0)
    commands = stage.commands
    assert (commands.position.tolist(), commands.velocity.tolist()) == ([0.3, -0.2], [1.0, 2.0])


def test_a_new_goal_takes_over_and_one_that_stops_can_be_followed(player: Any) -> None:
    stage = player()
    stage.send(0.0, "samples", period=0.02, rows=ROWS)
    stage.update(0.0)
    stage.send(0.02, "samples", period=0.02, rows=ROWS[2:])
    assert stage.goals[0].ended[0][0] is Outcome.PREEMPTED
    assert stage.update(0.02).tolist() == ROWS[2]
    stage.cancel(0.04)
    stage.send(0.06, "samples", period=0.02, rows=ROWS)
    assert stage.update(0.06).tolist() == ROWS[0]


def test_rows_that_come_while_a_table_is_played_end_it(player: Any) -> None:
    stage = player()
    stage.send(0.0, "samples", period=0.02, rows=ROWS)
    stage.update(0.0)
    stage.send(0.02, "rows", rows=ROWS[:1])
    assert stage.goal.ended[0][:2] == (Outcome.ABORTED, "rows of another table came")
    stage.send(0.04, "samples", period=0.02, rows=ROWS[3:])
    assert stage.update(0.04).tolist() == ROWS[0]
    assert stage.update(0.06).tolist() == ROWS[3]


@pytest.mark.parametrize(
    ("tolerance", "outcome"),
    [({}, Outcome.MISSED), ({"tolerance": 0.5}, Outcome.REACHED), ({"tolerance": "inf"}, Outcome.REACHED)],
)
def test_a_table_is_judged_by_its_last_row_unless_its_tolerance_is_infinite(
    player: Any, tolerance: Any, outcome: Outcome
) -> None:
    stage = player()
    stage.send(0.0, "samples", period=0.02, rows=ROWS, **tolerance)
    stage.states.position[:] = np.array(ROWS[-1]) + 0.2
    for at in (0.0, 0.02, 0.04, 0.06, 0.08, 0.1, 1.2):
        stage.update(at, follow=False)
    assert [one[0] for one in stage.goal.ended] == [outcome]
    assert stage.goal.number


def test_velocities_are_reached_at_rest_and_efforts_without_any(player: Any) -> None:
    for interface, outcome in (("velocity", Outcome.MISSED), ("effort", Outcome.REACHED)):
        stage = player(interface)
        stage.send(0.0, "samples", period=0.02, rows=ROWS)
        stage.states.velocity[:] = 3.0
        for at in (0.0, 0.02, 0.04, 0.06, 0.08, 0.1, 1.2):
            stage.update(at, follow=False)
        assert [one[0] for one in stage.goal.ended] == [outcome]
