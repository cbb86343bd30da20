"""Totals of a run, the input of the rules of the verdict, collected slice by slice from a log."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Protocol, TypeVar, cast

import msgspec

from dxlrun import Log
from dxlrun.tooling.logs import FAILURES_NAME, SUMMARY_NAME, UNREADABLE
from dxlrun.tooling.plans import UnreachedGoal, find_unreached_goals
from dxlrun.tooling.records import (
    EventCode,
    EventCounts,
    EventGroup,
    LostRecords,
    SchedulerGrant,
    SimulationStall,
    SimulationWait,
)
from dxlrun_analysis.causes.causes import NO_CAUSES, Causes, CycleCauses
from dxlrun_analysis.conduct.conduct import NO_CONDUCT, Conduct, ConductHistory
from dxlrun_analysis.conduct.frozen_sources import FrozenSources
from dxlrun_analysis.conduct.steering_history import Act, Pause, SteeringHistory
from dxlrun_analysis.cycles.punctuality import Latency, LongCycle, Periods, Punctuality, on_virtual_time
from dxlrun_analysis.finding import Finding
from dxlrun_analysis.joints.goal_tracking import JointTracking, TrackingCollector
from dxlrun_analysis.joints.health import ServoHealth
from dxlrun_analysis.plan_excerpt import LoggedPlan, plan_of
from dxlrun_analysis.servos.exchanges import Exchanges
from dxlrun_analysis.servos.traffic import BusTraffic, ServoTraffic, Traffic

_SHORT_RUN_S = 2.0
"""Run length from which the number of tolerated skips grows with the run; a shorter run may skip as many.
One stall does not overload a machine."""
_ANSWERS = " answers "  # Event text about a lost servo that answers again but cannot be taken back


@dataclass(frozen=True, slots=True)
class RealTime:
    """Real-time scheduling that the loop requested, and whether it was granted."""

    requested: bool = False  # A real-time scheduler was requested
    granted: bool = False
    kernel: bool = False  # The kernel is a real-time kernel


@dataclass(frozen=True, slots=True)
class RunTotals:
    """Totals of one run: everything that the rules of the verdict need."""

    periods: Periods
    latency: Latency | None = None  # None if the loop never ran a cycle, and without a log
    slowest: LongCycle | None = None
    causes: Causes = NO_CAUSES  # Causes of late and long cycles
    virtual: bool = False
    plan: LoggedPlan = field(default_factory=LoggedPlan)
    real_time: RealTime = RealTime()
    joints: tuple[str, ...] = ()
    invalid: tuple[int, ...] = ()
    """Number of cycles in which the state of each joint was invalid, except those of a requested reboot."""
    servos: tuple[ServoTraffic, ...] = ()
    buses: tuple[BusTraffic, ...] = ()
    events: tuple[EventGroup, ...] = ()  # In order of the first event of each group
    returns: dict[str, list[str]] = field(default_factory=dict)
    """Reasons why lost servos that answered again could not be taken back, by joint."""
    acts: tuple[Act, ...] = ()
    pauses: tuple[Pause, ...] = ()
    failures: tuple[str, ...] = ()  # Failures outside the loop, one sentence each
    # Waits of the loop for simulated servos whose process was not scheduled.
    wait: SimulationWait = field(default_factory=SimulationWait)
    gaps: int = 0  # Records that the recorder did not receive
    damage: tuple[str, ...] = ()
    tracking: tuple[JointTracking, ...] = ()  # Tracking of each joint, in the order of `joints`
    conduct: Conduct = NO_CONDUCT
    findings: tuple[Finding, ...] = ()  # Findings from the rules of each room's accumulators

    @property
    def unreached_goals(self) -> list[UnreachedGoal]:
        """Goals of played motions that the run did not reach, judged as at the end of the run itself.

        Motions that begin in a part of the log that is not given are excluded.
        """
        conduct, ran_ns = self.conduct, round(self.periods.seconds * 1e9)
        found = find_unreached_goals(self.plan.loop, conduct.goals, ran_ns)
        return [goal for goal in found if conduct.whole or goal.report is not None]

    @property
    def tolerated_skips(self) -> float:
        """Number of periods that the run may skip, by `loop: {tolerated_skips: ...}` of the robot file."""
        fewest = _SHORT_RUN_S * self.periods.rate_hz
        return self.plan.loop.tolerated_skips * max(self.periods.elapsed, fewest)

    @property
    def kept_rate(self) -> bool:
        """True if the loop ran and skipped no more than `tolerated_skips` periods."""
        return bool(self.periods.records) and self.periods.skipped <= self.tolerated_skips

    def bus_of(self, subject: str) -> str:
        """Return the name of the bus of an accused servo or joint, or `subject` itself if it is neither."""
        # A joint of several servos is not the subject of any one of them.
        movers = (mover.bus.name for mover in self.plan.movers.get(subject, ()))
        return next((servo.bus for servo in self.servos if servo.subject == subject), next(movers, subject))


class Collector(Protocol):
    """Interface of an accumulator that collects one subject of a log, slice by slice."""

    def add_slice(self, log: Log) -> None:
        """Add the next slice of the log."""


C = TypeVar("C", bound=Collector)


class Tally:
    """Set of all accumulators for the report, fed with a log slice by slice, in constant memory."""

    def __init__(
        self, watch: Callable[[Exchanges], None] = lambda _: None, others: Iterable[type[Collector]] = ()
    ) -> None:
        """Create the accumulators.

        Args:
            watch: Function that also receives all exchanges.
            others: Further collector classes; one instance of each receives the slices.
        """
        own = (
            *(Punctuality(), CycleCauses(), Traffic(watch), ServoHealth()),
            *(TrackingCollector(), SteeringHistory(), ConductHistory(), FrozenSources()),
        )
        self._collectors: dict[type[Collector], Collector] = {type(each): each for each in own}
        self._collectors |= {kind: kind() for kind in others}
        self._events = EventCounts()
        self._returns: dict[str, list[str]] = {}
        self._granted = False
        self._unread = 0
        self._wait = SimulationWait()

    def find_collector(self, kind: type[C]) -> C:
        """Return the accumulator of a class."""
        return cast("C", self._collectors[kind])

    def add_slice(self, log: Log) -> None:
        """Give the next slice of the log to all accumulators.

        Raises:
            LogError: A packet in the slice cannot be read.
        """
        for collector in self._collectors.values():
            collector.add_slice(log)
        for event in log.events:
            self._events.count_event(event)
            with suppress(*UNREADABLE):
                if event.code == EventCode.SCHEDULER and event.source == "loop":
                    granted = msgspec.json.decode(event.data, type=SchedulerGrant)
                    if granted.request == "scheduler":
                        self._granted = granted.granted
                elif event.code == EventCode.SERVO_LOST and (why := event.text.partition(_ANSWERS)[2]):
                    self._returns.setdefault(event.source, []).append(f"answers {why}")
                elif event.code == EventCode.RECORDER_GAP:
                    self._unread += msgspec.json.decode(event.data, type=LostRecords).lost
                elif event.code == EventCode.SIMULATION_STALLED:
                    data, wait = msgspec.json.decode(event.data, type=SimulationStall), self._wait
                    self._wait = SimulationWait(wait.waited_ns + data.waited_ns, wait.times + data.times)

    def totals(self, log: Log) -> RunTotals:
        """Return the totals of all slices, when none follows.

        Args:
            log: Metadata of the file, which the last slice completes.
        """
        punctuality, traffic = self.find_collector(Punctuality), self.find_collector(Traffic)
        account, late = punctuality.compute_latency()
        servos, buses = traffic.summarize_traffic()
        acts, pauses = self.find_collector(SteeringHistory).collect_acts()
        tracking = self.find_collector(TrackingCollector).evaluate_joints(log)
        conduct = self.find_collector(ConductHistory).summarize_conduct()
        movement = tuple(self.find_collector(TrackingCollector).movement.findings(conduct.goals.allowed))
        gaps = self._unread
        with suppress(KeyError, ValueError):
            gaps = int(log.metadata[SUMMARY_NAME]["gaps"])
        return RunTotals(
            periods=account,
            latency=late,
            slowest=punctuality.slowest,
            causes=self.find_collector(CycleCauses).find_causes(),
            virtual=on_virtual_time(log),
            plan=plan_of(log),
            real_time=_real_time(log, granted=self._granted),
            joints=log.joints,
            invalid=tuple(joint.invalid for joint in tracking),
            servos=servos,
            buses=buses,
            events=self._events.groups,
            returns=self._returns,
            acts=acts,
            pauses=pauses,
            failures=tuple(log.metadata.get(FAILURES_NAME, {}).values()),
            wait=self._wait,
            gaps=gaps,
            damage=log.damage,
            findings=(
                *traffic.findings,
                *movement,
                *self.find_collector(ServoHealth).findings(movement),
                *self.find_collector(FrozenSources).findings(),
            ),
            tracking=tracking,
            conduct=conduct,
        )


def _real_time(log: Log, *, granted: bool) -> RealTime:
    requested = log.metadata.get("scheduler", {}).get("policy", "other") != "other"
    kernel = log.metadata.get("kernel", {})
    real_time = any("PREEMPT_RT" in kernel.get(key, "") for key in ("version", "release"))
    return RealTime(requested, granted, real_time)
