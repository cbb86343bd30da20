"""What is measured: drift, lateness and error, against delays that were injected."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dxlrun.compile.robot_compiler import compile_files
from dxlrun.errors import InputError
from dxlrun_lab.tracking import motion_evaluation
from dxlrun_lab.tracking.desired_motion import desired_motion
from dxlrun_lab.tracking.motion_evaluation import measure_tracking

pytestmark = pytest.mark.long

ROBOT = Path(__file__).parents[3] / "robots" / "single_joint.yaml"
ACTIVE = {"position_trajectory": "false", "posvel_trajectory": "true"}
PERIOD_NS = 3_125_000
SEQUENTIAL, LOOP = "sequential-normal", "loop-normal"


@pytest.fixture
def waited(monkeypatch):
    """Return what makes cycles wait for simulated servos, ns: in their read, and in the idle time."""

    def waited(rows, read=None, idle=None):
        found = np.zeros((2, rows), np.int64)
        for times, given in zip(found, (read, idle), strict=True):
            for cycle, ns in (given or {}).items():
                times[cycle] = ns
        monkeypatch.setattr(motion_evaluation, "waits_for_servos", lambda log, ledger: tuple(found))

    return waited


def test_the_sequential_sender_ends_late_by_exactly_the_sum_of_its_start_delays(runs):
    ran = runs(SEQUENTIAL, "random")
    one = ran.measured.tracked
    # the motion's first pose is that of cycle 320, 1 s after the command, its last that of cycle 640
    injected = sum(ran.injected_ns[321:641])
    assert one.ended
    assert one.cycles == 321
    assert one.drift_ns == one.start_delays_ns == injected > 10 * PERIOD_NS
    assert one.adds_up
    assert one.duration_ns == 1_000_000_000 + injected


def test_the_loop_ends_within_one_period(runs):
    one = runs(LOOP, "random").measured.tracked
    assert one.ended
    assert 0 <= one.drift_ns < PERIOD_NS + one.last_late_ns
    assert one.start_delays_ns is None


def test_a_cycle_that_wakes_a_moment_before_the_end_is_the_last(runs):
    """The command was taken some ns after a deadline, so the motion ends some ns after another."""
    ran = runs(LOOP, "none")
    cycles = ran.log.cycles.copy()
    (end,) = np.flatnonzero(cycles["cycle"] == 640)
    cycles["woken_ns"][end] -= 70
    one = replace(ran, log=replace(ran.log, cycles=cycles)).measured.tracked
    assert (one.ended, one.cycles, one.drift_ns) == (True, 321, -70)


def test_a_sequence_of_which_the_log_lacks_a_cycle_does_not_add_up(runs):
    """The other side: it is no tautology that the delays add up."""
    ran = runs(SEQUENTIAL, "random")
    lost = next(number for number in range(400, 640) if ran.injected_ns[number])
    log = replace(ran.log, cycles=ran.log.cycles[np.arange(len(ran.log.cycles)) != lost])
    assert not replace(ran, log=log).measured.tracked.adds_up


def test_without_delays_both_send_the_same(runs):
    one, other = (runs(setup, "none").measured.tracked for setup in (SEQUENTIAL, LOOP))
    assert one.drift_ns == other.drift_ns == 0
    assert (one.late_cycles, one.max_late_us, one.silent_cycles) == (0, 0.0, 0)
    assert (one.rms_rad, one.worst_rad) == (other.rms_rad, other.worst_rad)
    assert 0.001 < one.rms_rad < one.worst_rad < 0.2
    ran = runs(LOOP, "none")
    one = measure_tracking(ran.log, ran.setup, ran.desired, None).tracked
    assert (one.late_by_bus_us, one.drift_by_bus_ns) == (None, None), "a real bus has no ledger"


def test_the_error_is_that_of_the_moment_of_the_reading(runs):
    ran = runs(LOOP, "none")
    number = ran.log.cycles["cycle"]
    cycles = ran.log.cycles[(number >= 320) & (number <= 640)]
    seconds = np.clip((cycles["read_ns"] - cycles["woken_ns"][0]) / 1e9, 0, 1)
    desired = 0.5 * (np.sin(2 * seconds) - np.sin(4 * seconds))
    error = desired - cycles["position"][:, ran.log.joints.index("joint")]
    assert ran.measured.tracked.rms_rad == pytest.approx(float(np.sqrt(np.mean(error**2))), abs=2e-5)


@pytest.mark.parametrize("setup", [SEQUENTIAL, LOOP])
def test_one_late_wake_up_is_one_late_cycle(runs, setup):
    """The loop skips the periods that passed meanwhile, but its next cycle is on time."""
    ran = runs(setup, "once")
    found = ran.measured
    one, curves = found.tracked, found.curves
    assert (one.late_cycles, one.max_late_us) == (1, 2.5 * PERIOD_NS / 1e3)
    assert int(ran.log.cycles["skipped"].sum()) == (0 if setup == SEQUENTIAL else 2)
    late_s = curves.woken_s[curves.worst] - curves.due_s[curves.worst]
    assert late_s == pytest.approx(2.5 * PERIOD_NS / 1e9)


def test_a_cycle_after_one_that_took_too_long_is_late(runs, waited):
    """As if the read of a cycle had taken 2.2 periods: the next one begins after two skipped periods."""
    ran = runs(LOOP, "none")
    kept = ~np.isin(ran.log.cycles["cycle"], (401, 402))
    cycles = ran.log.cycles[kept].copy()
    after = int(np.searchsorted(cycles["cycle"], 403))
    cycles["skipped"][after] = 2
    cycles["written_ns"][after - 1] = cycles["woken_ns"][after - 1] + 11 * PERIOD_NS // 5
    ran = replace(ran, log=replace(ran.log, cycles=cycles))
    one = ran.measured.tracked
    assert (one.late_cycles, one.max_late_us) == (1, 2 * PERIOD_NS / 1e3)
    # a simulated servo may have caused what the cycle took beyond its period, not what was skipped besides
    waited(len(cycles), read={after - 1: 3 * PERIOD_NS})
    assert ran.measured.tracked.late_by_bus_us == 1.2 * PERIOD_NS / 1e3


def test_what_the_simulated_bus_was_late_is_taken_off(runs, waited):
    ran = runs(SEQUENTIAL, "once")
    waited(len(ran.log.cycles), read={350: 900_000}, idle={400: 1_500_000, 500: 7_000_000})
    one = ran.measured.tracked
    assert one.drift_ns == 7_812_500
    assert one.drift_by_bus_ns == 1_500_000  # nothing of 350 and 500: no cycle was late by it
    assert one.own_drift_ns == 6_312_500
    assert one.late_by_bus_us == 1_500.0
    assert (one.late_cycles, one.max_late_us) == (1, 6_312.5)


def test_what_the_bus_was_late_before_the_first_pose_is_no_drift(runs, waited):
    """The duration counts from when the first pose was sent, however late that was."""
    ran = runs(SEQUENTIAL, "random")
    cycles = ran.log.cycles.copy()
    cycles["scheduled_ns"][320] -= PERIOD_NS
    ran = replace(ran, log=replace(ran.log, cycles=cycles))
    waited(len(cycles), idle=dict.fromkeys(range(len(cycles)), 10 * PERIOD_NS))
    one = ran.measured.tracked
    assert one.drift_by_bus_ns == one.drift_ns > 0
    assert (one.own_drift_ns, one.late_cycles) == (0, 0)
    assert one.late_by_bus_us * 1000 == pytest.approx(one.drift_ns + ran.injected_ns[320] + PERIOD_NS)


@pytest.mark.parametrize("setup", [SEQUENTIAL, LOOP])
def test_a_run_that_was_stopped_is_measured_as_far_as_it_came(runs, setup):
    assert runs(setup, "none", 100).measured is None, "it ended before the motion"
    one = runs(setup, "none", 480).measured.tracked
    assert not one.ended
    assert one.drift_ns is one.own_drift_ns is None
    assert one.cycles == pytest.approx(160, abs=3)
    assert one.rms_rad > 0


def test_between_samples_the_desired_motion_is_the_formula(motion_file):
    motion = motion_file("3 s", 100)
    desired = desired_motion(motion, compile_files(ROBOT, ACTIVE, [motion]).plan)
    times = np.linspace(0, 3, 1001)
    position, velocity = desired.at(times)
    np.testing.assert_allclose(position, 0.5 * (np.sin(2 * times) - np.sin(4 * times)), atol=4e-7)
    np.testing.assert_allclose(velocity, np.cos(2 * times) - 2 * np.cos(4 * times), atol=2e-4)
    assert desired.duration_ns == 3_000_000_000
    before, behind = desired.at(np.array([-1.0, 4.0]))[0]
    assert before == 0
    assert behind == pytest.approx(0.5 * (math.sin(6) - math.sin(12)))


PART = "  - controller: posvel_trajectory\n    points: [{time: 1 s, joints: {joint: {position: 0 rad}}}]\n"


@pytest.mark.parametrize(
    ("parts", "sentence"),
    [(f"{PART}{PART}    start: 3 s\n", "has 2 parts"), (PART, "has fewer than two positions")],
)
def test_a_motion_that_cannot_be_compared_is_refused(tmp_path, parts, sentence):
    file = tmp_path / "motion.yaml"
    file.write_text(f"name: refused\nmotions:\n{parts}")
    plan = compile_files(ROBOT, ACTIVE, [file]).plan
    with pytest.raises(InputError, match=sentence):
        desired_motion(file, plan)
