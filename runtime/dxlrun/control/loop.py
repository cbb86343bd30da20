"""Loop: read, update, gate, write, on an absolute schedule t_d[i] = t_0 + i * T."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal, Protocol

from dxlrun.clock import Clock
from dxlrun.control.gate import Gate
from dxlrun.control.loop_plan import LoopPlan
from dxlrun.control.managed import PERIOD_CAP
from dxlrun.control.manager import Manager
from dxlrun.cycle import CycleRecord
from dxlrun.errors import PortError
from dxlrun.events import EventCode, EventSink, Severity
from dxlrun.hardware import Hardware
from dxlrun.plurals import counted


@dataclass(slots=True)
class StopFlag:
    """The wish to stop; set by a signal's handler, seen at the next cycle."""

    requested: bool = False

    def request(self) -> None:
        """Ask the loop to end orderly."""
        self.requested = True


class CycleSink(Protocol):
    """Takes finished cycles; never blocks, never raises."""

    def append(self, record: CycleRecord) -> None:
        """Keep a copy of the record; its memory is filled again in the next cycle."""
        ...

    def begin(self, record: CycleRecord) -> None:
        """Keep a copy of the record before the first cycle: the states and goals of the activation."""
        ...


@dataclass(frozen=True, slots=True)
class LoopResult:
    """How a loop ended; cycles + skipped = periods that have passed."""

    cycles: int
    skipped: int
    reason: Literal["ended", "stopped", "fault"]
    detail: str = ""
    """One sentence where the reason is a fault."""


@dataclass(slots=True, kw_only=True)
class Loop:
    """One robot's control loop; hardware is started before and stopped after it by whoever built it.

    Cycle i is due at t_0 + i * T. After a cycle, the next one is the first whose deadline has not passed: the
    deadlines between are declared skipped, the phase of the schedule stays, two cycles never follow each
    other in a burst. Controllers get the time of the wake-up since t_0, and the true time since the cycle
    before, at most PERIOD_CAP periods.
    """

    clock: Clock
    hardware: Hardware
    manager: Manager
    gate: Gate
    record: CycleRecord
    sink: CycleSink
    events: EventSink
    plan: LoopPlan
    beat: Callable[[], None]
    """Shows the guardian that the loop lives; called once a cycle."""
    stop: StopFlag
    _start_ns: int = field(default=0, init=False)
    _woken_ns: int = field(default=0, init=False)
    _cycles: int = field(default=0, init=False)
    _skipped: int = field(default=0, init=False)
    _late: bool = field(default=False, init=False)

    def run(self) -> LoopResult:
        """Activate the controllers, run until the plan's end, a stop or a fault, deactivate them.

        What controllers raise, and PortError of the hardware, become the result; nothing else is caught.
        """
        period_ns = self.plan.period_ns
        self._start_ns = self.clock.now_ns() + period_ns
        self._woken_ns = self._start_ns - period_ns
        self.events.emit(
            EventCode.LOOP_STARTED, Severity.INFO, "loop", f"loop started, period {period_ns / 1e6:g} ms"
        )
        self.gate.ease_in()
        self._tell_start()
        self.manager.activate(0)
        try:
            reason, detail = self._cycle_until_end()
        except PortError as error:
            reason, detail = "fault", str(error)
        finally:
            self.manager.deactivate(self.clock.now_ns() - self._start_ns)
        if reason != "fault" and self.manager.fault is not None:
            reason, detail = "fault", self.manager.fault
        self._tell_end(reason, detail)
        return LoopResult(self._cycles, self._skipped, reason, detail)

    def _cycle_until_end(self) -> tuple[Literal["ended", "stopped", "fault"], str]:
        """Run cycles; return why they ended, and a sentence for a fault."""
        end_ns, period_ns = self.plan.end_ns, self.plan.period_ns
        cycle = 0
        while self.manager.fault is None:
            if end_ns is not None and cycle * period_ns >= end_ns:
                return "ended", ""
            if self.stop.requested:
                return "stopped", ""
            self._one(cycle)
            cycle = self._next(cycle)
        return "fault", self.manager.fault

    def _one(self, cycle: int) -> None:
        """Wait for a deadline, then read, update, gate and write."""
        record, now_ns = self.record, self.clock.now_ns
        deadline_ns = self._start_ns + cycle * self.plan.period_ns
        self.hardware.idle(deadline_ns)
        woken_ns = self.clock.wait_until(deadline_ns)
        dt_ns = min(woken_ns - self._woken_ns, PERIOD_CAP * self.plan.period_ns)
        self._woken_ns = woken_ns
        record.cycle = cycle
        record.scheduled_ns = deadline_ns
        record.woken_ns = woken_ns
        record.period_ns = dt_ns
        self.hardware.read()
        record.read_ns = now_ns()
        self.manager.update(woken_ns - self._start_ns)
        self.gate.apply(record.commands, record.goals, dt_ns)
        record.updated_ns = now_ns()
        self.hardware.write()
        record.written_ns = now_ns()
        self.sink.append(record)
        self._cycles += 1
        self.beat()

    def _next(self, cycle: int) -> int:
        """Return the first cycle whose deadline has not passed; declare those between as skipped."""
        passed_ns = self.clock.now_ns() - self._start_ns
        following = max(cycle + 1, -(-passed_ns // self.plan.period_ns))
        if self.plan.end_ns is not None:
            last = max(cycle + 1, -(-self.plan.end_ns // self.plan.period_ns))
            following = min(following, last)
        skipped = following - cycle - 1
        self.record.skipped = skipped
        self._skipped += skipped
        if skipped and not self._late:
            self.events.emit(
                EventCode.OVERRUN,
                Severity.WARNING,
                "loop",
                f"cycle {cycle} ended {(passed_ns - cycle * self.plan.period_ns) / 1e6:.3f} ms after its "
                f"deadline; {counted(skipped, 'period', 'periods')} skipped",
            )
        self._late = bool(skipped)
        return following

    def _tell_start(self) -> None:
        """Leave in the log what the controllers are activated with: nothing else tells it."""
        record = self.record
        record.cycle = -1
        record.scheduled_ns = self._start_ns
        record.woken_ns = record.read_ns = record.updated_ns = record.written_ns = self.clock.now_ns()
        self.sink.begin(record)

    def _tell_end(self, reason: str, detail: str) -> None:
        severity = Severity.FATAL if reason == "fault" else Severity.INFO
        cycles = counted(self._cycles, "cycle", "cycles")
        skipped = counted(self._skipped, "period", "periods")
        text = f"loop {reason} after {cycles}, {skipped} skipped"
        self.events.emit(EventCode.LOOP_STOPPED, severity, "loop", f"{text}: {detail}" if detail else text)
