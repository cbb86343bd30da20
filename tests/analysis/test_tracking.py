"""Tracking against the trajectory that a servo could reach, of known joints; whole and in slices."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from msgspec import structs
from tests.kit.made_logs import loop_of, made_log

from dxlrun.channels.cycle import CycleLayout, Torque
from dxlrun.output.json import json_text
from dxlrun.plan.loop_plan import JointPlan
from dxlrun.testing import Log, read_log, simulated_robot
from dxlrun_analysis.joints import goal_tracking as module
from dxlrun_analysis.joints.delay import DelayFit
from dxlrun_analysis.joints.goal_tracking import JointTracking, TrackingCollector, reachable, tracking
from dxlrun_analysis.page.report_page import analyzed_page
from dxlrun_analysis.report import analyze, tables

ROBOTS = Path(__file__).parents[2] / "robots"
DT = 0.02
TICK = math.radians(300) / 1023
NAN = math.nan
Way = npt.NDArray[np.float64]
NECK = JointPlan("neck", -3.0, 3.0, None, top_speed=6.0)


@pytest.fixture
def make(tmp_path):
    """Return a log of one MX-64 that was sent these goals, and was read at these positions, one a cycle."""

    def make(
        goals: Way, positions: Way, speed: float = NAN, registers: dict[str, int] | None = None, **joint: Any
    ) -> Log:
        servo = {"joint": "neck", "model": "MX-64", "rad_per_tick": TICK, "rad_s_per_tick": 0.01}
        servo["registers"] = [{"name": name, "value": value} for name, value in (registers or {}).items()]
        plan = {
            "loop": loop_of(joints=(structs.replace(NECK, **joint),)),
            "buses": [{"protocol": 1.0, "servos": [servo]}],
        }
        log = read_log(made_log(tmp_path, plan=plan))
        cycles = np.zeros(len(goals), CycleLayout(("neck",), []).dtype)
        number = np.arange(len(goals))
        cycles["cycle"] = number
        for name in ("scheduled_ns", "woken_ns", "read_ns", "updated_ns", "written_ns"):
            cycles[name] = 10**9 + number * round(DT * 1e9)
        cycles["position"][:, 0], cycles["goal_position"][:, 0] = positions, goals
        cycles["goal_velocity"][:, 0] = speed
        cycles["valid"][:, 0] = np.isfinite(positions)
        header = structs.replace(log.header, joints=("neck",), controllers=())
        return replace(log, header=header, cycles=cycles)

    return make


def stepped(count: int, at: int, goal: float) -> Way:
    """Return goals that are 0 before a cycle, and another one from it on."""
    return np.where(np.arange(count) < at, 0.0, goal)


def ramp(count: int, at: int, goal: float, speed: float, delay: int = 0) -> Way:
    """Return the way to a goal that was sent in a cycle, at a speed, some cycles late."""
    return np.clip((np.arange(count) - at - delay) * DT * speed, 0.0, goal)


def only(log: Log) -> JointTracking:
    (joint,) = tracking(log)
    return joint


STEP = stepped(100, 10, 1.0)
UNKNOWN_FIRST = np.where(np.arange(100) < 20, NAN, 1.0)
READ_LATER = np.where((np.arange(100) >= 20) & (np.arange(100) < 23), NAN, 0.4)
WAYS: dict[str, tuple[Way, Way, dict[str, Any], Way]] = {
    "no speed: that of the servo": (STEP, np.zeros(100), {}, ramp(100, 10, 1.0, 6.0)),
    "no speed: the limit of the joint": (STEP, np.zeros(100), {"velocity": 2.0}, ramp(100, 10, 1.0, 2.0)),
    "no speed, no limit": (STEP, np.zeros(100), {"top_speed": None}, ramp(100, 10, 1.0, 1e9)),
    "a speed of 0 is the slowest, not none": (STEP, np.zeros(100), {"speed": 0.0}, ramp(100, 10, 1.0, 0.01)),
    "a first goal: from where it stands": (
        *(np.full(100, 1.0), np.zeros(100), {"speed": 0.5}),
        ramp(100, 0, 1.0, 0.5),
    ),
    "a goal before it is read": (
        *(UNKNOWN_FIRST, READ_LATER, {"speed": 0.5}),
        np.where(np.arange(100) < 23, NAN, 0.4 + ramp(100, 23, 0.6, 0.5)),
    ),
}


@pytest.mark.parametrize("which", WAYS)
def test_a_way_is_as_fast_as_the_servo_may_be(make, which):
    goals, positions, options, expected = WAYS[which]
    log = make(goals, positions, **options)
    assert reachable(log, 0) == pytest.approx(expected, nan_ok=True)
    # it never moved, and that is an error
    assert only(log).worst_rad == pytest.approx(np.nanmax(np.abs(expected - positions)))


def test_a_declared_acceleration_counts(make):
    # Goal Acceleration (73) of an MX-64: 8.583 deg/s^2 each
    log = make(stepped(200, 10, 1.0), np.zeros(200), speed=2.0, registers={"goal_acceleration": 20})
    way, ramp_rad_s2 = reachable(log, 0), 20 * math.radians(8.583)
    faster = np.diff(np.diff(way)) / DT**2
    assert np.abs(faster[:40]).max() == pytest.approx(ramp_rad_s2)
    # 2 * sqrt(way / acceleration) for a triangle
    arrived = int(np.argmax(way == 1.0)) - 10
    assert arrived * DT == pytest.approx(2 * math.sqrt(1.0 / ramp_rad_s2), abs=4 * DT)
    assert way.max() == 1.0


def test_a_stream_that_is_too_fast_is_cut_to_the_speed_that_there_is(make):
    goals = np.concatenate((np.linspace(0.0, 4.0, 50), np.full(150, 4.0)))  # 4 rad/s
    way = reachable(make(goals, np.zeros(200), velocity=2.0), 0)
    assert np.diff(way).max() == pytest.approx(2.0 * DT)
    assert int(np.argmax(way == 4.0)) == pytest.approx(100, abs=2)


def test_a_joint_that_is_given_torque_goes_to_no_goal_from_before(make):
    """A reboot took it back by two turns, and its goal with it."""
    goals = stepped(100, 40, -4 * math.pi)
    log = make(goals, goals, speed=0.5)
    log.cycles["torque"] = Torque.ON
    log.cycles["torque"][40:60] = Torque.OFF
    log.cycles["torque"][60] = Torque.GIVEN
    assert reachable(log, 0)[62:] == pytest.approx(np.full(38, -4 * math.pi))


# Errors, lag, settling


def late_sine() -> tuple[Way, Way]:
    t = np.arange(500) * DT
    return 0.4 * np.sin(2 * t), 0.4 * np.sin(2 * (t - DT - 0.03))


def two_ways() -> tuple[Way, Way]:
    """The first rests 0.05 rad off, the second comes there 30 cycles after its way."""
    goals = np.concatenate((stepped(150, 10, 1.0), np.full(150, 2.0)))
    way = np.concatenate((ramp(150, 10, 1.0, 0.5), 1.0 + ramp(150, 0, 1.0, 0.5)))
    way[110:151] += 0.05
    return goals, np.where(way > 1.5, way - 0.2 * (np.arange(300) < 280), way)


def with_an_effort_in_between() -> tuple[Way, Way]:
    goals = np.concatenate((np.zeros(60), np.full(80, NAN), np.ones(60)))
    return goals, np.nan_to_num(goals)


def near(value: float, within: float = 1e-6) -> Any:
    return pytest.approx(value, abs=within)


NUMBERS = ("rms_rad", "worst_rad", "lag_ms", "settling_ms", "rest_rad")
ANY = object()
JOINTS: dict[str, tuple[tuple[Way, Way], float, tuple[object, ...]]] = {
    "the way of a step": (
        *((stepped(150, 10, 1.0), ramp(150, 10, 1.0, 0.5)), 0.5),
        (near(0.0), near(0.0), near(0.0), near(0.0), near(0.0)),
    ),
    "a delay: 0.03 of a way of 1 are left, and 2 % are near": (
        *((stepped(200, 10, 1.0), ramp(200, 10, 1.0, 0.5, delay=3)), 0.5),
        (ANY, near(0.03), near(60.0, 1.2), near(20.0, 20.1), near(0.0)),
    ),
    "at rest wherever its goals are known": (with_an_effort_in_between(), NAN, (ANY, ANY, None, ANY, ANY)),
    "a stream that it can follow": (late_sine(), NAN, (ANY, near(0.024, 5e-4), near(30.0, 0.6), None, None)),
    "no goal": ((np.full(20, NAN), np.full(20, 0.4)), NAN, (None, None, None, ANY, None)),
    "two ways": (two_ways(), 0.5, (ANY, ANY, ANY, near(600.0, 21.0), near(0.05, 0.002))),
}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("which", JOINTS)
def test_joint_is_measured_against_its_way(make, which):
    (goals, positions), speed, expected = JOINTS[which]
    joint = only(make(goals, positions, speed=speed))
    for name, value in zip(NUMBERS, expected, strict=True):
        assert value is ANY or getattr(joint, name) == value, name


def test_ringing_is_settling_and_sagging_is_error_at_rest(make):
    after = np.maximum(np.arange(300) - 110, 0) * DT  # 1 rad at 0.5 rad/s from cycle 10 on
    rings = 0.1 * np.exp(-after / 0.2) * np.sin(20 * after) * (after > 0)
    joint = only(make(stepped(300, 10, 1.0), ramp(300, 10, 1.0, 0.5) + rings - 0.05 * (after > 0), speed=0.5))
    outside = after[np.abs(rings) > 0.02].max()
    assert outside > 0.2
    assert joint.settling_ms == pytest.approx((outside + DT) * 1e3, abs=21)
    assert joint.rest_rad == pytest.approx(0.05, abs=2e-3)


def test_states_that_are_not_valid_are_no_error_and_a_joint_that_stands_has_no_lag(make):
    positions = np.full(100, 0.001 * np.arange(100) % 2)
    positions[50] = NAN
    log = make(np.zeros(100), positions)
    log.cycles["position"][50, 0] = 3.0  # any value may stand there
    joint = only(log)
    assert (joint.invalid, joint.lag_ms, joint.settling_ms) == (1, None, None)
    assert joint.worst_rad == pytest.approx(0.099)


def test_terminal_report_and_json_have_the_same_numbers(make):
    log = make(stepped(200, 10, 1.0), ramp(200, 10, 1.0, 0.5, delay=3), speed=0.5)
    report = analyze(log)
    (row,) = tables(report)["joints"].rows
    shown = dict(zip((column.name for column in tables(report)["joints"].columns), row, strict=True))
    assert [shown[name].text for name in ("worst", "lag", "at rest")] == ["1.72", "59 ms", "0.00"]
    (as_json,) = json.loads(json_text(report.numbers))["joints"]
    assert as_json["lag_ms"] == pytest.approx(60.0, rel=0.02)
    assert as_json["worst_rad"] == pytest.approx(0.03)
    words = "worst 1.72 deg (position minus reachable trajectory), lag 59 ms, settled after"
    assert words in analyzed_page(log)[1]


@pytest.fixture(scope="module")
def torso(tmp_path_factory):
    path = tmp_path_factory.mktemp("torso") / "run.mcap"
    play = [ROBOTS / "motions/three_parts.yaml"]
    simulated_robot(ROBOTS / "bioloid_torso.yaml", play=play, duration_s=9.0, log=path).run()
    return read_log(path)


def changed(log: Log, seed: int) -> Log:
    """Return a log with steps of its goals, speeds that do not reach them in a cycle, and missing states."""
    chance = np.random.default_rng(seed)
    cycles = log.cycles.copy()
    count, joints = cycles["goal_position"].shape
    steps = np.repeat(chance.uniform(-1, 1, (count // 25 + 1, joints)), 25, axis=0)[:count]
    cycles["goal_position"] += np.where(chance.random(joints) < 0.5, steps, 0.0)
    cycles["goal_velocity"] = np.where(chance.random(joints) < 0.5, chance.uniform(0.2, 3.0, joints), NAN)
    cycles["goal_position"][chance.random((count, joints)) < 0.002] = NAN
    cycles["valid"] &= chance.random((count, joints)) > 0.02
    plan = log.attachments["plan.json"]
    if seed % 2:
        register = b'"registers":[{"name":"goal_acceleration","value":3}]'
        plan = plan.replace(b'"registers":[]', register).replace(b"AX-12A", b"MX-64")
    return replace(log, cycles=cycles, attachments={**log.attachments, "plan.json": plan})


@pytest.mark.parametrize("seed", range(4))
def test_slices_give_what_the_whole_log_gives(torso, seed, monkeypatch):
    log = changed(torso, seed) if seed else torso
    whole = tracking(log)  # shorter than a block
    assert any(joint.lag_ms is not None for joint in whole)
    monkeypatch.setattr(module, "_BLOCK", 100)
    for size in (1, 37, 10_000):
        collected = TrackingCollector()
        for start in range(0, len(log.cycles), size):
            collected.add_slice(replace(log, cycles=log.cycles[start : start + size]))
        for found, expected in zip(collected.evaluate_joints(log), whole, strict=True):
            for name in (*NUMBERS, "invalid", "oldest_ms", "clamped", "delay_ms"):
                value = getattr(expected, name)
                close = value if value is None else pytest.approx(value, rel=1e-9, abs=1e-12)
                assert getattr(found, name) == close, (size, name)


def test_what_rests_for_very_long_is_kept_in_bounded_memory(monkeypatch):
    monkeypatch.setattr(module, "_LONGEST_REST_S", 0.5)
    found, rested = module._OpenRest(), []
    for start in range(0, 10_000, 50):
        times = np.arange(start, start + 50) * 0.02
        rested += list(found.find_rests(times, np.zeros(50), np.full(50, 0.01), 1e-3, final=False))
        assert sum(len(times) for times, *_ in found.held) <= 76
    assert len(rested) > 100
    assert {rest.error_rad for rest in rested} == {0.01}


NUMBER = np.arange(2000)
SWING = np.sin(NUMBER * 0.05)


def fitted(goal: Way, position: Way, size: int = 100) -> float | None:
    """Return the delay of a joint that was sent these goals, counted in slices."""
    fit = DelayFit()
    for start in range(0, len(NUMBER), size):
        first = max(0, start - 2)
        part = slice(first, start + size)
        fit.add_cycles(NUMBER[part] * DT, goal[part], position[part], start - first)
    return fit.best_s(0.01)


@pytest.mark.parametrize("cycles", [1.0, 3.0, 4.5, 11.0, 20.25])
@pytest.mark.parametrize("size", [100, 2000])
def test_the_delay_is_found_to_a_tenth_of_a_cycle(cycles, size):
    late = np.sin((NUMBER - cycles) * 0.05)
    noise = 0.05 * np.random.default_rng(1).standard_normal(len(NUMBER))
    assert fitted(SWING, late, size) == pytest.approx(cycles * DT, abs=0.002)
    assert fitted(SWING, late + noise, size) == pytest.approx(cycles * DT, abs=0.003)


def test_the_delay_is_refused_where_none_explains_the_difference():
    assert fitted(SWING, np.sin((NUMBER - 60) * 0.05)) is None  # beyond the longest
    assert fitted(SWING, np.full(2000, 0.3)) is None  # a joint that is blocked
    assert fitted(np.full(2000, 0.5), np.full(2000, 0.5)) is None
    assert DelayFit().best_s(0.01) is None
