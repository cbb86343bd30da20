"""The first line of a verdict: what the robot did, as an onlooker would say it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec import structs
from tests.kit.totals import totals_of

from dxlrun import LINEAR, ROTARY, JointUnit
from dxlrun.channels.event_records import RUN_ENDED, EventCode, EventGroup, GoalReport, GoalTotals, Severity
from dxlrun.log.log_reader import Log, read_log
from dxlrun.plan.loop_plan import ScheduledCommand, ScheduledGoal
from dxlrun.testing import simulated_robot
from dxlrun_analysis.conduct.conduct import Conduct, ConductHistory, Takeover
from dxlrun_analysis.conduct.steering_history import Act
from dxlrun_analysis.cycles.punctuality import Periods
from dxlrun_analysis.finding import Finding, Rank
from dxlrun_analysis.joints.goal_tracking import JointTracking
from dxlrun_analysis.plan_excerpt import NO_LOOP, LoggedPlan
from dxlrun_analysis.tally import RunTotals
from dxlrun_analysis.verdict import judge_run

S = 10**9
ROBOTS = Path(__file__).parents[2] / "robots"
WAVE = "/robots/motions/wave.yaml"
PLAN = LoggedPlan(
    structs.replace(
        NO_LOOP,
        commands=(
            ScheduledCommand(0, "arm", "", b"", f"{WAVE}:4:5", goal=ScheduledGoal(25 * S)),
            ScheduledCommand(S, "head", "", b"", f"{WAVE}:9:9", goal=ScheduledGoal(3 * S)),
            ScheduledCommand(2 * S, "head", "", b"", f"{WAVE}:10:9"),
        ),
    )
)


def tracked(name: str, worst_rad: float | None, unit: JointUnit = ROTARY) -> JointTracking:
    return JointTracking(name, 0, 0.0, 0, None, worst_rad, None, None, None, unit=unit)


def totals(**changed: Any) -> RunTotals:
    account = Periods(1000, 1000, 0, 0, True, 50.0, 20.0, (50.0,))
    tracking = (
        tracked("elbow", math.radians(2.14)),
        tracked("wrist", math.radians(0.3)),
        tracked("free", None),
    )
    conduct = Conduct(begin_ns=5 * S, goals=goals(2), whole=True)
    return replace(RunTotals(account, plan=PLAN, tracking=tracking, conduct=conduct), **changed)


def goals(reached: int, *failed: GoalReport) -> GoalTotals:
    """Return two goals of the motion file that began, so many of which were reached."""
    begun = {f"{WAVE}:4:5": 1, f"{WAVE}:9:9": 1}
    return GoalTotals({"accepted": 2, "reached": reached}, begun, failed)


def line(**changed: Any) -> str:
    return judge_run(totals(**changed)).sentences[0]


def happened(code: EventCode, source: str, at_s: float) -> EventGroup:
    return EventGroup(code, Severity.ERROR, source, 1, round(at_s * S), "")


def conduct(**changed: Any) -> Conduct:
    return replace(totals().conduct, **changed)


def test_a_motion_that_was_played() -> None:
    assert line() == "Good: played wave (2 motions) within 2.1 deg (elbow); 2 of 2 goals reached."


def test_only_motions_that_began_were_played() -> None:
    none = replace(totals().periods, seconds=0.5)
    assert line(periods=none).startswith("Good: played wave (1 motion) within")
    assert line(plan=LoggedPlan(), conduct=Conduct()) == "Good: ran for 20.0 s without a motion."


def test_a_linear_joint_is_in_millimetres() -> None:
    assert "within 3.2 mm (jaw)" in line(tracking=(tracked("jaw", 0.0032, LINEAR),))


def test_what_fails_comes_before_what_was_played() -> None:
    missed = GoalReport(1, "arm", "trajectory", f"{WAVE}:4:5", "aborted", "limp", "elbow", math.radians(12.0))
    events = (
        happened(EventCode.SERVO_LIMP, "elbow", 17.3),
        happened(EventCode.SERVO_LOST, "hip", 9.0),
        happened(EventCode.SERVO_LOST, "knee", 8.0),
    )
    assert line(events=events, conduct=conduct(goals=goals(1, missed))) == (
        "Not good: knee, hip were lost from 3.0 s on; elbow went limp at 12.3 s; wave of arm aborted (elbow "
        "12.0 deg off); played wave (2 motions) within 0.3 deg (wrist); 1 of 2 goals reached."
    )


def test_what_happened_to_the_same_joints_is_told_together_as_it_came() -> None:
    events = [
        happened(code, joint, at_s + at / 10)
        for code, at_s in (
            (EventCode.SERVO_LIMP, 8.2),
            (EventCode.SERVO_LOST, 8.0),
            (EventCode.SERVO_REBOOTED, 8.1),
        )
        for at, joint in enumerate(("knee", "hip"))
    ]
    assert line(events=tuple(events)).startswith(
        "Not good: knee, hip were lost at 3.0 s, rebooted at 3.1 s, went limp at 3.2 s; played wave "
    )


def test_a_goal_of_a_played_motion_that_was_missed_is_not_good() -> None:
    missed = GoalReport(1, "arm", "trajectory", f"{WAVE}:4:5", "missed", "elbow is 0.2 off", "elbow", 0.2)
    verdict = judge_run(totals(conduct=conduct(goals=goals(1, missed))))
    assert not verdict.good
    assert verdict.findings[1].code == "goal_missed"
    assert "Not good: wave of arm missed its goal (elbow 11.5 deg off);" in verdict.sentences[0]
    a_client_s = conduct(goals=goals(2, structs.replace(missed, origin="anna")))
    assert judge_run(totals(conduct=a_client_s)).good


def test_played_goal_that_the_end_of_the_run_cut_is_not_good() -> None:
    cut = GoalReport(1, "arm", "trajectory", f"{WAVE}:4:5", "aborted", RUN_ENDED)
    verdict = judge_run(totals(conduct=conduct(goals=goals(1, cut))))
    assert not verdict.good
    assert verdict.sentences[0].startswith(
        "Not good: the run ended before the end of wave of arm; played wave "
    )
    assert verdict.sentences[1] == "The run ended at 20 s, before wave of arm ended at 25 s."
    a_client_s = structs.replace(cut, origin="anna")
    assert line(conduct=conduct(goals=goals(1, a_client_s))).startswith("Good: the run ended before ")


def test_played_goal_that_never_began_is_not_good() -> None:
    begun = structs.replace(goals(1), begun={f"{WAVE}:9:9": 1})
    verdict = judge_run(totals(conduct=conduct(goals=begun)))
    assert verdict.sentences[0].startswith("Not good: wave of arm never began; ")
    part = judge_run(totals(conduct=conduct(goals=begun, whole=False)))
    assert part.good, "the motion may have begun in another part of the log"


def test_what_failed_before_the_first_cycle_has_no_time_of_the_run() -> None:
    events = (happened(EventCode.SERVO_LOST, "knee", 18_886.5),)
    assert line(events=events, conduct=Conduct()).startswith("Not good: knee was lost; played wave ")


def test_joints_that_a_client_released_are_said() -> None:
    acts = [
        Act(2.46, 123, "torque", f"torque {words}", "anna", "") for words in ("off: knee, hip", "on: hip")
    ]
    refused = Act(3.0, 150, "torque", "torque off: elbow", "anna", "it is not here")
    assert line(acts=(*acts, refused)).startswith(
        "Good: torque of knee, hip off by request at 2.5 s; played "
    )


def test_of_a_log_that_was_cut_it_is_not_known_how_long_the_run_was() -> None:
    cut = line(plan=LoggedPlan(), conduct=Conduct(), damage=("it ends in a chunk",))
    assert cut == "Not good: the log is incomplete; the log has 20.0 s without a motion."


def test_a_run_that_is_not_good_for_another_reason_says_it() -> None:
    slow = replace(totals().periods, records=500, skipped=500)
    assert line(periods=slow).startswith("Not good: the loop did not keep its rate; played wave ")


@pytest.mark.parametrize(
    ("finding", "reason"),
    [
        (Finding("stood_still", "elbow", "It.", rank=Rank.SERVO), "elbow: stood still"),
        (Finding("supply", "elbow", "It.", rank=Rank.SHARE_CAUSE), ""),
        (Finding("log_not_whole", "log", "It.", rank=Rank.LOG), "the log is incomplete"),
    ],
)
def test_the_first_fact_is_the_reason(finding: Finding, reason: str) -> None:
    assert line(findings=(finding,)).startswith(f"Not good: {reason}{'; ' * bool(reason)}played wave ")


def test_an_error_that_was_logged_is_the_reason_in_its_own_words() -> None:
    text = "loop fault after 9 cycles, 0 periods skipped: the battery has 10.7 V"
    ended = EventGroup(EventCode.LOOP_STOPPED, Severity.FATAL, "loop", 1, 9 * S, text)
    assert line(events=(ended,)).startswith("Not good: the battery has 10.7 V; played wave ")


def test_goals_that_a_client_cancelled_are_said() -> None:
    gone = conduct(goals=GoalTotals({"accepted": 1, "cancelled": 1}))
    assert line(conduct=gone, plan=LoggedPlan()).endswith(
        "moved by clients within 2.1 deg (elbow); 1 goal cancelled."
    )


def test_a_fault_that_a_fallback_took_over_is_good_with_fallbacks() -> None:
    fault = happened(EventCode.CONTROLLER_FAULT, "arm", 7.0)
    fallback = Takeover(2.0, "arm", "hold", "a gain of 0")
    verdict = judge_run(totals(events=(fault,), conduct=conduct(takeovers=(fallback,))))
    assert (verdict.good, verdict.word) == (True, "good, with fallbacks")
    assert verdict.sentences[0].startswith(
        "Good, with fallbacks: arm failed (a gain of 0) and fell back to hold at 2.0 s; "
    )
    assert not [one for one in verdict.findings if one.code == "errors_logged"]
    again = judge_run(totals(events=(fault,), conduct=conduct(takeovers=(fallback,), unanswered=("arm",))))
    assert (again.good, again.word) == (False, "not good")


def test_the_line_is_first_and_accuses_nothing() -> None:
    hot = Finding("servo_error", "elbow", "It is hot.", rank=Rank.LINE)
    robot, first, *_ = judge_run(totals(findings=(hot,))).findings
    assert (robot.code, robot.subject, robot.rank, first) == ("robot", "", Rank.REMARK, hot)


# Falls


def test_a_robot_that_its_fall_reflex_could_not_keep_up_fell(tmp_path: Path) -> None:
    log = tmp_path / "run.mcap"
    motion = ROBOTS / "motions/fall_reflex_tip.yaml"
    simulated_robot(ROBOTS / "fall_reflex.yaml", play=[motion], log=log).run()
    verdict = judge_run(totals_of(log))
    assert not verdict.good
    assert verdict.sentences[0].startswith(
        "Not good: the robot fell at 1.6 s and did not get up; played fall_reflex_tip "
    )
    assert verdict.findings[1].code == "fell"


def orientation(pitch_deg: float) -> tuple[float, ...]:
    half = math.radians(pitch_deg) / 2
    return 0.0, math.sin(half), 0.0, math.cos(half)


def acceleration(pitch_deg: float) -> tuple[float, ...]:
    return -9.81 * math.sin(math.radians(pitch_deg)), 0.0, 9.81 * math.cos(math.radians(pitch_deg))


@pytest.mark.parametrize("measure", [orientation, acceleration])
@pytest.mark.parametrize(
    ("begin", "end", "lies"),
    [
        (0, 0, False),
        (0, 59, False),
        (0, 61, True),
        (10, -80, True),
        (0, 180, True),
        (90, 0, False),
        (90, 170, True),
    ],
)
def test_a_robot_lies_whose_gravity_has_turned(
    short: Log, measure: Callable[[float], tuple[float, ...]], begin: float, end: float, lies: bool
) -> None:
    states = "xyzw" if measure is orientation else "xyz"
    kind = "orientation" if measure is orientation else "linear_acceleration"
    header = structs.replace(
        short.header, sources={"board": ("voltage",), "imu": tuple(f"{kind}.{n}" for n in states)}
    )
    cycles = np.zeros(200, header.layout.dtype)
    angles = np.interp(np.arange(200), [0, 60, 120, 200], [begin, begin, end, end])
    cycles["source_state"] = [(12.0, *measure(angle)) for angle in angles]
    cycles["source_valid"] = True
    cycles["source_valid"][::3] = False
    cycles["source_state"][::3] = math.nan
    history = ConductHistory()
    for part in np.split(cycles, 4):
        history.add_slice(replace(short, header=header, cycles=part))
    found = history.summarize_conduct()
    assert found.turned_rad == pytest.approx(math.radians(abs(end - begin)), abs=1e-6)
    assert found.lies is lies


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory) -> Log:
    """The log of a robot without an IMU."""
    path = tmp_path_factory.mktemp("short") / "run.mcap"
    simulated_robot(ROBOTS / "single_joint.yaml", duration_s=0.02, log=path).run()
    return read_log(path)


def test_a_robot_without_an_imu_does_not_fall(short: Log) -> None:
    history = ConductHistory()
    history.add_slice(short)
    assert (history.summarize_conduct().turned_rad, history.summarize_conduct().lies) == (None, False)


# Controllers that fail
