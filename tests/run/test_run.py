"""A whole run through all processes, and every way out of it; judged by the simulated bus' own ledger."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tests.kit.totals import totals_of

from dxlrun.channels.event_records import EventCode

ROBOTS = Path(__file__).parents[2] / "robots"
Running = Any
Start = Callable[..., Any]


def test_a_run_ends_by_itself_and_its_log_is_the_wire(start, all_limp, wire_equals_log):
    run = start("--duration", "1.5")
    code, out, err = run.finish()
    assert (code, err) == (0, ""), out + err
    log = run.log()
    assert log.complete
    assert len(log.cycles) + log.cycles["skipped"].sum() == log.cycles["cycle"][-1] + 1 <= 75
    assert log.cycles["valid"].any(axis=0).all()
    # while it loads, a loop on a busy machine never waits of its own accord
    assert any(message["loop_voluntary"] > 0 for message in log.messages("/machine"))
    assert str(run.one("*.mcap").name) in out.replace("\n", "")
    assert all_limp(run)
    wire_equals_log(run)


def test_an_interrupt_stops_in_order(start, all_limp, wire_equals_log):
    run = start()
    run.wait_until_moving()
    run.signal(signal.SIGINT)
    code, _, err = run.finish()
    assert code == 130
    assert "Traceback" not in err
    assert run.log().complete
    assert all_limp(run)
    wire_equals_log(run)


def test_the_guardian_makes_the_robot_limp_when_the_loop_is_gone(
    start, all_limp, wire_equals_log_but_for_what_was_held
):
    run = start()
    run.wait_until_moving()
    os.kill(run.child("dxlrun.run.loop_process"), signal.SIGKILL)
    code, out, err = run.finish()
    assert code == 1, out + err
    assert "torque off was confirmed by all 2 servos" in err
    assert "Traceback" not in err
    assert all_limp(run)
    wire_equals_log_but_for_what_was_held(run)
    assert [event.source for event in run.log().events if event.code == EventCode.GUARDIAN] == ["guardian"]


def test_without_a_terminal_the_robot_becomes_limp(start, all_limp):
    run = start()
    run.wait_until_moving()
    simulation = os.pidfd_open(run.child("run.simulation_process"))
    guardian = os.pidfd_open(run.child("dxlrun.run.guardian"))
    run.signal(signal.SIGKILL)
    run.finish()
    for descriptor in (guardian, simulation):
        assert select.select([descriptor], [], [], 60.0)[0]
        os.close(descriptor)
    assert all_limp(run)


def goals(run: Running) -> list[Any]:
    """Return the ledger's entries that begin with goals."""
    return [one for one in run.ledger() if one.direction == "in" and one.data[4:5] == b"\x83"]


def test_killing_the_recorder_does_not_stop_the_robot(start, all_limp, wait_for):
    run = start("--duration", "3")
    run.wait_until_moving()
    wait_for(lambda: len(run.log().cycles), "cycles in the log")
    os.kill(run.child("dxlrun.log.recorder"), signal.SIGKILL)
    before = len(goals(run))
    code, out, err = run.finish()
    assert code == 1
    (sentence,) = [
        line for line in err.splitlines() if "the recorder exited before the end of the run" in line
    ]
    assert run.log().damage[0].endswith(sentence.partition("can be read: ")[2])
    assert "its last cycle is at" in sentence
    assert "pair: failed: ran for 3." in out
    assert run.ledger()[-1].t_ns - run.ledger()[0].t_ns > 3_000_000_000  # by the log 0.5 s
    assert len(goals(run)) > before
    assert all_limp(run)
    assert len(run.log().cycles) > 0


def test_the_loops_process_has_one_thread_and_no_line_but_its_own(start, all_limp):
    run = start()
    run.wait_until_moving()
    process = Path(f"/proc/{run.child('dxlrun.run.loop_process')}")
    assert len(list((process / "task").iterdir())) == 1
    targets = sorted(os.readlink(one) for one in (process / "fd").iterdir())
    assert not [target for target in targets if target.startswith(("pipe:", "anon_inode:"))]
    assert sum(target.startswith("socket:") for target in targets) == 1  # its own one to the guardian
    assert sum(target.startswith("/dev/pts/") for target in targets) == 1
    run.signal(signal.SIGTERM)
    assert run.finish()[0] == 130
    assert all_limp(run)


def test_a_missing_port_is_one_sentence(start):
    run = start("port:=/dev/ttyNowhere")
    code, _, err = run.finish()
    assert code == 1
    assert len(err.strip().splitlines()) == 1
    assert "/dev/ttyNowhere" in err
    assert run.one("*") is None


def test_a_busy_port_is_one_sentence_that_names_the_holder(start: Start) -> None:
    # in a process of its own: this one may have the memory of a plan open, as a run has
    holding = (
        "import fcntl, os, pty\n"
        "_, slave = pty.openpty()\n"
        "fcntl.flock(slave, fcntl.LOCK_EX)\n"
        "print(os.ttyname(slave), flush=True)\n"
        "input()"
    )
    command = [sys.executable, "-c", holding]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdin
        assert holder.stdout
        run = start(f"port:={holder.stdout.readline().strip()}")
        code, _, err = run.finish()
        holder.stdin.write("\n")
    assert code == 1
    assert len(err.strip().splitlines()) == 1
    assert str(holder.pid) in err


def test_a_controller_that_raises_ends_the_run(odd, all_limp, wire_equals_log):
    run = odd(update="if time_ns > 5e8: raise RuntimeError('out of ideas')")
    code, _, err = run.finish()
    assert code == 1
    assert len(err.strip().splitlines()) == 1
    assert "states" in err
    assert "out of ideas" in err
    assert all_limp(run)
    wire_equals_log(run)
    log = run.log()
    assert log.complete
    faults = [event for event in log.events if event.code == EventCode.CONTROLLER_FAULT]
    assert len(faults) == 1
    assert "Traceback" in faults[0].text


def test_a_loop_that_was_stopped_accuses_no_servo(start, tmp_path):
    slow = tmp_path / "slow.yaml"
    slow.write_text((tmp_path / "pair.yaml").read_text().replace("rate: 50", "rate: 20"))
    run = start("--duration", "3", robot=slow)
    run.wait_until_moving()
    loop = run.child("dxlrun.run.loop_process")
    for _ in range(2):
        os.kill(loop, signal.SIGSTOP)
        time.sleep(0.12)  # the guardian waits for 0.25 s
        os.kill(loop, signal.SIGCONT)
        time.sleep(0.1)
    run.finish()
    found = totals_of(run.one("*.mcap")).causes
    most = max(found.causes, key=lambda one: one.total_ns)
    assert most.total_ns > 50_000_000
    assert most.kind in ("late wake-up", "machine", "own work", "late reply")
    assert not any("servo" in one.subject for one in found.causes)
