"""Runs in real time whose simulated servos have no processor for a while: judged by states and events."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from dxlrun.channels.event_records import EventCode, Severity

Start = Callable[..., Any]
WITH_WATCHDOG = """\
name: guarded
buses:
  main: {port: sim, protocol: 2.0, baud_rate: 1_000_000, adapter: {latency: 1 ms}, bus_watchdog: 200 ms}
loop: {rate: 50, tolerated_skips: 100 %}
joints:
  pan: {bus: main, id: 3, model: XL430-W250, reference: 180 deg, direction: 1}
  tilt: {bus: main, id: 7, model: XL430-W250, reference: 180 deg, direction: -1}
controllers:
  hold: {type: joint_group_position_controller, joints: [pan, tilt]}
"""
HARMS = {
    EventCode.READ_LOST,
    EventCode.SERVO_LOST,
    EventCode.WATCHDOG,
    EventCode.SERVO_REBOOTED,
    EventCode.IMPLAUSIBLE,
    EventCode.GUARDIAN,
}


def stop_for(run: Any, seconds: float, wait_for: Callable[..., Any]) -> None:
    """Stop the process of the simulated servos for a while, twice, once the loop sends goals."""
    sync_write = slice(4, 5), slice(7, 8)  # of Protocol 1.0, of 2.0
    wait_for(
        lambda: any(b"\x83" in (one.data[place] for place in sync_write) for one in run.ledger()), "goals"
    )
    pid = run.child("run.simulation_process")
    for _ in range(2):
        os.kill(pid, signal.SIGSTOP)
        time.sleep(seconds)
        os.kill(pid, signal.SIGCONT)
        time.sleep(0.2)


@pytest.mark.parametrize("protocol", [1, 2])
def test_stopped_simulation_skips_periods_and_loses_no_joint(
    start: Start, wait_for: Callable[..., Any], tmp_path: Path, protocol: int
) -> None:
    robot = tmp_path / "pair.yaml"
    robot.write_text(WITH_WATCHDOG if protocol == 2 else robot.read_text())
    run = start("--duration", "4", robot=robot)
    stop_for(run, 0.3, wait_for)
    code, out, err = run.finish()
    log = run.log()
    assert log.cycles["valid"].all()
    assert log.cycles["skipped"].sum() > 10  # of 50 Hz
    assert {one.code for one in log.events if one.severity >= Severity.WARNING} & HARMS == set()
    stalled = [one for one in log.events if one.code == EventCode.SIMULATION_STALLED]
    assert stalled
    lines = out.splitlines()
    verdict = next(at for at, line in enumerate(lines) if ": ran for " in line)
    machine = lines[verdict + 1]
    assert machine.startswith("  The machine was too busy: "), out
    assert "for the process of the simulated servos" in machine
    assert code == (1 if "did not keep" in out else 0), (out, err)


def test_simulation_that_stays_stopped_loses_its_servos(start: Start, wait_for: Callable[..., Any]) -> None:
    run = start("--duration", "4")
    stop_for(run, 1.2, wait_for)
    code, out, _ = run.finish()
    assert code == 1
    assert "were lost at" in out or "was lost at" in out
    assert EventCode.SERVO_LOST in {one.code for one in run.log().events}
