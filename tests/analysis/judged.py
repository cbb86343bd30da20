"""Totals of a run, made of lines of text, and findings for the verdict to judge.

    a bus is lost
      event port_lost main: main: the adapter is gone
      => not good
      => 1: Bus main was lost: main: the adapter

A case has a name, indented lines about the run (`GIVEN` reads them, several of a line with `; ` between them;
without any it is a good one), and what is expected of the verdict on it:

    => good, => not good, => word WORD
    => 1: TEXT                        the sentence with this number begins so; `1 lacks: TEXT`: lacks it
    => any: TEXT, => none: TEXT       it is in a sentence or a remedy, or in none
    => has CODE SUBJECT as RANK       there is such a finding; `=> no CODE`: there is not
    => says CODE SUBJECT: TEXT        its sentence has the text; `fix`: its remedy; `no fix`: it has not
"""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from msgspec import structs
from tests.kit.cases import TextCase, place_of, read_form
from tests.kit.totals import holds

from dxlrun import LINEAR, ROTARY
from dxlrun.channels.event_records import RUN_ENDED, EventCode, EventGroup, GoalReport, GoalTotals, Severity
from dxlrun.plan.loop_plan import ControllerPlan, ScheduledCommand, ScheduledGoal
from dxlrun.plan.machine_load import MachineLoad
from dxlrun_analysis.causes.causes import Causes
from dxlrun_analysis.conduct.conduct import Conduct, Takeover
from dxlrun_analysis.conduct.steering_history import Act
from dxlrun_analysis.cycles.punctuality import Latency, Periods
from dxlrun_analysis.finding import Finding, Rank
from dxlrun_analysis.joints.goal_tracking import JointTracking
from dxlrun_analysis.plan_excerpt import NO_LOOP, LoggedBus, LoggedPlan, LoggedServo
from dxlrun_analysis.servos.traffic import ServoTraffic
from dxlrun_analysis.tally import RealTime, RunTotals
from dxlrun_analysis.verdict import judge_run

MS, S = 1_000_000, 10**9
REAL, SIMULATED = "/dev/ttyUSB0", "sim"
BUSY = Causes(load=MachineLoad(10, busy_s=10, no_idle_core_s=9, waited_s=2))
LATE = Latency(9e3, 500.0, 90.0, 9, 0.05, 0.02, 0.0)
WAVE = "/robots/motions/wave.yaml"
COMMANDS = (
    ScheduledCommand(0, "arm", "", b"", f"{WAVE}:4:5", goal=ScheduledGoal(25 * S)),
    ScheduledCommand(S, "head", "", b"", f"{WAVE}:9:9", goal=ScheduledGoal(3 * S)),
    ScheduledCommand(2 * S, "head", "", b"", f"{WAVE}:10:9"),
)


def totals(**changed: Any) -> RunTotals:
    """Return the totals of a good run, changed."""
    periods = Periods(1000, 1000, 0, 0, True, 50.0, 20.0, (50.0,))
    good = RunTotals(periods, Latency(80.0, 10.0, 5.0, 9, 0.0, 0.0, 0.0), joints=("elbow", "wrist"))
    return replace(good, **changed)


def plan(*ports: str) -> LoggedPlan:
    """Return a plan with buses `bus0`, `bus1` ... that have one servo each, and a controller."""
    joints = (LoggedServo(joint, number, row=0) for number, joint in enumerate(("elbow", "wrist"), 1))
    buses = [LoggedBus(f"bus{n}", port, servos=[next(joints)]) for n, port in enumerate(ports)]
    arm = ControllerPlan("arm", "", "", "{}", (), (), (), active=True, every=1)
    return LoggedPlan(structs.replace(NO_LOOP, controllers=(arm,)), buses)


def on_bus(*joints: str, bus: str = "bus0") -> tuple[ServoTraffic, ...]:
    """Return the traffic of servos that answered every time."""
    return tuple(
        ServoTraffic(bus, n, joint, 9, 9, 0, 9, 0, (), 0.0, 0.0) for n, joint in enumerate(joints, 1)
    )


def accusing(code: str, subject: str = "bus0", share: float = 0.5, rank: Rank = Rank.CAUSE) -> Finding:
    """Return a finding whose remedy is left to the table."""
    return Finding(code, subject, f"{subject} has it.", rank=rank, share=share)


def tracked(name: str, worst: float | None = None, **more: Any) -> JointTracking:
    return JointTracking(name, 0, 0.0, 0, None, worst, None, None, None, **more)


def _event(  # noqa: PLR0917  words of a line
    run: RunTotals, code: str, who: str, at: str, times: str, rank: str, text: str
) -> RunTotals:
    severity = {"": Severity.ERROR, "a warning": Severity.WARNING, "fatal": Severity.FATAL}[rank or ""]
    at_ns = round(float(at or 5) * MS)
    words = (text or "").replace("\\n", "\n")
    event = EventGroup(EventCode[code.upper()], severity, who, int(times or 1), at_ns, words)
    return replace(run, events=(*run.events, event))


def _found(run: RunTotals, code: str, subject: str, share: str, rank: str) -> RunTotals:
    finding = accusing(code, subject, float(share or 0.5), Rank[(rank or "cause").upper()])
    return replace(run, findings=(*run.findings, finding))


def _played(run: RunTotals, reached: str, without: str, part: str, no_beginning: str) -> RunTotals:
    begun = {command.origin: 1 for command in COMMANDS[bool(without) : 2]}
    goals = GoalTotals({"accepted": 2, "reached": int(reached or 2)}, begun, ())
    conduct = Conduct(begin_ns=0 if no_beginning else 5 * S, goals=goals, whole=not part)
    tracking = (tracked("elbow", math.radians(2.14)), tracked("wrist", math.radians(0.3)), tracked("free"))
    loop = structs.replace(NO_LOOP, commands=COMMANDS)
    return replace(run, plan=LoggedPlan(loop), tracking=tracking, conduct=conduct, joints=(), latency=None)


def _goal(  # noqa: PLR0917  words of a line
    run: RunTotals, name: str, end: str, joint: str, deg: str, client: str, text: str
) -> RunTotals:
    why, off = RUN_ENDED if text == "RUN_ENDED" else text, math.radians(float(deg or 0))
    report = GoalReport(1, name, "trajectory", f"{WAVE}:4:5", end, why, joint or "", off)
    if client:
        report = structs.replace(report, origin="anna")
    goals = structs.replace(run.conduct.goals, failed=(*run.conduct.goals.failed, report))
    return replace(run, conduct=replace(run.conduct, goals=goals))


def _act(run: RunTotals, refused: str, at_s: str, what: str) -> RunTotals:
    act = Act(float(at_s), 123, "torque", what, "anna", "it is not here" if refused else "")
    return replace(run, acts=(*run.acts, act))


def _ran(run: RunTotals, count: str, seconds: str, skipped: str) -> RunTotals:
    records = int(count) - int(skipped)
    rates = (50.0,) if records else ()
    return replace(
        run, periods=Periods(int(count), records, int(skipped), 0, True, 50.0, float(seconds), rates)
    )


def _conduct(run: RunTotals, **changed: Any) -> RunTotals:
    return replace(run, conduct=replace(run.conduct, **changed))


def _returns(run: RunTotals, who: str, why: str) -> RunTotals:
    return replace(run, returns=run.returns | {who: [*run.returns.get(who, []), why]})


Given = Callable[..., RunTotals]
GIVEN: dict[str, Given] = {
    r"event (\w+) (\w+)(?: at (\d+) ms)?(?: (\d+) times)?(?: as (a warning|fatal))?(?:: (.+))?": _event,
    r"found (\w+) ([\w ]+?)(?:, share ([\d.]+))?(?:, rank (\w+))?": _found,
    r"played wave(?:, (\d) reached)?(, without arm)?(, in part)?(, without a beginning)?": _played,
    r"goal of (\w+) (\w+)(?:, (\w+) ([\d.]+) deg off)?(, of a client)?: (.+)": _goal,
    r"(refused )?act at ([\d.]+) s (.+)": _act,
    r"ran (\d+) periods in ([\d.]+) s, (\d+) skipped": _ran,
    r"returns (\w+): (.+)": _returns,
    r"buses (.+)": lambda run, ports: replace(
        run, plan=plan(*({"real": REAL}.get(port, port) for port in ports.split()))
    ),
    r"servos (.+?)(?: on (\w+))?": lambda run, names, bus: replace(
        run, servos=(*run.servos, *on_bus(*names.split(), bus=bus or "bus0"))
    ),
    r"tolerates (\d+) %": lambda run, percent: replace(
        run, plan=LoggedPlan(structs.replace(NO_LOOP, tolerated_skips=int(percent) / 100))
    ),
    r"invalid (\d+) (\d+)": lambda run, *counts: replace(run, invalid=tuple(map(int, counts))),
    r"failure (.+)": lambda run, text: replace(run, failures=(text,)),
    r"damage (.+)": lambda run, text: replace(run, damage=(text,)),
    r"tracked (\w+), lost at ([\d.]+) rad": lambda run, name, at: replace(
        run, tracking=(tracked(name, lost_at=float(at), unit=ROTARY),)
    ),
    r"tracked (\w+), worst ([\d.]+) m": lambda run, name, worst: replace(
        run, tracking=(tracked(name, float(worst), unit=LINEAR),)
    ),
    r"moved by its controllers, 1 of 1 cancelled": lambda run: replace(
        _conduct(_played(run, "", "", "", ""), goals=GoalTotals({"accepted": 1, "cancelled": 1})),
        plan=LoggedPlan(),
    ),
    r"(\w+) fell back to (\w+) at ([\d.]+) s: (.+)": lambda run, name, to, at_s, why: _conduct(
        run, takeovers=(Takeover(float(at_s), name, to, why),)
    ),
    r"(\w+) had no fallback again": lambda run, name: _conduct(run, unanswered=(name,)),
    r"machine busy": lambda run: replace(run, causes=BUSY),
    r"machine wakes late": lambda run: replace(run, latency=LATE),
    r"on virtual time": lambda run: replace(run, virtual=True),
    r"scheduler requested": lambda run: replace(run, real_time=RealTime(requested=True)),
    r"scheduler granted": lambda run: replace(run, real_time=RealTime(requested=True, granted=True)),
}


def check_case(case: TextCase) -> None:
    """Judge the run of a case, and compare the verdict with what is expected."""
    run = totals()
    expected = [(line.place, line.text[3:]) for line in case.lines if line.text.startswith("=> ")]
    assert expected, f"{case.place}: nothing is expected"
    for line in case.lines:
        for text in [] if line.text.startswith("=> ") else line.text.split("; "):
            with place_of(line):
                run = read_form(GIVEN, text)(run)
    verdict = judge_run(run)
    shown = "\n".join(
        f"{one.code} {one.subject} {one.rank!r}: {one.sentence} -> {one.remedy}" for one in verdict.findings
    )
    for place, text in expected:
        assert holds(verdict, text), f"{place}: {text}\n{verdict.word}\n{shown}"
