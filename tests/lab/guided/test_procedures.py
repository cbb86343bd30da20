"""Procedures on virtual time: what a segment plays and records, and that the run is left as it was."""

from __future__ import annotations

import numpy as np
import pytest
from tests.kit.experiments import perform, sine

from dxlrun.log.log_reader import read_log
from dxlrun_lab.guided.segment import Guard, Segment

pytestmark = pytest.mark.long


def test_a_segment_is_recorded_cycle_by_cycle_as_in_the_log(single, tmp_path):
    plays, done = perform(single, "joint", lambda joint: iter([sine(joint, settle_s=0.1)]))
    (got,) = plays.got
    assert done.recorded == (got,)
    assert len(got) == 320 + 32 + 1
    assert np.array_equal(np.diff(got.of_cycles("cycle")), np.ones(352))
    wave = 0.2 * np.sin(2 * np.pi * np.arange(320) / 320)
    assert np.abs(got.goal[:320, 0] - wave).max() < 1e-9
    assert got.time[-1] == pytest.approx(1.1)
    assert got.valid.all()
    assert (got.of_joints("voltage")[-1, 0], got.of_joints("temperature")[-1, 0]) == (12.0, 30.0)
    assert 0.2 - 0.05 < got.position.max() < 0.2 + 0.01
    single.close()
    log = read_log(tmp_path / "0.mcap")
    rows = np.isin(log.cycles["cycle"], got.of_cycles("cycle"))
    for name in ("cycle", "woken_ns", "written_ns", "position", "age_ns", "valid"):
        assert np.array_equal(log.cycles[name][rows], got.cycles[name]), name
    assert np.array_equal(log.cycles["goal_position"][rows, :1], got.goal)
    for cycle, name in ((0, "goal_accepted"), (-1, "goal_ended")):
        (event,) = [event for event in log.events if event.name == name]
        assert got.of_cycles("woken_ns")[cycle] <= event.t_ns <= got.of_cycles("written_ns")[cycle]


def test_a_long_table_at_another_rate_is_sent_in_pieces(single):
    """As many rows as 60 s at 320 Hz, as an identification needs; the loop runs at a fifth of its rate."""
    rows = 0.2 * np.sin(np.arange(19_200) / 1000.0)
    segment = Segment("long", 1 / 3200, {"joint": rows}, loop_rate=64)
    plays, _ = perform(single, "joint", lambda joint: iter([segment]))
    (got,) = plays.got
    assert len(got) == 385
    assert np.abs(got.goal[:384, 0] - rows[::50]).max() < 1e-9


def test_what_the_run_refuses_returns_to_the_procedure(single, arm):
    pwm = Segment("v", 0.01, {"joint": np.zeros(3)}, interface="pwm")
    plays, done = perform(single, "joint", lambda joint: iter([pwm]))
    assert plays.refused == ["joint joint (ID 1 on bus main) has no pwm mode: MX-64 lacks the mode"]
    assert (done.why, done.recorded) == ("", ())
    rates = (160, 200)
    plays, done = perform(arm, "elbow", lambda joint: (sine(joint, loop_rate=rate) for rate in rates))
    assert plays.refused == [
        "160 Hz is not a multiple of 50 Hz, the rate of controller joint_state_broadcaster"
    ]
    assert (done.why, len(plays.got)) == ("", 1)


def test_interfaces_follow_each_other_and_the_chain_is_active_again(arm):
    def constant(name, value, rows, **more):
        return Segment(name, 1 / 400, {"elbow": np.full(rows, value)}, interface=name, **more)

    def segments(joint):
        yield sine(joint, 400)
        yield constant("effort", 0.05, 100)
        yield constant("velocity", -0.5, 100)
        yield constant("pwm", 0.1, 40, begin={"elbow": 0.2})

    plays, done = perform(arm, "elbow", segments)
    assert done.why == ""
    push, turn, voltage = plays.got[1:]
    assert push.goal[:100, 0].tolist() == pytest.approx([0.05] * 100, abs=0.002)
    assert turn.goal[50, 0] == pytest.approx(-0.5, abs=0.03)
    assert voltage.position[0, 0] == pytest.approx(0.2, abs=0.03)
    assert (voltage.goal[:40, 0] > 0.09).all()


def test_joints_are_led_to_the_first_row_slowly_and_back(single):
    places = []
    goals = single.robot.link.simulated.record.goals
    single.robot.link.each_cycle = lambda cycle: places.append(float(goals.position[0]))
    far = Segment("far", 1 / 320, {"joint": np.full(10, np.radians(30))})
    plays, _ = perform(single, "joint", lambda joint: iter([far]))
    assert plays.got[0].goal[0, 0] == pytest.approx(np.radians(30))
    assert np.abs(np.diff(places)).max() * 50 < 0.55, "rows of an approach are 20 ms apart"
    assert places[-1] == pytest.approx(0.0, abs=0.006)


def test_a_joint_that_leaves_its_range_ends_the_experiment_and_the_rest_is_kept(arm):
    def segments(joint):
        yield sine(joint, 400)
        yield Segment("push", 1 / 400, {joint.name: np.full(4000, 0.9)}, interface="effort")
        raise AssertionError("nothing follows")

    plays, done = perform(arm, "elbow", segments)
    assert "joint elbow is at 0.5" in done.why
    assert "outside its range of -0.5236 to 0.5236 rad" in done.why
    assert [part.outcome for part in done.recorded] == ["reached", "aborted"]
    assert done.recorded[1].position.max() > 0.5236
    assert len(plays.got) == 1


@pytest.mark.parametrize(
    ("guard", "sentence"),
    [
        (Guard(temperature=29.0), "joint elbow has 30 deg C, more than 29"),
        (Guard(effort=0.01), "joint elbow exerts"),
    ],
)
def test_the_guard_of_a_segment_ends_it(arm, guard, sentence):
    _, done = perform(arm, "elbow", lambda joint: iter([sine(joint, 400, guard=guard)]))
    assert sentence in done.why
    assert not done.recorded[0].whole


@pytest.mark.parametrize(
    "wrong",
    [{"a": np.zeros(2), "b": np.zeros(3)}, {"a": np.zeros(0)}, {}, {"a": np.array([np.nan])}],
    ids=["lengths", "no row", "no joint", "nan"],
)
def test_wrong_tables_are_no_segments(wrong):
    with pytest.raises(ValueError, match="t: "):
        Segment("t", 0.01, wrong)
