"""The verbs for a robot that runs, typed into a torso on virtual time; and steering.md on a real run."""

from __future__ import annotations

import json
import math
import re
import runpy
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.kit import commands
from tests.kit.answers import read_answer, result_of
from tests.kit.awaited import DEADLINE_S, until
from tests.kit.commands import Case, cases, play
from tests.kit.live_run import LiveRuns, Running
from tests.kit.pages import page_text

from dxlrun import GoalState, GoalTimeout, RemoteRobot, connect, running
from dxlrun.cli.verb_registry import GROUPS
from dxlrun.remote import client, sockets
from dxlrun.testing import plan_of
from dxlrun.tooling.runs import VirtualLink

pytestmark = pytest.mark.long

ROOT = Path(__file__).parents[2]
PAGE = page_text("steering.md")
TORSO = ROOT / "robots" / "bioloid_torso.yaml"
NAME = "bioloid_torso"
ACTIVE = {"joint_state_broadcaster", "head", "left_arm", "right_arm"}


class Torso(VirtualLink):
    """A torso on virtual time, to which every client is connected."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        super().__init__(plan_of(TORSO))
        self.names, self.asked = [NAME], list[str]()
        for module in (client, sockets):
            patch.setattr(module, "sockets", lambda: dict.fromkeys(self.names) if self.alive else {})
        patch.setattr(client, "SocketLink", self.connect)
        self.robot = RemoteRobot(NAME, self)

    def connect(self, _: object, name: str) -> Torso:
        self._client = name.encode()
        return self

    def exchange(self, method: str, path: str, body: bytes | None) -> tuple[int, bytes]:
        self.asked.append(f"{method} {path}")
        return super().exchange(method, path, body)

    def close(self) -> None:
        """Leave the run to the other clients."""

    def steered(self) -> list[str]:
        """Return the texts of the events that name a command."""
        return [one["text"] for one in self.robot.events()["events"] if one["name"] == "steered"]

    def goals(self) -> list[str]:
        """Return where the head is sent a second later: yaw and pitch, deg."""
        for _ in range(50):
            self.run_cycle()
        joints = map(self.robot.states().joint, ("head_yaw_joint", "head_pitch_joint"))
        return [f"{math.degrees(joint['goal_position']):.0f}" for joint in joints]


@pytest.fixture
def torso(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Torso]:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    one = Torso(monkeypatch)
    yield one
    VirtualLink.close(one)


def test_the_list_has_every_controller_and_what_it_takes(dxlrun, torso: Torso) -> None:
    said = dxlrun("list")
    assert (said.code, said.err) == (0, "")
    assert said.out.startswith("bioloid_torso: 50 Hz, ")
    (shown,) = re.findall(r"    dxlrun list\n\n```\n(.*?)```", PAGE, re.DOTALL)
    printed = " ".join(said.out.partition("\n")[2].split())
    for piece in shown.partition("\n")[2].removesuffix("...\n").split("\n...\n"):  # the page leaves rows out
        assert piece.split()
        before, found, printed = printed.partition(" ".join(piece.split()))
        assert found, before


@pytest.mark.parametrize("case", cases("steered.txt"))
def test_what_is_typed_is_answered(dxlrun, torso: Torso, case: Case) -> None:
    stage = commands.Stage()
    stage.given = {"twin": torso.names.append}
    stage.asked = {"asked": lambda: torso.asked, "steered": torso.steered, "goals": torso.goals}
    play(case, dxlrun, stage)


def test_python_follows_and_cancels_a_goal(torso: Torso) -> None:
    goal = torso.robot.send("left_arm", "position", {"left_elbow_joint": -0.3}, seconds=20.0).goal
    assert goal is not None
    with pytest.raises(GoalTimeout, match=f"goal {goal.number} of left_arm has not ended within 0 s"):
        goal.wait(0.0)
    seen: list[GoalState] = []

    def feedback(state: GoalState) -> None:
        if state.progress > 0.01 and not seen:
            seen.append(state)
            goal.cancel()

    assert goal.wait(DEADLINE_S, feedback).status == "cancelled"
    assert 0.01 < seen[-1].progress < 0.5
    assert torso.robot.goals()[-1].number == goal.number


def test_a_refusal_has_its_code_and_its_fields_for_programs(dxlrun, torso: Torso) -> None:
    said = dxlrun("switch", "--activate", "head", "--json")
    (error,) = read_answer(said.out).errors
    assert (said.code, error.what, torso.asked) == (1, "head is active already", ["POST /switch"])
    assert (error.code, error.fields) == ("active_already", {"controller": ["head"]})


def test_stop_waits_for_the_end_by_default(dxlrun, torso: Torso, monkeypatch: pytest.MonkeyPatch) -> None:
    waits: list[bool] = []
    monkeypatch.setattr(RemoteRobot, "stop", lambda robot, wait: waits.append(wait))
    assert dxlrun("stop").out == "bioloid_torso has ended\n"
    assert dxlrun("stop", "--no-wait").out == "bioloid_torso is ending\n"
    assert waits == [True, False]


def test_pose_that_is_printed_can_be_sent_and_looked_at(dxlrun, torso: Torso) -> None:
    said = dxlrun("get", "left_arm")
    assert (said.code, said.err) == (0, "")
    pose = said.out.split()
    (arm,) = (one for one in torso.robot.info()["controllers"] if one["name"] == "left_arm")
    assert [word.partition("=")[0] for word in pose] == arm["joints"]
    assert dxlrun("send", "left_arm", "position", *pose, "--in", "200ms", "--wait").code == 0
    assert dxlrun("frames", TORSO, "--of", "left_hand_link", "--at", *pose).code == 0
    found = result_of(dxlrun("get", "all", "--json").out)["pose"]
    states = torso.robot.states()
    assert [*found] == list(states.joints)
    assert found["left_elbow_joint"] == states.joint("left_elbow_joint")["position"]


def test_every_command_of_a_running_robot_answers_in_one_form(dxlrun, torso: Torso) -> None:
    """But `echo`, whose messages are live: tests/cli/test_echo.py."""
    lines = """list
        watch --once
        get head_yaw_joint
        set head_yaw_joint led 1
        parameters head
        send head position head_yaw_joint=0deg
        cancel
        rate 50
        play --list
        torque off left_elbow_joint --release
        torque on left_elbow_joint
        switch --activate left_arm
        halt
        switch --activate head left_arm right_arm
        pause
        load spare type=joint_group_position_controller joints=[head_yaw_joint]
        unload spare
        resume
        take-over
        reboot left_elbow_joint
        stop --no-wait"""
    known = {"list", "watch", "play", "stop", *GROUPS["Robots that run"]}
    assert {line.split()[0] for line in lines.splitlines()} == known - {"echo"}
    for line in lines.splitlines():
        said = dxlrun(*shlex.split(line), "--json")
        for text in said.out.splitlines():
            answer = read_answer(text)
            assert (answer.ok, said.err) == (said.code == 0, ""), line
        assert said.code == (1 if line.split()[0] == "reboot" else 0), (line, said)  # Protocol 1.0


# Real runs


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveRuns]:
    directory = tmp_path_factory.mktemp("run")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_RUNTIME_DIR", str(directory))
        runs = LiveRuns(directory)
        yield runs
        runs.end()


@pytest.fixture
def run(runs: LiveRuns) -> Iterator[Running]:
    """A torso in its own processes; a new one after one that has ended."""
    if not running():
        runs.shared = runs.start("--duration", "3600", "--no-record", robot=TORSO, gateway=True)
        until(running, check=runs.shared.lives)
    yield runs.shared
    if running() and runs.shared.process.poll() is None:
        with connect(client="the test") as robot:
            active = {one["name"] for one in robot.info()["controllers"] if one["active"]}
            if active != ACTIVE:
                robot.switch(sorted(ACTIVE - active), sorted(active - ACTIVE))


def test_the_script_of_the_page_steers_a_torso(run: Running, tmp_path: Path) -> None:
    script = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)[0]
    assert len(script.splitlines()) <= 30
    printed = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=False, cwd=tmp_path
    )
    assert (printed.returncode, printed.stderr) == (0, ""), run.lives()
    (shown,) = re.findall(r"It prints:\n\n```\n(.*?)```", PAGE, re.DOTALL)
    assert printed.stdout == shown
    with connect() as robot:
        assert robot.info()["rate"] == 40


def test_the_policy_of_the_page_leads_an_arm(run: Running, tmp_path: Path) -> None:
    text = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)[1]
    (tmp_path / "policy.py").write_text(f"import time\n{text}")
    program = runpy.run_path(str(tmp_path / "policy.py"))
    with connect() as robot:
        elbow = robot.states().joints.index("left_elbow_joint")
        began = robot.states().position[elbow]

        program["follow"](
            robot, lambda states: [[0.0, 0.0, began + 0.1 * step] for step in range(4)], seconds=0.2
        )

        assert robot.states().goal_position[elbow] != began


@pytest.mark.skipif(shutil.which("curl") is None, reason="needs curl, which the page uses")
def test_another_program_reads_the_robot_by_the_page(run: Running) -> None:
    (line,) = re.findall(r"^    (curl .+)$", PAGE, re.MULTILINE)
    printed = subprocess.run(["/bin/bash", "-c", f"{line} --silent"], capture_output=True, check=True)
    assert json.loads(printed.stdout)["robot"] == NAME


def test_the_commands_of_the_page_work_in_their_order(
    dxlrun, run: Running, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (name,) = re.findall(r"where `(.+?)` is", PAGE)
    (file,) = re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)
    (tmp_path / name).write_text(file)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "robots").symlink_to(ROOT / "robots")
    started, *lines = re.findall(r"^    dxlrun (.+)$", PAGE, re.MULTILINE)
    assert started == "robots/bioloid_torso.yaml"
    lines.remove("play wave bow --loop 3")  # of a keyframe_player, which the torso does not have: goals.txt
    verbs = {"list", "watch", "play", "stop", *GROUPS["Robots that run"]}
    assert {line.split()[0] for line in lines} == verbs - {"reboot", "take-over"}  # Protocol 2.0; network.md
    for line in lines:
        said = dxlrun(*shlex.split(line))
        assert (said.code, said.err) == (0, ""), (line, said)
    assert said.out == "bioloid_torso has ended\n"
    assert running() == ()
    code, out, _ = run.finish()
    assert code in {0, 1}, out  # 1: a busy machine let servos miss replies
    assert "bioloid_torso: " in out
