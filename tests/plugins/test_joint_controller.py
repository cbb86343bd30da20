"""JointController and single files: whole controllers in a few lines, and one sentence for a wrong one."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from jsonschema import Draft202012Validator
from tests.kit.answers import result_of
from tests.kit.awaited import DEADLINE_S, until
from tests.kit.cases import case_parameters
from tests.kit.commands import matches
from tests.kit.stages import Stage

from dxlrun import Floats, InputError, JointController, RemoteRobot, connect, reading, running
from dxlrun.cli import main
from dxlrun.contract.joint_controller import _TAKEN
from dxlrun.control.controllers import single_files
from dxlrun.control.controllers.plugin_loading import controller_breach
from dxlrun.description.robot import ControllerEntry
from dxlrun.testing import plan_of, read_log, simulated_robot
from dxlrun.tooling.runs import VirtualLink
from dxlrun_analysis.replay import Setting, replay_log

SHORT = Path(__file__).with_name("short")
WAVE = (SHORT / "wave.py").read_text()
LAW = "self.start + self.amplitude * np.sin(2 * np.pi * self.frequency * time)"
ROBOT = """\
name: short
loop: {rate: 50}
buses: {main: {port: sim, protocol: 2.0, baud_rate: 1_000_000}}
joint_defaults: {bus: main, model: XM430-W350, reference: 180 deg, direction: 1}
joints: {pan: {id: 1}, tilt: {id: 2}}
controllers:
  head: {type: ./wave.py:Wave, joints: [pan, tilt], frequency: 2 Hz}
"""


@pytest.fixture
def written(tmp_path, monkeypatch):
    """Write wave.py with some text replaced, and a robot file that uses it; return the robot file."""
    monkeypatch.chdir(tmp_path)

    def write(old: str = "", new: str = "", *, robot: str = ROBOT) -> Path:
        assert old in WAVE
        Path("wave.py").write_text(WAVE.replace(old, new) if old else WAVE + new)
        Path("robot.yaml").write_text(robot)
        return Path("robot.yaml")

    return write


def test_three_short_controllers_run_and_replay_bit_for_bit(tmp_path):
    log = tmp_path / "run.mcap"
    robot = simulated_robot(SHORT / "short.yaml", duration_s=1.0, log=log)
    assert robot.run().detail == ""
    assert all(len(path.read_text().splitlines()) < 20 for path in SHORT.glob("*.py"))
    commands = read_log(log).cycles
    wave, sway = commands["command_position"][:, :2].T
    np.testing.assert_allclose(wave - wave[0], 0.3 * np.sin(4 * np.pi * 0.01 * np.arange(100)), atol=1e-12)
    assert np.ptp(sway) > 0.01  # the gyroscope is on the link that the wave moves
    assert np.isfinite(commands["command_effort"][:, 2:]).all()
    assert replay_log(log).sentence == "short: 100 cycles replayed, 0 differences"


def test_code_of_a_log_is_executed_only_on_request(written):
    file, log = written("", "\nimport pathlib\npathlib.Path('ran').write_text('')\n"), Path("run.mcap")
    simulated_robot(file, duration_s=0.3, log=log).run()
    Path("ran").unlink()
    single_files._executed.cache_clear()  # a process executes a text once
    written(LAW, "self.start")
    with pytest.raises(InputError, match=r"changed since the run.* --code current .* --code log .* trust"):
        replay_log(log)
    with pytest.raises(InputError, match="--code current"):
        replay_log(log, [Setting.parse("head.frequency=1")], {})
    current = replay_log(log, code="current")
    assert current.different > 10
    assert current.first is not None
    assert current.first.what == "command of the position"
    assert any("came from wave.py" in remark for remark in current.remarks)
    assert not Path("ran").exists()
    trusted = replay_log(log, code="log")
    assert trusted.same
    assert Path("ran").exists()
    assert trusted.remarks == ("wave.py has changed since the run; the replay ran the version in the log",)
    written("class Wave", "class Other(JointController):\n    pass\n\n\nclass Another")
    with pytest.raises(InputError, match=r"wave\.py has no class Wave"):
        replay_log(log, code="current")
    Path("wave.py").unlink()
    with pytest.raises(InputError, match=r"wave\.py cannot be read; write --code"):
        replay_log(log)
    with pytest.raises(InputError, match=r"--code current: wave\.py cannot be read"):
        replay_log(log, code="current")
    assert replay_log(log, code="log").same


def test_loop_gateway_and_a_replay_of_a_whole_run_have_it(written, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    program = "import sys; from dxlrun.cli import main; sys.exit(main())"
    words = [sys.executable, "-c", program, written(), "--duration", "60"]
    with Path("said").open("w") as said, subprocess.Popen(words, stdout=said, stderr=said) as ran:
        until(lambda: bool(running()) or ran.poll() is not None)
        assert ran.poll() is None, Path("said").read_text()
        Path("wave.py").unlink()  # it was read once
        with connect() as robot:
            changed = robot.set_parameters("head", {"amplitude": "0.2 rad"})
            assert changed == {"amplitude": ("0.3 rad", "0.2 rad")}
            robot.stop()
        ran.wait(DEADLINE_S)  # with 1 where a busy machine let servos miss replies, or the loop skip periods
    assert "log: logs/short_" in Path("said").read_text()
    assert replay_log(next(Path("logs").glob("*.mcap")), code="log").same


def test_its_fields_are_parameters_with_units_that_a_client_changes(written):
    link = VirtualLink(plan_of(written()))
    robot = RemoteRobot("short", link)
    try:
        values = {one.name: one.value for one in robot.parameter_table("head")}
        assert values == {"joints": ["pan", "tilt"], "amplitude": "0.3 rad", "frequency": "2.0 Hz"}
        changed = robot.set_parameters("head", {"amplitude": "0.5 rad"})
        assert changed == {"amplitude": ("0.3 rad", "0.5 rad")}
        with pytest.raises(Exception, match=r"0\.3 has no unit"):
            robot.set_parameters("head", {"amplitude": 0.3})
    finally:
        link.close()


def test_check_shows_it_and_an_editor_takes_it(written, capsys):
    assert main(["check", str(written()), "--json"]) == 0
    (shown,) = result_of(capsys.readouterr().out)["controllers"]
    entry = json.loads((SHORT.parents[2] / "robots/robot.schema.json").read_text())["$defs"][
        "ControllerEntry"
    ]
    kind = Draft202012Validator({**entry["properties"]["type"], "$defs": {"argument": {"pattern": r"\$"}}})
    assert [kind.is_valid(one) for one in ("./wave.py:Wave", "../wave.py:Wave", "./wave.py")] == [
        True,
        False,
        False,
    ]
    assert (shown["type"], shown["distribution"].split()[0]) == ("./wave.py:Wave", "wave.py")


@pytest.mark.parametrize(
    ("kind", "sentence"),
    [
        ("./out.py:Wave", "./out.py:Wave of head is not a class in the folder of the robot file; "),
        ("./bytes.py:Wave", "bytes.py of controller head cannot be read (not UTF-8); "),
        ("./pipe.py:Wave", "pipe.py of controller head cannot be read (this is not a regular file)"),
    ],
)
def test_only_files_beside_the_robot_file_are_read(written, tmp_path_factory, kind, sentence):
    """Other mistakes are in `tests/compile/cases/single_file.txt`."""
    file = written(robot=ROBOT.replace("./wave.py:Wave", kind))
    outside = tmp_path_factory.mktemp("outside") / "out.py"
    outside.write_text(WAVE)
    Path("out.py").symlink_to(outside)
    Path("bytes.py").write_bytes(b"\xff\xfe")
    os.mkfifo("pipe.py")
    with pytest.raises(InputError) as refused:
        plan_of(file)
    assert str(refused.value).startswith(f"robot.yaml:7:16: {sentence}")
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("case", case_parameters(SHORT / "faults.txt"))
def test_a_wrong_result_ends_the_controller_by_the_policy_of_a_fault(written, case):
    robot = simulated_robot(written(LAW, case.name), duration_s=0.3)
    assert matches(f"...controller head {case.lines[0].text}...", robot.run().detail)


class Lean(JointController):
    """Reads another joint."""

    other: float = reading("knee/position")
    gain: float = 1.0
    TABLE: ClassVar[tuple[float, ...]] = (1.0,)

    def begin(self) -> None:
        self.began = self.start.copy()

    def positions(self, time: float, dt: float) -> Floats:
        return self.began + self.gain * self.other + time


class Quick(Lean):
    """With a speed, and two fields more."""

    speed: float = 2.0
    far: float = reading("ankle/position")

    def velocities(self, time: float, dt: float) -> Floats:
        return np.full(2, self.speed * dt)


def test_what_it_is_sent_in_its_first_cycle_is_not_lost():
    class Follow(JointController):
        def begin(self) -> None:
            self.goal = self.start

        def on_command(self, kind: str, data: Floats, time_ns: int) -> None:
            self.goal = data

        def positions(self, time: float, dt: float) -> Floats:
            return self.goal

    stage = Stage(Follow, {"joints": ["a", "b"]}).activate()
    stage.controller.on_command("positions", np.array([0.1, 0.2]), 0)
    assert stage.update(0.0).tolist() == [0.1, 0.2]


def test_it_begins_when_all_that_it_reads_is_known_and_time_counts_from_there():
    stage = Stage(Quick, {"joints": ["a", "b"], "other": "hip/position"}).activate()
    assert stage.interfaces.reads == ("hip/position", "ankle/position")
    assert stage.interfaces.command == ("position", "velocity")
    assert np.isnan(stage.update(1.0, follow=False)).all()
    stage.context.reads[:] = 0.5
    assert stage.update(2.0, follow=False).tolist() == [0.3 + 0.5, -0.2 + 0.5]
    assert stage.update(3.0, follow=False).tolist() == [0.3 + 0.5 + 1.0, -0.2 + 0.5 + 1.0]
    assert stage.commands.velocity.tolist() == [0.04, 0.04]
    stage.change(gain=0.0)
    assert stage.update(4.0, follow=False).tolist() == [0.3 + 2.0, -0.2 + 2.0]


def test_it_waits_for_a_joint_that_was_not_heard_yet():
    class Hold(JointController):
        def positions(self, time: float, dt: float) -> Floats:
            return self.start + 0.0

    stage = Stage(Hold, {"joints": ["a", "b"]}, present=(0.3, np.nan)).activate()
    assert np.isnan(stage.update(0.0, follow=False)).all()
    stage.states.position[1] = 0.7
    stage.sent.position[:] = 0.25, np.nan  # the joint sags below its goal
    assert stage.update(0.1, follow=False).tolist() == [0.25, 0.7]


def test_names_of_the_entry_are_no_fields_and_the_class_fits_the_contract():
    assert set(ControllerEntry.model_fields) - {"parameters"} <= set(_TAKEN)
    assert controller_breach(Quick) is None


FIRST_WORDS = {
    "print": "print('here')",
    "a log record": "__import__('logging').warning('here')",
    "a warning of numpy": "np.log(np.zeros(2) - 1)",
}


@pytest.mark.parametrize(
    ("word", "to"), [("print", "terminal"), ("a log record", "pipe"), ("a warning of numpy", "file")]
)
def test_the_first_output_of_a_controller_starts_no_thread_in_its_call(written, word, to):
    written(f"return {LAW}", f"{FIRST_WORDS[word]}\n        return {LAW}")
    program = "import sys; from dxlrun.cli import main; sys.exit(main())"
    words = [sys.executable, "-c", program, "robot.yaml", "--virtual", "--duration", "0.1"]
    if to == "terminal":
        main_end, end = os.openpty()
        ran = subprocess.run(words, stdout=end, stderr=end, check=False, timeout=DEADLINE_S)
        os.close(end)
        os.close(main_end)
    else:
        with Path("said").open("w") as said:
            ran = subprocess.run(
                words,
                stdout=subprocess.PIPE if to == "pipe" else said,
                stderr=subprocess.STDOUT,
                check=False,
                timeout=DEADLINE_S,
            )
    assert ran.returncode == 0, ran.stdout or Path("said").read_text()


def test_an_interrupt_that_a_controller_raises_is_its_fault(written, capfd):
    written(f"return {LAW}", "raise KeyboardInterrupt")
    assert main(["robot.yaml", "--virtual", "--duration", "1"]) == 1
    said = "".join(capfd.readouterr())
    assert "controller head raised in update: KeyboardInterrupt" in said
