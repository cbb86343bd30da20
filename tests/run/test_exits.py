"""Ways out of a run in which more than one thing goes wrong; judged by ledger and processes."""

from __future__ import annotations

import fcntl
import os
import re
import signal
import stat
import termios
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from tests.kit.awaited import DEADLINE_S

from dxlrun.channels.event_records import EventCode, Severity
from dxlrun_analysis.report import analyze
from dxlsim.bus.ledger import read_ledger

Running = Any
Start = Callable[..., Any]


def sent(run: Running) -> bytes:
    return b"".join(entry.data for entry in run.ledger() if entry.direction == "in")


def seen(ledger: Path) -> bytes:
    """Return what simulated servos received, from a ledger that lies elsewhere than beside the log."""
    return b"".join(entry.data for entry in read_ledger(ledger) if entry.direction == "in")


def guardians_word(run: Running) -> str:
    """Return what the guardian told the log."""
    return " ".join(event.text for event in run.log().events if event.code == EventCode.GUARDIAN)


def test_a_second_interrupt_cuts_torque_at_once(start, tmp_path, all_limp, wait_for):
    """At one cycle in two seconds the first interrupt is obeyed too late to be waited for."""
    robot = tmp_path / "slow.yaml"
    robot.write_text((tmp_path / "pair.yaml").read_text().replace("rate: 50", "rate: 0.5"))
    run = start(robot=robot)
    wait_for(lambda: sent(run).count(b"\xff\xff\xfe") or None, "the first goals")
    run.signal(signal.SIGINT)
    run.signal(signal.SIGTERM)  # another one, because two of a kind at once may arrive as one
    code, _, err = run.finish()
    assert code == 130, err
    assert "torque was cut on request; torque off was confirmed by all 2 servos" in guardians_word(run)
    assert all_limp(run)
    assert run.log().complete


def test_a_plug_in_that_hides_the_request_to_stop_is_ended_after_exit_timeout(odd, all_limp):
    run = odd(configure="signal.signal(signal.SIGTERM, signal.SIG_IGN)")
    run.wait_until_moving()
    run.signal(signal.SIGINT)
    code, _, err = run.finish()
    assert code == 1  # its torque was cut from outside
    assert "did not stop within 2 s" in err
    assert all_limp(run)


def test_a_stop_before_the_set_up_gives_no_torque(odd, all_limp):
    run = odd(configure="os.kill(os.getpid(), signal.SIGTERM)")
    run.finish()
    assert bytes((24, 1)) not in sent(run)
    assert b"\x83" not in sent(run)
    assert all_limp(run)
    assert "aborted on request" in " ".join(event.text for event in run.log().events)


def test_an_interrupt_while_plug_ins_load_touches_no_servo_and_leaves_no_log(odd, tmp_path):
    ledger = tmp_path / "seen.jsonl"
    run = odd(
        "--ledger",
        str(ledger),
        configure="signal.signal(signal.SIGTERM, signal.SIG_DFL); time.sleep(60)",
    )
    run.child("dxlrun.run.loop_process")
    run.signal(signal.SIGINT)
    code, out, err = run.finish()
    assert (code, err) == (130, "")
    assert seen(ledger) == b""
    assert "log:" not in out
    assert "next:" not in out
    assert not list((tmp_path / "logs").iterdir())


def test_a_guardian_that_dies_while_the_loop_loads_takes_it_along(start, tmp_path):
    ledger = tmp_path / "seen.jsonl"
    run = start("--ledger", str(ledger))
    run.child("dxlrun.run.loop_process")
    os.kill(run.child("dxlrun.run.guardian"), signal.SIGKILL)
    code, _, err = run.finish()
    assert code == 1
    assert "guardian exited" in err
    assert seen(ledger) == b""


def test_a_terminal_that_dies_while_the_guardian_starts_is_noticed(start, wait_for, all_limp):
    run = start()
    run.child("dxlrun.run.guardian")
    run.signal(signal.SIGKILL)
    run.process.wait()
    wait_for(run.gone, "the end of every process")
    assert all_limp(run)


GUARDIAN, LOOP = "dxlrun.run.guardian", "dxlrun.run.loop_process"
STOP, KILL = signal.SIGSTOP, signal.SIGKILL
CONFIRMED = "torque off was confirmed by all 2 servos"


@pytest.mark.parametrize(
    ("happens", "said"),
    [
        ([(GUARDIAN, KILL)], ("guardian exited",)),
        (
            [(GUARDIAN, STOP), (LOOP, STOP), (GUARDIAN, KILL)],  # a hung loop without a guardian
            ("the loop did not stop and was killed", CONFIRMED),
        ),
        ([(GUARDIAN, STOP), (LOOP, KILL), (GUARDIAN, KILL)], (CONFIRMED,)),
        ([(GUARDIAN, STOP)], ("the guardian stopped watching the loop and was killed",)),
        (
            [(GUARDIAN, STOP), (LOOP, KILL)],
            ("the guardian stopped watching the loop and was killed",),
        ),
    ],
    ids=["guardian", "hung loop", "both", "stopped guardian", "stopped guardian, loop"],
)
def test_torque_is_off_whatever_becomes_of_guardian_and_loop(start, all_limp, never_on_again, happens, said):
    """The supervisor cuts it within 0.3 s (measured: 0.13 s); the limit is for a busy machine."""
    run = start()
    run.wait_until_moving()
    pids = {name: run.child(name) for name, _ in happens}
    for name, what in happens:
        os.kill(pids[name], what)
    killed_ns = time.monotonic_ns()
    code, _, err = run.finish()
    assert code == 1
    assert all(one in err for one in said), err
    assert all_limp(run)
    assert never_on_again(run)
    assert run.log().complete
    if happens[-1] == (LOOP, KILL):
        off_ns = [entry.t_ns for entry in run.ledger() if entry.direction == "in"][-2]
        assert 0 < off_ns - killed_ns < 1_500_000_000


def test_a_recorder_that_is_stopped_does_not_stop_the_robot_and_is_reported(start, all_limp):
    run = start("--duration", "1")
    run.wait_until_moving()
    os.kill(run.child("dxlrun.log.recorder"), signal.SIGSTOP)
    code, _, err = run.finish()
    assert code == 1
    assert "the recorder did not answer for 10 s and was killed" in err
    assert "Traceback" not in err
    assert all_limp(run)
    assert run.log().cycles is not None


def test_what_a_plug_in_prints_is_for_debug_only_and_without_a_log_no_file_is_left(odd):
    run = odd(
        "--duration", "0.3", "--no-record", configure="print('to out'); print('to err', file=sys.stderr)"
    )
    code, out, err = run.finish()
    assert (code, err) == (0, "")
    assert "to out" not in out
    assert not (run.directory / "logs").exists()


def test_debug_shows_what_a_plug_in_prints_within_bounds(odd):
    run = odd("--duration", "0.3", "--debug", configure="print('to out' * 1_000_000)")
    code, _, err = run.finish()
    assert code == 0
    assert "to out" in err
    assert len(err) < 2_000_000
    assert "omitted" in err


@pytest.mark.parametrize("flags", [(), ("--debug",)])
def test_a_fault_of_dxlrun_itself_is_a_sentence_and_a_traceback_only_for_debug(odd, all_limp, flags):
    breaks = "import dxlrun.control.loop as loop; loop.ControlLoop._next = None"
    run = odd(*flags, configure=breaks)
    code, _, err = run.finish()
    assert code == 1
    assert "dxlrun itself failed: TypeError" in err
    assert ("Traceback" in err) == bool(flags)
    assert all_limp(run)
    fatal = [event.text for event in run.log().events if event.code == EventCode.LOOP_STOPPED]
    assert "Traceback" in fatal[-1]


STANDSTILL = "time_ns < 5e8 or time.sleep(60)"
DEATHS = {
    "os.kill(os.getpid(), signal.SIGSEGV)": r"the loop's process exited unexpectedly \(signal SIGSEGV\)",
    STANDSTILL: r"the loop did not respond for more than 100 ms",
}


@pytest.mark.parametrize("death", DEATHS)
def test_the_cause_of_death_names_the_controller_whose_code_ran(odd, all_limp, wire_equals_log, death):
    run = odd(update=death)
    code, _, err = run.finish()
    assert code == 1
    cause = DEATHS[death] + " in update of controller states"
    assert re.search(cause, err)
    assert re.search(cause, guardians_word(run))
    assert "torque off was confirmed by all 2 servos" in err
    assert all_limp(run)
    if death == STANDSTILL:  # the others may take the packets of their cycle along
        wire_equals_log(run)
        assert len(run.log().cycles)  # how many of the 25 before it were kept depends on the machine


@pytest.mark.parametrize(
    ("death", "cause"),
    [
        ("os._exit(7)", "the loop's process exited unexpectedly (exit code 7) in on_configure"),
        (
            "signal.signal(signal.SIGTERM, signal.SIG_IGN); time.sleep(60)",
            "the loop did not stop within 2 s in on_configure",
        ),
    ],
)
def test_a_controller_at_which_loading_ends_is_named_and_no_servo_is_touched(
    odd, tmp_path, wait_for, death, cause
):
    ledger, mark = tmp_path / "seen.jsonl", tmp_path / "configured"
    run = odd("--ledger", str(ledger), configure=f"open({str(mark)!r}, 'w').close(); {death}")
    wait_for(mark.exists, "on_configure")
    run.signal(signal.SIGINT)
    _, _, err = run.finish()
    assert f"{cause} of controller states" in err
    assert "nothing had been sent to the robot" in err
    assert seen(ledger) == b""


THREAD = (
    "import ctypes; libc = ctypes.CDLL(None); "
    "libc.pthread_create(ctypes.byref(ctypes.c_ulong()), None, libc.sleep, ctypes.c_void_p(60))"
)


def test_a_thread_that_python_did_not_start_is_the_fault_of_its_controller_too(odd, all_limp):
    run = odd(update=THREAD)
    code, _, err = run.finish()
    assert code == 1
    assert "controller states started 1 thread in update" in err
    assert all_limp(run)


FORK = """
        told = []
        def tell(path):
            open(path, "w").write(chr(10).join(os.readlink(one) for one in
                [f"/proc/self/fd/{fd}" for fd in os.listdir("/proc/self/fd")] if os.path.islink(one)))
        if os.fork() == 0:
            tell(FORKED)
            END
        show = "import os; print(*[os.readlink(f'/proc/self/fd/{fd}') for fd in range(512)"
        show += " if os.path.islink(f'/proc/self/fd/{fd}')], sep=chr(10))"
        to = (os.POSIX_SPAWN_OPEN, 1, SPAWNED, os.O_WRONLY | os.O_CREAT, 0o600)
        os.waitpid(os.posix_spawn(sys.executable, ["python", "-c", show], os.environ, file_actions=[to]), 0)
"""


@pytest.mark.parametrize("end", ["sys.exit(3)", "pass"])
def test_a_child_process_of_a_controller_has_no_port(odd, tmp_path, all_limp, end):
    forked, spawned = tmp_path / "forked", tmp_path / "spawned"
    text = FORK.replace("FORKED", repr(str(forked))).replace("SPAWNED", repr(str(spawned)))
    run = odd("--duration", "0.5", configure=text.replace("END", end))
    code, out, err = run.finish()
    assert (code, err) == (0, ""), out
    assert out.startswith("pair: done: ")
    # a forked one has the memory that is mapped, and what they print goes where the loop's own output goes
    for path, not_held in (
        (forked, ("socket:", "/dev/pts/")),
        (spawned, ("socket:", "/dev/pts/", "/memfd:")),
    ):
        held = [one for one in path.read_text().splitlines() if "dxlrun-stderr" not in one]
        assert held
        assert not [one for one in held if one.startswith(not_held)]
    assert all_limp(run)
    assert run.log().complete


def test_a_directory_that_takes_no_log_is_one_sentence(start, tmp_path):
    (tmp_path / "logs").write_text("a file where the directory should be")
    code, _, err = start().finish()
    assert code == 2
    assert len(err.splitlines()) == 1
    assert "logs" in err
    assert "internal" not in err


def test_a_log_that_is_deleted_in_the_run_fails_it(start, all_limp):
    run = start()
    run.wait_until_moving()
    log = run.one("*.mcap")
    log.unlink()
    run.signal(signal.SIGINT)
    code, out, err = run.finish()
    assert code == 1
    assert err == ("pair: the log is incomplete: another program deleted or moved the file during the run\n")
    assert "done" not in out
    assert log.name not in out
    assert all_limp(run)


def test_a_closed_terminal_does_not_matter_to_the_robot(start, all_limp):
    run = start("--duration", "0.5")
    assert run.process.stdout is not None
    run.process.stdout.close()
    run.process.stdout = None  # finish reads only standard error then
    _, _, err = run.finish()
    assert "Traceback" not in err
    assert all_limp(run)
    assert run.log().complete


def test_without_any_standard_stream_the_robot_runs(start, all_limp):
    run = start("--duration", "0.5", closed=True)
    assert run.finish() == (0, "", "")
    assert all_limp(run)
    assert len(run.log().cycles) > 0


def test_a_start_that_is_refused_is_in_the_log_to_the_last_packet(start, tmp_path, all_limp, wire_equals_log):
    robot = tmp_path / "outside.yaml"
    text = (tmp_path / "pair.yaml").read_text()
    robot.write_text(text.replace("direction: -1}", "direction: -1, limits: {position: [20 deg, 60 deg]}}"))
    run = start(robot=robot)
    code, _, err = run.finish()
    assert code == 1
    assert len(err.splitlines()) == 1
    assert "tilt (ID 7 on bus main) is at" in err
    assert bytes((24, 1)) not in sent(run)
    assert all_limp(run)
    wire_equals_log(run)
    assert [event.text for event in run.log().events if event.severity == Severity.ERROR]


def test_the_loop_grows_no_memory_and_collects_no_garbage(odd, wait_for):
    tell = "import gc; print('collector', gc.isenabled(), [one['collections'] for one in gc.get_stats()])"
    run = odd("--duration", "4", "--debug", update=tell)

    def resident_kb(cycles: int) -> int:
        # one read of the state of servo 3 a cycle; goals are sent when they change
        wait_for(lambda: sent(run).count(b"\xff\xff\x03\x04\x02\x24") >= cycles, f"{cycles} cycles")
        status = Path(f"/proc/{run.child('dxlrun.run.loop_process')}/status").read_text()
        return int(status.split("VmRSS:")[1].split()[0])

    before = resident_kb(30)
    after = resident_kb(130)
    assert after - before <= 64  # a new object of 100 bytes a cycle would be 10 kB: whole pages, and a margin
    _, _, err = run.finish()
    told = {line for line in err.splitlines() if line.startswith("collector")}
    assert len(told) == 1
    assert "False" in told.pop()


def test_simulated_servos_that_are_gone_end_the_run(start, wait_for):
    run = start()
    run.wait_until_moving()
    os.kill(run.child("run.simulation_process"), signal.SIGKILL)
    code, out, err = run.finish()
    assert code == 1
    assert "the simulated bus exited before the end of the run" in err
    assert "torque off could not be sent" in err
    assert "Traceback" not in err
    wait_for(run.gone, "the end of every process")
    assert run.log().complete
    verdict = analyze(run.log()).verdict
    assert "The run failed: the simulated bus exited before the end of the run." in verdict.sentences
    assert "  main: bus main on sim: sim is gone" in out


def test_a_run_listens_on_one_socket_that_only_its_user_may_open(start, listening, wait_for):
    """With the widest umask; nothing is on the network, and no socket is abstract, which has no mode.

    Simulated servos listen nowhere.
    """
    open_to_all = ("/bin/sh", "-c", 'umask 0; exec "$@"', "sh")
    run = start(gateway=True, before=open_to_all)
    wait_for(lambda: listening(run.process.pid).unix, "the socket")
    run.wait_until_moving()
    found = listening(run.process.pid)
    assert found.network == []
    (path,) = map(Path, found.unix)
    assert stat.S_ISSOCK(path.stat().st_mode)
    assert (path.stat().st_mode & 0o777, path.parent.stat().st_mode & 0o777) == (0o600, 0o700)
    simulation = Path(f"/proc/{run.child('dxlrun.run.simulation_process')}/fd")
    terminals = {os.readlink(each) for each in simulation.iterdir()} | {
        os.readlink(each) for each in Path(f"/proc/{run.child('dxlrun.run.guardian')}/fd").iterdir()
    }
    ports = [Path(one) for one in terminals if one.startswith("/dev/pts/") and one != "/dev/pts/ptmx"]
    assert ports
    assert not any(port.stat().st_mode & 0o007 for port in ports)
    assert not any(file.stat().st_mode & 0o007 for file in (run.directory / "logs").iterdir())
    run.signal(signal.SIGTERM)
    run.finish()
    assert not path.exists()


def test_a_second_interrupt_cuts_torque_although_the_guardian_is_stopped(start, all_limp, never_on_again):
    """It took 5 s; measured now: 0.4 s. The limit is for a busy machine."""
    run = start()
    run.wait_until_moving()
    os.kill(run.child("dxlrun.run.guardian"), signal.SIGSTOP)
    asked_ns = time.monotonic_ns()
    run.signal(signal.SIGINT)
    run.signal(signal.SIGTERM)
    code, _, _ = run.finish()
    off_ns = [entry.t_ns for entry in run.ledger() if entry.direction == "in"][-1]
    print(f"torque off {(off_ns - asked_ns) / 1e6:.0f} ms after the request")
    assert 0 < off_ns - asked_ns < 3_000_000_000
    assert all_limp(run)
    assert never_on_again(run)
    assert code == 1


FULL = b"x" * 4096


def full_pipe() -> tuple[int, int]:
    """Return the ends of a pipe that takes nothing more."""
    reader, writer = os.pipe()
    fcntl.fcntl(writer, fcntl.F_SETPIPE_SZ, len(FULL))
    os.write(writer, FULL)
    return reader, writer


def stopped_terminal() -> tuple[int, int]:
    """Return the ends of a pseudo-terminal after Ctrl-S."""
    master, terminal = os.openpty()
    termios.tcflow(terminal, termios.TCOOFF)
    return master, terminal


def closed_pipe() -> tuple[int, int]:
    """Return the end of a pipe whose reader has left, and a descriptor in its place."""
    reader, writer = os.pipe()
    os.close(reader)
    return os.open(os.devnull, os.O_RDONLY), writer


@pytest.mark.parametrize("output", [full_pipe, stopped_terminal, closed_pipe])
def test_no_reader_of_the_output_keeps_a_signal_from_the_robot(start, all_limp, wait_for, output):
    """The supervisor has written when the signal comes: at once to a terminal, every 5 s into a pipe."""
    kept, given = output()
    run = start(output=given)
    run.wait_until_moving()
    if output is not stopped_terminal:
        begin_ns = run.ledger()[-1].t_ns
        wait_for(lambda: run.ledger()[-1].t_ns - begin_ns > 5_500_000_000, "the first line of progress")
    asked_ns = time.monotonic_ns()
    run.signal(signal.SIGTERM)
    assert run.process.wait(DEADLINE_S) == 130
    off_ns = max(entry.t_ns for entry in run.ledger() if entry.direction == "in")
    assert off_ns - asked_ns < 2_000_000_000
    assert all_limp(run)
    os.close(kept)
    os.close(given)
