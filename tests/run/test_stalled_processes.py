"""Runs in real time whose processes have no processor for a while: judged by states, events and the log."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import accumulate
from pathlib import Path

import pytest
from tests.kit.awaited import until
from tests.kit.live_run import ROBOT, LiveRuns, Running, Start, together

from dxlrun.channels.event_records import EventCode, Severity

pytestmark = pytest.mark.long

WITH_WATCHDOG = """\
name: guarded
arguments: {type: {help: "type of the first controller"}}
buses:
  main: {port: sim, protocol: 2.0, baud_rate: 1_000_000, adapter: {latency: 1 ms}, bus_watchdog: 200 ms}
loop: {rate: 50, tolerated_skips: 100 %}
joints:
  pan: {bus: main, id: 3, model: XL430-W250, reference: 180 deg, direction: 1}
  tilt: {bus: main, id: 7, model: XL430-W250, reference: 180 deg, direction: -1}
controllers:
  states: {type: "${type}"}
  hold: {type: joint_group_position_controller, joints: [pan, tilt]}
"""
PATIENT = "import dxlwire.port.ports as ports; ports.LONGEST_STALL_NS = 10**12"
"""On a busy machine a short stop lasts longer than the half second after which a servo is lost."""
HARMS = {
    EventCode.READ_LOST,
    EventCode.SERVO_LOST,
    EventCode.WATCHDOG,
    EventCode.SERVO_REBOOTED,
    EventCode.IMPLAUSIBLE,
    EventCode.GUARDIAN,
}


def stop_for(run: Running, module: str, seconds: float, pause_s: float) -> None:
    """Stop one of the processes for a while, twice, once the loop sends goals."""
    sync_write = slice(4, 5), slice(7, 8)  # of Protocol 1.0, of 2.0
    until(lambda: any(b"\x83" in (one.data[place] for place in sync_write) for one in run.ledger()), "goals")
    pid = run.child(module)
    for _ in range(2):
        os.kill(pid, signal.SIGSTOP)
        time.sleep(seconds)
        os.kill(pid, signal.SIGCONT)
        time.sleep(pause_s)


def test_stopped_simulation_skips_periods_and_loses_no_joint_unless_it_stays_stopped(
    live_runs: LiveRuns, tmp_path: Path
) -> None:
    def check(name: str, text: str, seconds: float, configure: str = PATIENT) -> None:
        folder = tmp_path / name
        folder.mkdir()
        (folder / "robot.yaml").write_text(text)
        where = {"robot": folder / "robot.yaml", "directory": folder}
        run = live_runs.start_odd("--duration", "3600", configure=configure, **where)
        stop_for(run, "run.simulation_process", seconds, 0.2)
        run.signal(signal.SIGINT)
        code, out, err = run.finish()
        log = run.log()
        if seconds > 1:
            assert code == 1
            assert "were lost at" in out or "was lost at" in out
            assert EventCode.SERVO_LOST in {one.code for one in log.events}
            return
        assert log.cycles["valid"].all()
        assert log.cycles["skipped"].sum() > 10  # of 50 Hz
        assert {one.code for one in log.events if one.severity >= Severity.WARNING} & HARMS == set()
        assert [one for one in log.events if one.code == EventCode.SIMULATION_STALLED]
        lines = out.splitlines()
        verdict = next(at for at, line in enumerate(lines) if ": ran for " in line)
        assert lines[verdict + 1].startswith("  The machine was too busy: "), out
        assert "for the process of the simulated servos" in lines[verdict + 1]
        assert code == 130, (out, err)

    cases = (("protocol 1", ROBOT, 0.3), ("protocol 2", WITH_WATCHDOG, 0.3), ("for long", ROBOT, 1.2, "pass"))
    together(check, {case[0]: case for case in cases})


@contextmanager
def busy_programs(count: int) -> Iterator[None]:
    """Keep the processor busy."""
    programs = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for program in programs:
            program.kill()
            program.wait()


def test_the_log_of_a_run_that_is_killed_beside_busy_programs_lacks_its_end_only(start: Start) -> None:
    """The docs say 0.5 s. The ledger may lack its own last 0.5 s; the bound here is for a busy machine."""
    run = start("--duration", "3600")
    run.wait_until_moving()
    before_ns = run.ledger()[-1].t_ns
    with busy_programs(3):  # beside them a start takes too long
        until(lambda: run.ledger()[-1].t_ns > before_ns + 2_000_000_000, "2 s on the wire", pause_s=0.2)
        processes = run.processes()
        # The recorder first: it completes the log of a loop that has exited.
        for process in (processes["log.recorder"], *processes.values()):
            with suppress(ProcessLookupError):
                os.kill(process, signal.SIGKILL)
    run.finish()
    until(run.gone, "the end of every process")
    both = [*run.wire_and_log()]
    assert len(both) == 2
    for wire, ours in both:
        length = min(len(wire), len(ours))
        assert wire[:length] == ours[:length]
    heard = [entry for entry in run.ledger() if entry.direction == "in"]
    ends = accumulate(len(entry.data) for entry in heard)
    missing = [entry.t_ns for entry, end in zip(heard, ends, strict=True) if end > len(both[0][1])]
    assert not missing or missing[-1] - missing[0] < 2_000_000_000
    assert "its last cycle is at" in run.log().damage[0]
