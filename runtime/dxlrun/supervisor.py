"""Supervisor: the process in this terminal; plan -> processes -> orderly end, and a summary for a person."""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from rich.console import Console
from rich.status import Status

from dxlrun import process
from dxlrun.compile.plan import Plan
from dxlrun.errors import ProcessFault
from dxlrun.heartbeat import Heartbeat, Phase
from dxlrun.loop_process import Outcome
from dxlrun.run_log import epoch_offset_ns, log_header, new_log
from dxlrun.run_processes import Child, Memory, start_guardian, start_recorder, start_simulation
from dxlrun.run_summary import RunOptions, RunSummary

_POLL_S = 0.1
_GRACE_S = 1.0
"""Beyond `exit_timeout`, before torque is cut: the loop beats at least once a second or the guardian acts."""


@dataclass(slots=True)
class _Signals:
    """SIGINT and SIGTERM, counted; the first asks the robot to stop in order, the second cuts torque."""

    count: int = 0

    @contextmanager
    def caught(self) -> Iterator[None]:
        """Count them while the run lasts; afterwards they do again what they did before."""

        def count(*_: object) -> None:
            self.count += 1

        before = {number: signal.signal(number, count) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)


@dataclass(slots=True)
class _Run:
    """The processes of one run, as far as they were started, and what became of them."""

    plan: Plan
    options: RunOptions
    memory: Memory
    signals: _Signals
    simulation: Child | None = None
    recorder: Child | None = None
    guardian: Child | None = None
    log: Path | None = None
    sentences: list[str] = field(default_factory=list)
    ended: Mapping[str, object] | None = None
    """What the guardian said at the end."""
    messages: int = 0

    def start(self) -> Child:
        """Start everything in order, return the guardian; raises PortError or ProcessFault."""
        ledger = None
        if self.options.record:
            self.log = new_log(Path(self.plan.recording_directory), self.plan.robot)
            ledger = self.log.with_suffix(".ledger.jsonl")
        ports: dict[str, str] = {}
        if self.plan.simulated:
            self.simulation, ports = start_simulation(self.plan, ledger, self.memory)
        if self.log:
            header = log_header(self.plan, epoch_offset_ns(), virtual=False)
            self.recorder = start_recorder(self.log, header, self.memory)
        others = [child for child in (self.simulation, self.recorder) if child]
        self.guardian = start_guardian(
            self.plan, ports, self.memory, others, take_over=self.options.take_over
        )
        self.guardian.ready()
        return self.guardian

    def discard(self) -> None:
        """Remove the log of a run that never came to the robot."""
        if self.log:
            self.log.unlink(missing_ok=True)
            self.log.with_suffix(".ledger.jsonl").unlink(missing_ok=True)
            self.log = None

    def watch(self, guardian: Child, show: Callable[[Heartbeat], None]) -> None:
        """Wait for the guardian's last word; pass on what the signals ask."""
        heartbeat = Heartbeat(self.memory.heartbeat)
        asked, cut_at = 0, float("inf")
        while self.ended is None and not guardian.line.closed:
            if self.signals.count > asked:
                asked = self.signals.count
                guardian.line.send({"stop": True} if asked == 1 else {"cut": True})
                cut_at = time.monotonic() + self.plan.exit_timeout_ns * 1e-9 + _GRACE_S
            if time.monotonic() > cut_at:
                guardian.line.send({"cut": True})
                cut_at = float("inf")
            show(heartbeat)
            message = guardian.poll(_POLL_S)
            if message and "ended" in message:
                self.ended = message
        if self.ended is None:
            self._without_guardian(heartbeat)

    def _without_guardian(self, heartbeat: Heartbeat) -> None:
        """The guardian is gone: the kernel told the loop to stop; wait until it has switched torque off."""
        deadline = time.monotonic() + self.plan.exit_timeout_ns * 1e-9 + _GRACE_S
        while heartbeat.phase is not Phase.DONE and time.monotonic() < deadline:
            time.sleep(_POLL_S)
        limp = (
            "the loop stopped and switched torque off"
            if heartbeat.phase is Phase.DONE
            else "nobody confirmed torque off: cut the robot's power"
        )
        self.sentences.append(f"the guardian ended in the middle of the run; {limp}")

    def end(self) -> None:
        """End what is left, in order: guardian, recorder, simulated bus."""
        if self.guardian:
            self.guardian.end()
        if self.recorder:
            self._end_recorder(self.recorder)
        if self.simulation:
            self.simulation.end()

    def _end_recorder(self, recorder: Child) -> None:
        """Let the recorder drain the rings and close the log; say so when it could not."""
        recorder.line.send({"finish": True})
        try:
            while (message := recorder.message(60.0)) is not None:
                if "error" in message:
                    self.sentences.append(f"the log is incomplete: {message['error']}")
                summary = message.get("summary")
                if isinstance(summary, dict):
                    self.messages = summary["messages"]
                    if summary["gaps"]:
                        self.sentences.append(
                            f"the log has {summary['gaps']} declared gap(s): the recorder was too slow"
                        )
        except ProcessFault as fault:
            self.sentences.append(str(fault))
        recorder.end()
        if not self.messages:
            self.sentences.append(
                f"the recorder ended before the run did; {self.log} is readable up to its last second"
            )


def run_robot(plan: Plan, options: RunOptions, out: Console) -> RunSummary:
    """Run a robot until its end, a signal, or a fault; every process is gone when it returns.

    Raises PortError (a port is missing, busy, forbidden) and ProcessFault (a child did not start).
    """
    signals = _Signals()
    run = _Run(plan, options, Memory.create(plan), signals)
    began = time.monotonic()
    with signals.caught():
        try:
            with out.status(f"{plan.robot}: starting") as status:
                guardian = run.start()
                began = time.monotonic()
                run.watch(guardian, _progress(plan, status, began))
        finally:
            run.end()
            if run.guardian is None or not run.guardian.began:
                run.discard()
            if options.debug:
                sys.stderr.write(process.whole(run.memory.stderr).decode(errors="replace"))
    return _summary(run, time.monotonic() - began)


def _progress(plan: Plan, status: Status, began: float) -> Callable[[Heartbeat], None]:
    """Return what keeps the terminal's status line up to date."""

    def show(heartbeat: Heartbeat) -> None:
        if heartbeat.phase is Phase.SETUP:
            status.update(f"{plan.robot}: checking servos, torque on")
        elif heartbeat.phase is Phase.RUNNING:
            end = f" of {plan.loop.end_ns / 1e9:.1f}" if plan.loop.end_ns else ""
            status.update(
                f"{plan.robot}: {heartbeat.cycles * plan.loop.period_ns / 1e9:.1f}{end} s, "
                f"cycle {heartbeat.cycles}, {heartbeat.skipped} periods skipped "
                f"({time.monotonic() - began:.0f} s; Ctrl-C stops)"
            )

    return show


def _summary(run: _Run, elapsed_s: float) -> RunSummary:
    """Judge the run: 0 good, 1 failed, 130 interrupted."""
    outcome = run.memory.outcome()
    heartbeat = Heartbeat(run.memory.heartbeat)
    sentences: list[str] = []
    if outcome is None:
        outcome = Outcome("fault", heartbeat.cycles, heartbeat.skipped, _last_words(run.memory))
    sentences += outcome.sentences
    if run.ended is not None and run.ended["ended"] != "done":
        sentences += [str(sentence) for sentence in _list(run.ended["outcome"])]
    sentences += run.sentences
    interrupted = run.signals.count > 0
    bad: Literal[0, 1] = 1 if outcome.reason not in ("ended", "stopped") or sentences else 0
    return RunSummary(
        exit_code=130 if interrupted and not outcome.sentences and not run.sentences else bad,
        reason="interrupted" if interrupted else outcome.reason,
        cycles=outcome.cycles,
        skipped=outcome.skipped,
        elapsed_s=elapsed_s,
        sentences=tuple(sentences),
        remarks=outcome.grants,
        log=str(run.log) if run.log else None,
        messages=run.messages,
    )


def _last_words(memory: Memory) -> tuple[str, ...]:
    """Return what a child that ended without a report printed last, if it printed anything."""
    lines = process.whole(memory.stderr).decode(errors="replace").strip().splitlines()
    return (f"the loop's process said last: {lines[-1]} (--debug shows all)",) if lines else ()


def _list(value: object) -> list[object]:
    return value if isinstance(value, list) else [value]
