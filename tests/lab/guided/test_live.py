"""Experiments on runs with all their processes: one that was there before, and ones of their own."""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from tests.kit.awaited import DEADLINE_S, until
from tests.kit.campaigns import campaign
from tests.kit.experiments import ROOT, Plays, perform, sine, state_of
from tests.kit.live_run import LiveRuns

import dxlrun
from dxlrun.cli import main
from dxlrun.errors import DxlrunError, InputError
from dxlrun.remote.sockets import sockets
from dxlrun.testing import VirtualRobot, plan_of, read_log
from dxlrun_lab.commands import on_robot
from dxlrun_lab.commands.on_robot import AbortMonitor, ExperimentOptions, run_on_robot
from dxlrun_lab.guided.choice import situation_of
from dxlrun_lab.guided.experiment import ExperimentJoint, perform_experiment
from dxlrun_lab.guided.own_run import OwnRun
from dxlrun_lab.guided.rig import live_rig
from dxlrun_lab.guided.segment import Segment

pytestmark = pytest.mark.long

ROBOT = """\
name: pair
buses:
  main: {port: sim, protocol: 2.0, baud_rate: 1_000_000, return_delay_time: 0 us}
loop: {rate: 100, tolerated_skips: 100 %, scheduler: {policy: round_robin, priority: 31}}
joints:
  pan: {bus: main, id: 3, model: XM430-W350, reference: 180 deg, direction: 1}
  tilt: {bus: main, id: 7, model: XM430-W350, reference: 180 deg, direction: -1}
controllers:
  pan_hold: {type: joint_group_position_controller, joints: [pan]}
  tilt_hold: {type: joint_group_position_controller, joints: [tilt], active: false}
"""


VIRTUAL = ExperimentOptions(virtual=True)


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        directory = tmp_path_factory.mktemp("live")
        patch.setenv("XDG_RUNTIME_DIR", str(directory))
        patch.chdir(directory)
        runs = LiveRuns(directory)
        runs.shared = []
        (directory / "pair.yaml").write_text(ROBOT)
        yield runs
        runs.end()


@pytest.fixture
def place(runs):
    return Path.cwd()


@pytest.fixture
def running(runs):
    """A run that does not belong to an experiment; another one after one that died."""
    if not runs.shared or runs.shared[-1].process.poll() is not None:
        runs.shared.append(runs.start("--duration", "300", gateway=True))
        until(dxlrun.running, check=runs.shared[-1].lives)
    return runs.shared[-1]


@pytest.fixture
def robot(running):
    with dxlrun.connect() as robot:
        yield robot


@pytest.fixture
def rig(robot):
    rig = live_rig(dxlrun.connect("pair", "experiment"))
    yield rig
    assert rig.close() == ()


def two(joint: ExperimentJoint) -> Iterator[Segment]:
    yield sine(joint, 100, 0.5, settle_s=0.1)
    yield sine(joint, 50, 0.5, loop_rate=50)


def short(joint: ExperimentJoint) -> Iterator[Segment]:
    yield sine(joint, 100, 0.1)


def test_a_running_robot_is_recorded_by_its_log_and_left_as_it_was(rig):
    before = state_of(rig)
    plays, done = perform(rig, "tilt", two)
    assert state_of(rig) == before
    assert (done.why, len(plays.got)) == ("", 2)
    log = read_log(rig.log)
    for got, expected_s in zip(plays.got, (0.6, 0.5), strict=True):
        assert got.joints == ("tilt",)
        assert got.time[-1] == pytest.approx(expected_s, abs=0.1)
        assert np.isin(got.of_cycles("cycle"), log.cycles["cycle"]).all()
        moved = got.position[:, 0]
        assert moved.max() - moved.min() > 0.15
        woken_ns, written_ns = got.of_cycles("woken_ns"), got.of_cycles("written_ns")
        for cycle, name in ((0, "goal_accepted"), (-1, "goal_ended")):
            times = [event.t_ns for event in log.events if event.name == name]
            assert any(woken_ns[cycle] <= t_ns <= written_ns[cycle] for t_ns in times)


@contextmanager
def another_experiment(rig, interface):
    rig.load_controller(f"experiment_{interface}", {"type": "sample_player", "joints": ["tilt"]})
    yield
    rig.unload_controller(f"experiment_{interface}")


def test_a_robot_that_is_in_use_is_refused_with_what_frees_it(rig, robot):
    with pytest.raises(InputError) as caught:
        situation_of(rig, ["pan", "tilt"], {})
    assert caught.value.sentences == (
        "joint pan is commanded by pan_hold; free it first: dxlrun switch --deactivate pan_hold --robot pair",
    )
    robot.pause()
    with pytest.raises(InputError, match="pair is paused; resume it first: dxlrun resume"):
        situation_of(rig, ["tilt"], {})
    robot.resume()
    situation = situation_of(rig, ["tilt"], {})
    used = pytest.raises(InputError, match=r"another experiment uses pair \(experiment_pwm is")
    with another_experiment(rig, "pwm"), used:
        situation_of(rig, ["tilt"], {})
    with another_experiment(rig, "position"):  # both began at once
        before = state_of(rig)
        done = perform_experiment(rig, Plays(two), situation)
        assert (done.recorded, done.not_restored, state_of(rig)) == ((), (), before)
        assert "experiment_position" in done.why
    assert not rig.paused


@pytest.mark.needs("identify")
def test_a_robot_without_its_whole_log_is_refused(tmp_path, monkeypatch, capsys):
    """One that records none; one that deletes parts and runs, and one that would have to be started."""
    with pytest.raises(InputError, match="pair records no log, but an experiment needs a log"):
        live_rig(SimpleNamespace(name="pair", info=lambda: {"log": None}))
    file = tmp_path / "robot.yaml"
    file.write_text(ROBOT + "recording: {split: 1 min, keep: 10 min}\n")
    VirtualRobot(plan_of(file, duration_s=0.1), log=tmp_path / "log").run()

    with pytest.raises(InputError, match="pair deletes the oldest parts of its log"):
        live_rig(SimpleNamespace(name="pair", info=lambda: {"log": str(tmp_path / "log")}))
    monkeypatch.setattr(OwnRun, "__init__", lambda self, words: pytest.fail("a run was started"))
    assert main(["identify", str(file), "pan", "--yes"]) == 2
    assert f"{file} deletes the oldest parts of its log" in capsys.readouterr().err


def test_a_key_is_an_abort_with_the_rest_kept(robot, monkeypatch, capsys):
    """Of the whole command; any key on a terminal, which is as it was afterwards."""
    import pty
    import termios

    ours, theirs = pty.openpty()
    before = termios.tcgetattr(theirs)
    with open(theirs, closefd=False) as terminal:
        monkeypatch.setattr(sys, "stdin", terminal)

        def segments(joint):
            yield sine(joint, 100, 0.1)
            threading.Timer(1.2, os.write, (ours, b"x")).start()
            yield sine(joint, 100, 30.0)

        looking = live_rig(dxlrun.connect("pair"))
        state = state_of(looking)
        ran = run_on_robot(Plays(segments), ["tilt"], ExperimentOptions(range=("tilt=-15deg..15deg",)))
        assert state_of(looking) == state
        looking.close()
    assert (ran.why, ran.result, ran.exit_code) == ("aborted by a key", 2, 130)
    said = capsys.readouterr().err
    assert "tilt (ID 7 on bus main) moves within -15 to 15 deg (--range); it is at" in said
    assert "any key ends the experiment" in said
    assert "pair: the experiment ended early: aborted by a key; 2 segments measured before" in said
    assert termios.tcgetattr(theirs) == before
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_run_of_its_own_frees_the_joint_and_ends_in_order_by_a_signal(robot):
    """Beside the robot of the other tests. A run under nohup, which ignores SIGHUP, would go on."""
    outer = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    others = set(sockets())

    def signalled(joint):
        yield sine(joint, 50, 0.2, loop_rate=50)
        threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGHUP)).start()
        yield sine(joint, 50, 30.0, loop_rate=50)

    plays = Plays(signalled)
    ran = run_on_robot(plays, ["pair.yaml", "pan"])
    assert (ran.robot, ran.exit_code, ran.why, len(plays.got)) == ("pair", 130, "aborted by SIGHUP", 1)
    assert ran.problems == ()
    assert set(sockets()) <= others  # the other run may have died: its verdict is that of a machine in use
    assert whole(ran.log), "it ended in order, at its rate"
    assert signal.signal(signal.SIGHUP, outer) is signal.SIG_DFL


def test_a_run_that_cannot_begin_says_why(place):
    (place / "gone.yaml").write_text(
        ROBOT.replace("port: sim", "port: /dev/no_such_port, adapter: {latency: 1 ms}")
    )
    plays = Plays(short)
    with pytest.raises(DxlrunError, match=r"^port /dev/no_such_port not found"):
        run_on_robot(plays, ["gone.yaml", "pan"], ExperimentOptions(yes=True))
    (place / "wrong.yaml").write_text(ROBOT.replace("rate: 100", "rat: 100").replace("id: 7", "id: 3"))
    with pytest.raises(InputError) as caught:
        run_on_robot(plays, ["wrong.yaml", "pan"])
    assert {problem.mark.line for problem in caught.value.problems} == {4}


def test_a_part_without_a_result_is_one_more_sentence(place, capsys):
    class Asks(Plays):
        def evaluate_recordings(self, *_):
            raise InputError("too short")

    def gives_up(joint):
        yield from short(joint)
        raise DxlrunError("no two responses are alike")

    ran = run_on_robot(Asks(gives_up), ["pair.yaml", "pan"], VIRTUAL)
    assert (ran.result, ran.exit_code) == (None, 1)
    assert capsys.readouterr().err.splitlines()[-2:] == [
        "pair: the experiment ended early: no two responses are alike; 1 segment measured before",
        "pair: too short",
    ]
    with pytest.raises(InputError, match="too short"):
        run_on_robot(Asks(short), ["pair.yaml", "pan"], VIRTUAL)


def test_real_servos_are_asked_for_and_counted_down(place, monkeypatch, capsys):
    """A simulated robot whose ports are taken for real ones."""
    monkeypatch.setattr(on_robot, "_real", lambda plan, options: True)
    monkeypatch.setattr(on_robot, "COUNTDOWN_S", (3, 0.1))
    plays = Plays(short)
    with open(os.devnull) as nothing:
        monkeypatch.setattr(sys, "stdin", nothing)
        ran = run_on_robot(plays, ["pair.yaml", "pan"], ExperimentOptions(virtual=True, yes=True))
    assert (ran.exit_code, len(plays.got)) == (0, 1)
    assert (
        "pan will move in 3 ...\npan will move in 2 ...\npan will move in 1 ...\n" in capsys.readouterr().err
    )


@pytest.mark.parametrize("answer", [b"n\n", b"\n", b"", None])
def test_without_a_yes_no_run_is_started(place, monkeypatch, capsys, answer):
    """A run switches torque on, so the question comes before it; b"": Ctrl-C at it, None: no terminal."""
    monkeypatch.setattr(on_robot, "_real", lambda plan, options: True)
    logs, ran = set(place.glob("logs/*")), None
    plays = Plays(short)
    ours, theirs = os.openpty()
    with open(os.devnull if answer is None else theirs) as stdin:
        monkeypatch.setattr(sys, "stdin", stdin)
        if answer:
            os.write(ours, answer)
        elif answer is not None:
            # the signal comes when the command waits for an answer
            waits = SimpleNamespace(select=lambda *_: (signal.raise_signal(signal.SIGINT), ([], [], []))[1])
            monkeypatch.setattr(on_robot, "select", waits)
        words, options = ["pair.yaml", "tilt"], ExperimentOptions(range=("tilt=-15deg..15deg",))
        if answer is None:
            with pytest.raises(InputError, match="their motion cannot be confirmed without a terminal"):
                run_on_robot(plays, words, options)
        else:
            ran = run_on_robot(plays, words, options)
    os.close(ours)
    assert set(place.glob("logs/*")) == logs
    said = capsys.readouterr().err
    assert "tilt (ID 7 on bus main) will move within -15 to 15 deg (--range), at up to " in said
    assert "starting" not in said
    assert plays.got == []
    if ran is not None:
        why = "nothing was moved" if answer else "aborted by Ctrl-C"
        assert (ran.result, ran.log, ran.why, ran.exit_code) == (None, None, why, 130)


SCRIPT = f"""
import sys
sys.path.insert(0, {str(ROOT)!r})
from tests.kit.experiments import Plays, sine
from dxlrun_lab.commands.on_robot import run_on_robot
def segments(joint):
    for number in range(3):
        yield sine(joint, 100, 0.7)
        yield sine(joint, 50, 0.5, loop_rate=50)
print("ready", flush=True)
try:
    ran = run_on_robot(Plays(segments), ["pair.yaml", "pan"])
except KeyboardInterrupt:  # as the command line does, before an experiment takes the signals
    sys.exit(130)
sys.exit(ran.exit_code)
"""


@campaign(ci=0, night=10, release=50)
def test_a_signal_at_any_time_leaves_nothing_of_the_run(place, number, chance):
    """In the start, in the middle, in the end, and when it is killed."""
    before, others = set(place.glob("logs/*.mcap")), set(sockets())
    words = [sys.executable, "-c", SCRIPT]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    after_s = chance.uniform(0.0, 8.0)
    ends = chance.choice([signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
    print(f"{ends.name} after {after_s} s")
    time.sleep(after_s)  # when is what the test is about
    process.send_signal(ends)
    _, said = process.communicate(timeout=DEADLINE_S)
    assert process.returncode in (0, 130, -ends), said
    assert "Traceback" not in said

    def tidy() -> bool:
        logs = set(place.glob("logs/*.mcap")) - before
        return set(sockets()) == others and all(map(whole, logs))

    if process.returncode == -signal.SIGKILL:
        until(tidy)
    assert tidy(), "of any other end it waits itself"


def whole(log: Path) -> bool:
    """Return whether a log is complete, at the rate of before; that of a run that never began is removed."""
    try:
        found = read_log(log)
    except DxlrunError:
        return not log.exists()
    rates = np.diff(found.cycles["scheduled_ns"][-3:])
    return found.complete and bool((rates % 10_000_000 == 0).all())


def test_a_signal_in_the_middle_of_an_import_is_taken(monkeypatch):
    """It comes wherever the program is, and the modules of a run are imported while signals are taken."""
    with AbortMonitor() as aborting:
        monkeypatch.setitem(sys.modules, "dxlrun_lab.guided.own_run", ModuleType("half"))
        signal.raise_signal(signal.SIGINT)
        assert aborting() == "aborted by Ctrl-C"


def test_an_experiment_whose_gateway_dies_says_that_nothing_was_put_back(running, robot, capsys):
    """The last test of the robot of the others, which goes on without one."""

    def kill_gateway(joint):
        yield sine(joint, 100, 0.2)
        os.kill(running.child("remote"), signal.SIGKILL)
        yield sine(joint, 100, 1.0)

    plays = Plays(kill_gateway)
    ran = run_on_robot(plays, ["tilt"])
    assert (ran.robot, ran.exit_code, len(plays.got)) == ("pair", 1, 1)
    assert "the run of pair" in ran.why
    assert "so the run was not restored" in capsys.readouterr().err
