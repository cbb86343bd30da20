"""Kept state: what a controller keeps in one run it has in the next; whatever ends, a file is old or new."""

import errno
import os
import random
import resource
import signal
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace
from tests.kit.awaited import until
from tests.kit.campaigns import campaign
from tests.kit.packages import plugin_folder

from dxlrun import ControllerFault
from dxlrun.channels.cycle import CycleLayout, CycleRecord
from dxlrun.channels.event_records import EventBody, EventCode, Severity
from dxlrun.channels.kept import (
    LONGEST_FILE,
    MOST_KEPT,
    PIECE,
    Assembly,
    KeptFile,
    KeptPiece,
    KeptStates,
    difference,
    file_pieces,
    opened_file,
)
from dxlrun.control.controllers.keeping import StateKeeper
from dxlrun.control.controllers.published_topics import TopicLog
from dxlrun.messages.cdr import Codec
from dxlrun.messages.declared import declared_message
from dxlrun.plan.loop_plan import ControllerPlan
from dxlrun.run.kept_files import read_states, replace_file, state_directory
from dxlrun.testing import plan_of, read_log, simulated_robot
from dxlrun_analysis.replay import Setting, replay_log

pytestmark = pytest.mark.long

ROBOT = """\
name: keeper
arguments:
  port: {default: sim, help: "serial port"}
  id: {default: 3, help: "ID of pan"}
  gain: {default: 32, help: "P gain of pan"}
  direction: {default: 1, help: "direction of pan"}
buses:
  main:
    {port: "${port}", protocol: 1.0, baud_rate: 1_000_000, return_delay_time: 0 us, adapter: {latency: 1 ms}}
loop: {rate: 100, tolerated_skips: 100 %}
joints:
  pan:
    bus: main
    id: "${id}"
    model: MX-28
    reference: 180 deg
    direction: "${direction}"
    registers: {p_gain: "${gain}"}
controllers:
  runs: {type: runs, joints: [pan], size: 20000}
"""
PLUGIN = '''\
"""A controller that counts its runs: it goes a bit further in each."""
from dxlrun import Controller, Interfaces, ParametersModel, hookimpl


class RunsParameters(ParametersModel):
    joints: tuple[str, ...]
    size: int = 0
    every: int = 0


class Runs(Controller[RunsParameters]):
    Parameters = RunsParameters
    keeps = True

    @classmethod
    def interfaces(cls, parameters, joints):
        return Interfaces(parameters.joints, ("position",))

    def on_configure(self, context):
        super().on_configure(context)
        self.number = int(context.kept[:8] or b"0")
        self.updates = 0

    def on_activate(self, time_ns):
        self.context.commands.position[:] = self.number * 0.01

    def keep(self):
        self.number += 1
        self.context.keep(b"%08d" % self.number + bytes([self.number % 251]) * self.parameters.size)

    def update(self, time_ns, period_ns):
        self.updates += 1
        if self.parameters.every and self.updates % self.parameters.every == 0:
            self.keep()

    def on_deactivate(self, time_ns):
        if not self.parameters.every:
            self.keep()


@hookimpl
def dxlrun_contract():
    return 3


@hookimpl
def dxlrun_controllers():
    return {"runs": Runs}
'''


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    return plugin_folder(tmp_path_factory.mktemp("plugin"), "runs", PLUGIN, "runs")


@pytest.fixture
def robot(tmp_path, installed, monkeypatch):
    monkeypatch.syspath_prepend(str(installed))
    path = tmp_path / "keeper.yaml"
    path.write_text(ROBOT)
    return path


def run(robot: Path, kept: Path | None, log: Path | None = None, **arguments: str) -> int:
    """Return which run it was, by what its controller commanded."""
    made = simulated_robot(robot, arguments=arguments, duration_s=0.05, log=log, kept=kept)
    assert made.run().detail == ""
    assert made.unkept == ()
    return round(float(made.record.goals.position[0]) * 100)


def said(log: Path) -> list[tuple[int, str]]:
    return [(event.severity, event.text) for event in read_log(log).events if event.code == EventCode.KEPT]


def test_a_state_goes_from_run_to_run_and_a_replay_begins_with_it(robot, tmp_path):
    kept, log = tmp_path / "kept", tmp_path / "run.mcap"
    assert [run(robot, kept) for _ in range(3)] == [0, 1, 2]
    assert [path.name for path in kept.iterdir()] == ["runs.kept"]
    assert run(robot, kept, log) == 3
    ((severity, text),) = said(log)
    assert severity == Severity.INFO
    assert text == f"starts with its kept state of 20008 bytes ({kept}/runs.kept)"
    (kept / "runs.kept").unlink()  # the replay has what it needs in the log
    report = replay_log(log)
    assert report.same, report
    assert report.messages >= 4, "the pieces that left are compared"
    assert run(robot, kept) == 0, "to delete the file is to forget"


def test_a_replay_compares_what_left_also_of_a_run_that_keeps_nothing(robot, tmp_path):
    log = tmp_path / "run.mcap"
    assert [run(robot, None), run(robot, None, log)] == [0, 0]
    report = replay_log(log, [Setting("runs", ("size",), 19999)])
    assert not report.same
    assert report.first is not None
    assert report.first.what.startswith("message of /kept")


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"id": "4"}, "pan ID was 3 on bus main, now 4 on bus main"),
        ({"gain": "20"}, "pan p_gain was 32, now 20"),
        ({"direction": "-1"}, "pan direction was 1, now -1"),
    ],
)
def test_another_servo_begins_anew_and_says_why(robot, tmp_path, change, why):
    kept, log = tmp_path / "kept", tmp_path / "run.mcap"
    run(robot, kept)
    assert run(robot, kept, log, **change) == 0
    assert said(log) == [(Severity.WARNING, f"starts without its kept state: {why} ({kept}/runs.kept)")]
    assert run(robot, kept, **change) == 1, "its own state has taken the place"


def test_declaring_the_offset_of_a_servo_keeps_its_state(tmp_path):
    def states(key: str):
        path = tmp_path / "robot.yaml"
        path.write_text(
            "name: arm\nbuses: {main: {port: sim, protocol: 2.0, baud_rate: 1_000_000}}\nloop: {rate: 50}\n"
            "joints: {a: {bus: main, id: 1, model: XM430-W350, reference: 100.3 deg, direction: 1"
            f"{key}, limits: {{position: [-50 deg, 50 deg]}}}}}}\n"
        )
        return read_states(plan_of(path), None)

    assert states(", homing_offset: -300") == states("")
    assert states(", homing_offset: -300").servos != {}


def test_simulated_and_real_servos_do_not_share_a_state(robot, tmp_path):
    simulated, real = plan_of(robot), plan_of(robot, arguments={"port": "/dev/ttyUSB0"})
    home = Path(os.environ["XDG_STATE_HOME"]) / "dxlrun/keeper"
    assert (state_directory(simulated), state_directory(real)) == (home / "simulated", home)
    assert state_directory(replace(real, buses=(*real.buses, *simulated.buses))) == home / "simulated"
    # the servos of `dxlrun sim` are on a pseudo-terminal, or behind a link to one
    terminals = os.openpty()
    link = tmp_path / "servos"
    link.symlink_to(os.ttyname(terminals[1]))
    for port in (os.ttyname(terminals[1]), str(link)):
        plan = plan_of(robot, arguments={"port": port})
        assert state_directory(plan) == home / "simulated"
        assert read_states(plan, None).servos["pan"]["servo"] == "simulated"
    assert read_states(real, None).servos["pan"]["servo"] == "real"
    for terminal in terminals:
        os.close(terminal)


def test_no_home_directory_keeps_nothing(robot, monkeypatch):
    def none():
        raise RuntimeError("no home")

    monkeypatch.setenv("XDG_STATE_HOME", "not/absolute")
    monkeypatch.setattr(Path, "home", none)
    assert state_directory(plan_of(robot)) is None


DAMAGED, FOREIGN = (
    "is damaged or incomplete",
    "is not a state of a controller, or was saved by another version",
)
DAMAGES = {
    "empty": (lambda data: b"", FOREIGN),
    "cut": (lambda data: data[:-1], DAMAGED),
    "half": (lambda data: data[: len(data) // 2], DAMAGED),
    "torn": (lambda data: data[: len(data) // 2].ljust(len(data), b"\0"), DAMAGED),
    "one bit": (lambda data: data[:9000] + bytes([data[9000] ^ 4]) + data[9001:], DAMAGED),
    "longer": (lambda data: data + b"x", DAMAGED),
    "too long": (lambda data: bytes(LONGEST_FILE + 1), f"is longer than {LONGEST_FILE} bytes"),
    "noise": (lambda data: random.Random(1).randbytes(5000), FOREIGN),
    "version": (lambda data: data.replace(b"state 1", b"state 2"), FOREIGN),
    "foreign": (
        lambda data: b"".join(file_pieces("another", b"state", {})[1]),
        "belongs to another controller, another",
    ),
}


@pytest.mark.parametrize("how", DAMAGES)
def test_a_file_that_cannot_be_used_is_left_out_with_one_event(robot, tmp_path, how):
    kept, log = tmp_path / "kept", tmp_path / "run.mcap"
    run(robot, kept)
    place = kept / "runs.kept"
    damage, why = DAMAGES[how]
    place.write_bytes(damage(place.read_bytes()))
    assert run(robot, kept, log) == 0
    assert said(log) == [
        (Severity.WARNING, f"starts without its kept state: the state's file {why} ({place})")
    ]
    assert opened_file(place.read_bytes(), "runs")[0].startswith(b"00000001"), "a good one takes its place"


def test_what_is_no_file_does_not_block_the_start(robot, tmp_path):
    kept, log = tmp_path / "kept", tmp_path / "run.mcap"
    kept.mkdir()
    os.mkfifo(kept / "runs.kept")
    assert run(robot, kept, log) == 0
    ((_, text),) = said(log)
    assert "the state's path is not a regular file" in text


def test_a_full_disk_leaves_the_old_file_and_says_so(robot, tmp_path):
    kept = tmp_path / "kept"
    run(robot, kept)
    before = (kept / "runs.kept").read_bytes()
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    made = simulated_robot(robot, duration_s=0.05, kept=kept)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, hard))  # write() then ends short, and next fails
    try:
        assert made.run().detail == ""
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert made.unkept == (f"the last state of runs was not saved in {kept}: {os.strerror(errno.EFBIG)}",)
    assert (kept / "runs.kept").read_bytes() == before
    assert [path.name for path in kept.iterdir()] == ["runs.kept"]
    assert run(robot, kept) == 1


# What leaves the loop


class Keeping(StateKeeper):
    """Keeps the messages that leave; without events."""

    def __init__(self, states: KeptStates | None = None) -> None:
        self.messages: list[bytes] = []
        super().__init__(states or KeptStates(), TopicLog(CycleRecord(CycleLayout((), ())), self), self)

    def announce(self, topic: object) -> int:
        return 0

    def message(self, topic: int, t_ns: int, data: bytes) -> None:
        self.messages.append(data)

    def emit_event(self, source: str, event: EventBody, data: bytes = b"") -> None:
        """Forget it."""

    def keep_as(self, name: str):
        """Return what keeps a state of a controller."""
        return self.open_state(controller(name), {})[1]


def controller(name: str) -> ControllerPlan:
    return ControllerPlan(name, "type", "", "{}", (), (), (), True, 1)


def files_of(messages: list[bytes]) -> list[tuple[str, bytes]]:
    assembly = Assembly(Codec(declared_message(KeptPiece, "dxlrun_msgs").type))
    return [file for data in messages if (file := assembly.add_piece(data)) is not None]


def test_one_piece_leaves_a_cycle_and_the_newest_state_that_waits():
    leaving = Keeping()
    keep, other = leaving.keep_as("a"), leaving.keep_as("b")
    state = np.random.default_rng(1).bytes(3 * PIECE + 1)
    keep(state)
    leaving.publish_next()
    for text in (b"left out", b"newest"):
        keep(text)
    other(b"")
    for cycle in range(2, 60):
        leaving.publish_next()
        assert len(leaving.messages) <= cycle
        assert all(len(data) < PIECE + 200 for data in leaving.messages)
    files = [(name, opened_file(data, name)[0]) for name, data in files_of(leaving.messages)]
    assert files == [("a", state), ("a", b"newest"), ("b", b"")]


def test_at_the_end_everything_leaves_at_once():
    leaving = Keeping()
    keep = leaving.keep_as("a")
    keep(bytes(MOST_KEPT))
    leaving.publish_next()
    keep(b"last")
    leaving.publish_remaining()
    assert [len(opened_file(data, "a")[0]) for _, data in files_of(leaving.messages)] == [MOST_KEPT, 4]


@pytest.mark.parametrize("lost", range(6))
def test_a_file_with_a_lost_piece_is_left_out(lost):
    leaving = Keeping()
    keep = leaving.keep_as("a")
    for state in (bytes(3 * PIECE + 1), b"next"):
        keep(state)
        leaving.publish_remaining()
    del leaving.messages[lost]
    assert [opened_file(data, "a")[0] for _, data in files_of(leaving.messages)] == [b"next"]


def test_a_controller_that_comes_again_has_what_it_kept_last():
    leaving = Keeping(KeptStates({"a": KeptFile("a.kept", problem="its file is damaged")}))
    found, keep = leaving.open_state(controller("a"), {})
    assert found == b""
    keep(b"newest")
    assert leaving.open_state(controller("a"), {})[0] == b"newest"
    other = replace(controller("a"), joints=("other",))
    assert leaving.open_state(other, {})[0] == b"", "what it kept was of other joints"


@pytest.mark.parametrize(
    ("state", "why"),
    [
        (bytes(MOST_KEPT + 1), "1048577 bytes as its state to keep, more than 1048576"),
        (bytearray(3), "bytearray"),
    ],
)
def test_what_cannot_be_kept_is_the_controllers_fault(state, why):
    keep = Keeping().keep_as("a")
    with pytest.raises(ControllerFault, match=why):
        keep(state)


def test_a_controller_that_is_not_declared_to_keep_is_ended(robot, installed):
    plugin = installed / "runs.py"
    plugin.write_text(PLUGIN.replace("keeps = True", "keeps = False"))
    sys.modules.pop("runs", None)
    try:
        result = simulated_robot(robot, duration_s=0.05).run()
    finally:
        plugin.write_text(PLUGIN)
        sys.modules.pop("runs", None)
    assert "set it in the controller's class" in result.detail


# Kills

WRITING = """\
import sys
from pathlib import Path
from dxlrun.run.kept_files import replace_file
print("ready", flush=True)
for number in range(1, 1_000_000):
    replace_file(Path(sys.argv[1]), "a.kept", number.to_bytes(8, "little") * 30_000)
"""


@campaign(ci=4, night=25, release=100)
def test_a_kill_while_a_file_is_written_leaves_the_old_one_or_the_new(tmp_path, amount, chance):
    place, last = tmp_path / "a.kept", 0
    for _ in range(int(amount)):
        process = subprocess.Popen([sys.executable, "-c", WRITING, str(tmp_path)], stdout=subprocess.PIPE)
        assert process.stdout is not None
        process.stdout.readline()
        threading.Event().wait(chance.uniform(0.0, 0.1))
        process.kill()
        process.communicate()
        if place.exists():
            data = place.read_bytes()
            assert data == data[:8] * 30_000
            last = max(last, int.from_bytes(data[:8], "little"))
    replace_file(tmp_path, "a.kept", b"")
    assert [path.name for path in tmp_path.iterdir()] == ["a.kept"], "what killed processes left is removed"
    assert last > 0


@campaign(ci=1, night=6, release=25)
def test_a_kept_state_is_whole_when_the_loop_was_killed_at_any_time(start, robot, installed, amount, chance):
    robot.write_text(ROBOT.replace("size: 20000", "size: 20000, every: 10").replace("keeper", "killed"))
    place = Path(os.environ["XDG_STATE_HOME"]) / "dxlrun/killed/simulated/runs.kept"
    last = 0
    for _ in range(int(amount)):
        running = start("--no-record", robot=robot, plugins=installed)
        until(lambda: place.exists() and _number(place) > last, "a kept state")  # noqa: B023
        last = _number(place)
        threading.Event().wait(chance.uniform(0.0, 0.3))
        os.kill(running.child("run.loop_process"), signal.SIGKILL)
        code, _, err = running.finish()
        assert code == 1
        assert "Traceback" not in err
        assert _number(place) >= last
        last = _number(place)
    running = start("--no-record", "--duration", "0.5", robot=robot, plugins=installed)
    code, _, err = running.finish()
    assert (code, err) == (0, "")
    assert _number(place) > last + 2, "the run went on from what was kept"


def _number(place: Path) -> int:
    state, _ = opened_file(place.read_bytes(), "runs")
    assert state[8:] == bytes([int(state[:8]) % 251]) * 20000
    return int(state[:8])


GEARED = {"elbow model": "MX-64", "elbow gear": "2"}


@pytest.mark.parametrize(
    ("then", "now", "told"),
    [
        (GEARED, GEARED, ""),
        (GEARED, GEARED | {"elbow gear": "3"}, "elbow gear was 2, now 3"),
        (GEARED, {"elbow model": "MX-64"}, "elbow gear was 2, now absent"),
        ({"elbow model": "MX-64"}, GEARED, "elbow gear was absent, now 2"),
    ],
)
def test_each_fact_that_changed_came_or_went_is_a_difference(then, now, told):
    assert difference(then, now) == told
