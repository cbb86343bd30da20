"""Goals and live parameters at the terminal, on a robot of which only the client's side is there."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace
from tests.kit.answers import read_answer, result_of

from dxlrun.cli.steering import goals, parameters, play, steer
from dxlrun.errors import DxlrunError, GoalTimeout, Refused
from dxlrun.remote.client import Executed, RemoteGoal
from dxlrun.remote.requests.replies import GoalState, Parameter

Dxlrun = Callable[..., Any]
RUNNING = GoalState(3, "arm", "trajectory", "anna", "running", 0.5, 0.01, "")
REACHED = replace(RUNNING, status="reached", progress=1.0, ended=1.5)
MISSED = replace(RUNNING, status="missed", text="elbow is 0.1 off", joint="elbow", error=0.1, ended=2.0)


class Robot:
    """A robot whose goals go through the states of a script; `requests` is what was sent."""

    name = "torso"

    def __init__(self) -> None:
        self.script: dict[int, list[GoalState | BaseException]] = {}
        self.requests: list[tuple[Any, ...]] = []
        self.refusals: dict[int, Refused] = {}
        self.goal: int | None = 3
        self.file = Path("/nowhere/torso.yaml")
        self.interrupted: dict[int, list[GoalState | BaseException]] | None = None
        """Goals that begin while Ctrl-C comes before the answer."""

    def __enter__(self) -> Robot:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def send(
        self,
        controller: str,
        kind: str,
        command: Any,
        *,
        units: bool = False,
        seconds: float | None = None,
        goal: bool = False,
    ) -> Executed:
        self.requests.append(("send", controller, kind, command, seconds))
        self.begin()
        goals = () if self.goal is None else (RemoteGoal(self, self.goal),)  # type: ignore[arg-type]
        return Executed(7, goals)

    def play(self, motion: Path, speed: float) -> Executed:
        self.requests.append(("play", str(motion), speed))
        self.begin()
        if 0 in self.refusals:
            raise self.refusals[0]
        return Executed(7, (RemoteGoal(self, 3), RemoteGoal(self, 4)))  # type: ignore[arg-type]

    def info(self) -> dict[str, Any]:
        joints = {"arm": ("shoulder", "elbow"), "leg": ("hip", "knee", "ankle", "toe"), "pages": ("hip",)}
        motions = {"pages": {"walk": 2.0, "bow": 1.25}}
        return {
            "file": str(self.file),
            "groups": {},
            "controllers": [
                {"name": name, "joints": moved, "motions": motions.get(name, {})}
                for name, moved in joints.items()
            ],
        }

    def begin(self) -> None:
        if self.interrupted is not None:
            self.script |= self.interrupted
            raise KeyboardInterrupt

    def goals(self) -> list[GoalState]:
        return [
            state for states in self.script.values() for state in states[:1] if isinstance(state, GoalState)
        ]

    def goal_state(self, number: int, wait: float = 0.0) -> GoalState:
        states = self.script[number]
        state = states.pop(0) if len(states) > 1 else states[0]
        if isinstance(state, BaseException):
            raise state
        return state

    def wait(self, number: int, timeout: float) -> GoalState:
        self.requests.append(("wait", number))
        for _ in range(10):
            if (state := self.goal_state(number)).status != "running":
                return state
        raise GoalTimeout(f"goal {number} of arm has not ended within 10 s")

    def cancel(self, goal: int | str) -> Executed:
        self.requests.append(("cancel", goal))
        if goal in self.refusals:
            raise self.refusals[goal]  # type: ignore[index]
        return Executed(8)

    def parameter_table(self, controller: str) -> tuple[Parameter, ...]:
        return (
            Parameter("gains.p", 1.0, True, "at least 0"),
            Parameter("speed", "0.3490658503988659 rad/s", True),
            Parameter("timeout", "5000000 ns", False),
            Parameter("settle", "0 ns", False),
            Parameter("joints", ["a", "b"], False),
            Parameter("careful", False, True),
        )

    def set_parameters(self, controller: str, values: Any) -> dict[str, tuple[object, object]]:
        self.requests.append(("parameters", controller, values))
        return {name: (1.0, value) for name, value in values.items()}


@pytest.fixture
def robot(monkeypatch: pytest.MonkeyPatch) -> Robot:
    one = Robot()
    for room in (goals, parameters, play, steer):
        monkeypatch.setattr(room, "connect_robot", lambda name, verb: one)
    return one


SEND = ("send", "arm", "trajectory", "points=[]")


def test_send_reports_the_number_of_the_goal(dxlrun: Dxlrun, robot: Robot) -> None:
    assert dxlrun(*SEND) == (0, "torso: arm accepted trajectory as goal 3\n", "")
    assert result_of(dxlrun(*SEND, "--json").out) == {"robot": "torso", "cycle": 7, "goal": 3}


def test_send_waits_for_the_result(dxlrun: Dxlrun, robot: Robot) -> None:
    robot.script = {3: [RUNNING, RUNNING, REACHED]}
    assert dxlrun(*SEND, "--wait") == (0, "torso: goal 3 of arm reached after 1.50 s\n", "")
    robot.script = {3: [RUNNING, MISSED]}
    said = dxlrun(*SEND, "--wait")
    assert said == (1, "", "dxlrun: goal 3 of arm missed after 2.00 s: elbow is 0.1 off\n")


def test_the_result_is_json_for_programs(dxlrun: Dxlrun, robot: Robot) -> None:
    robot.script = {3: [RUNNING, MISSED]}
    said = dxlrun(*SEND, "--wait", "--json")
    answer = read_answer(said.out)
    assert (said.code, said.err, answer.ok) == (1, "", False)
    assert answer.errors[0].what.startswith("goal 3 of arm missed")
    found = answer.result
    assert (found["goal"], found["status"], found["joint"]) == (3, "missed", "elbow")


@pytest.mark.parametrize("status", ["aborted", "cancelled", "preempted"])
def test_all_other_results_are_failures(dxlrun: Dxlrun, robot: Robot, status: str) -> None:
    robot.script = {3: [replace(MISSED, status=status, text="")]}
    assert dxlrun(*SEND, "--wait") == (1, "", f"dxlrun: goal 3 of arm {status} after 2.00 s\n")


def test_ctrl_c_cancels_the_goal_and_waits_until_the_joints_rest(dxlrun: Dxlrun, robot: Robot) -> None:
    robot.script = {3: [RUNNING, KeyboardInterrupt(), RUNNING, replace(REACHED, status="cancelled")]}
    said = dxlrun(*SEND, "--wait")
    assert said.code == 130
    assert said.errors == ["dxlrun: goal 3 of arm cancelled after 1.50 s", "interrupted"]
    assert robot.requests[1:] == [("cancel", 3), ("wait", 3)]


@pytest.mark.parametrize("verb", ["send", "play"])
def test_ctrl_c_before_the_answer_cancels_the_goals_that_have_begun_and_no_others(
    dxlrun: Dxlrun, robot: Robot, tmp_path: Path, verb: str
) -> None:
    ended = replace(REACHED, status="cancelled")
    own = replace(RUNNING, number=3, origin=f"dxlrun {verb}: wave.yaml")
    robot.script = {2: [replace(own, number=2)]}
    robot.interrupted = {
        3: [own, replace(ended, number=3)],
        4: [replace(own, number=4, origin="anna")],
        5: [replace(own, number=5), replace(ended, number=5)],
    }
    (tmp_path / "wave.yaml").write_text("name: wave")
    words = [*SEND, "--wait"] if verb == "send" else ["play", str(tmp_path / "wave.yaml")]
    said = dxlrun(*words)
    assert said.code == 130
    assert [one for one in robot.requests if one[0] == "cancel"] == [("cancel", 3), ("cancel", 5)]
    assert "goal 3 of arm cancelled" in said.err


def test_ctrl_c_before_the_answer_cancels_nothing_where_the_goal_is_not_waited_for(
    dxlrun: Dxlrun, robot: Robot
) -> None:
    robot.interrupted = {3: [replace(RUNNING, origin="dxlrun send")]}
    assert dxlrun(*SEND).code == 130
    assert len(robot.requests) == 1


def test_ctrl_c_of_a_goal_that_has_ended_meanwhile_has_its_result(dxlrun: Dxlrun, robot: Robot) -> None:
    robot.script = {3: [RUNNING, KeyboardInterrupt(), REACHED]}
    robot.refusals = {3: Refused("goal 3 has ended already: reached", code="goal_ended")}
    said = dxlrun(*SEND, "--wait")
    assert (said.code, said.errors) == (130, ["dxlrun: goal 3 of arm reached after 1.50 s", "interrupted"])


def test_joints_that_do_not_come_to_rest_are_reported(dxlrun: Dxlrun, robot: Robot) -> None:
    robot.script = {3: [RUNNING, KeyboardInterrupt(), RUNNING]}
    said = dxlrun(*SEND, "--wait")
    assert (said.code, said.errors[0]) == (130, "dxlrun: goal 3 of arm has not ended within 10 s")


def test_a_run_that_ends_meanwhile_is_one_sentence(dxlrun: Dxlrun, robot: Robot) -> None:
    robot.script = {3: [RUNNING, DxlrunError("torso no longer answers: closed")]}
    assert dxlrun(*SEND, "--wait") == (1, "", "dxlrun: torso no longer answers: closed\n")


def test_what_is_no_goal_cannot_be_waited_for(dxlrun: Dxlrun, robot: Robot) -> None:
    robot.goal = None
    said = dxlrun(*SEND, "--wait")
    assert (said.code, said.errors) == (
        1,
        ["dxlrun: arm accepted trajectory, but this command has no end to wait for; omit --wait"],
    )


def test_a_time_is_sent_for_joints_by_name(dxlrun: Dxlrun, robot: Robot) -> None:
    assert dxlrun("send", "arm", "position", "elbow=20deg", "--in", "500ms").code == 0
    assert robot.requests == [("send", "arm", "position", {"elbow": "20deg"}, 0.5)]
    assert dxlrun("send", "arm", "position", "elbow=20deg", "--in", "2").code == 0
    assert robot.requests[-1][-1] == 2.0
    said = dxlrun("send", "arm", "position", "elbow=20deg", "--in", "2m")
    assert (said.code, said.err.startswith("dxlrun: --in: '2m' has the wrong unit m")) == (2, True), said


def test_cancel_takes_a_number_a_controller_or_all(dxlrun: Dxlrun, robot: Robot) -> None:
    robot.script = {3: [RUNNING], 4: [replace(RUNNING, number=4, controller="leg")], 2: [REACHED]}
    assert dxlrun("cancel") == (0, "torso: goals 3, 4 cancelled\n", "")
    assert dxlrun("cancel", "leg") == (0, "torso: goal 4 cancelled\n", "")
    assert dxlrun("cancel", "3").out == "torso: goal 3 cancelled\n"
    assert result_of(dxlrun("cancel", "--json").out)["goals"] == [3, 4]
    robot.script = {2: [REACHED]}
    assert dxlrun("cancel").out == "torso: no goal runs\n"
    robot.refusals = {2: Refused("goal 2 has ended already: reached", code="goal_ended")}
    assert dxlrun("cancel", "2") == (1, "", "dxlrun: goal 2 has ended already: reached\n")


def test_cancel_waits_for_rest(dxlrun: Dxlrun, robot: Robot) -> None:
    robot.script = {3: [RUNNING, RUNNING, REACHED]}
    assert dxlrun("cancel", "arm", "--wait").code == 0
    assert robot.requests == [("cancel", 3), ("wait", 3)]


def test_of_all_goals_one_that_has_ended_meanwhile_is_no_error(dxlrun: Dxlrun, robot: Robot) -> None:
    robot.script = {3: [RUNNING], 4: [replace(RUNNING, number=4, controller="leg")]}
    robot.refusals = {3: Refused("ended", code="goal_ended")}
    assert dxlrun("cancel") == (0, "torso: goal 4 cancelled\n", "")


def test_parameters_are_a_table(dxlrun: Dxlrun, robot: Robot) -> None:
    said = dxlrun("parameters", "arm")
    assert [line.split() for line in said.out.splitlines()[2:]] == [
        ["gains.p", "1", "live", "at", "least", "0"],
        ["speed", "0.349066", "rad/s", "live"],
        ["timeout", "5", "ms", "fixed"],
        ["settle", "0", "s", "fixed"],
        ["joints", "[a,", "b]", "fixed"],
        ["careful", "false", "live"],
    ]
    assert result_of(dxlrun("parameters", "arm", "--json").out)["parameters"][0]["name"] == "gains.p"


def test_parameters_are_changed_together(dxlrun: Dxlrun, robot: Robot) -> None:
    said = dxlrun("parameters", "arm", "gains.p=4.0", "speed=20 deg/s", "careful=true")
    assert said.out.splitlines() == [
        "torso: arm gains.p: 1 -> 4",
        "torso: arm speed: 1 -> 20 deg/s",
        "torso: arm careful: 1 -> true",
    ]
    assert robot.requests == [("parameters", "arm", {"gains.p": 4.0, "speed": "20 deg/s", "careful": True})]


# Motions


@pytest.fixture
def wave(tmp_path: Path) -> Path:
    file = tmp_path / "wave.yaml"
    file.write_text("name: wave\n")
    return file


def test_play_follows_all_goals(dxlrun: Dxlrun, robot: Robot, wave: Path) -> None:
    leg = replace(REACHED, number=4, controller="leg")
    robot.script = {3: [RUNNING, RUNNING, REACHED], 4: [replace(leg, status="running"), leg]}
    assert dxlrun("play", wave, "--speed", "0.5") == (
        0,
        f"torso: {wave} (shoulder, elbow): goal 3 of arm reached after 1.50 s\n"
        f"torso: {wave} (hip, knee, ankle ...): goal 4 of leg reached after 1.50 s\n",
        "",
    )
    assert robot.requests == [("play", str(wave), 0.5)]


def test_play_fails_when_one_of_its_goals_does(dxlrun: Dxlrun, robot: Robot, wave: Path) -> None:
    robot.script = {3: [REACHED], 4: [replace(MISSED, number=4, controller="leg")]}
    said = dxlrun("play", wave, "--json")
    found = read_answer(said.out).result
    assert said.code == 1
    assert [(goal["goal"], goal["status"]) for goal in found["goals"]] == [(3, "reached"), (4, "missed")]


def test_play_without_waiting_reports_the_numbers(dxlrun: Dxlrun, robot: Robot, wave: Path) -> None:
    assert dxlrun("play", wave, "--no-wait").out == f"torso: plays {wave} as goals 3, 4\n"
    assert result_of(dxlrun("play", wave, "--no-wait", "--json").out)["goals"] == [3, 4]


def test_ctrl_c_cancels_all_goals_of_a_motion(dxlrun: Dxlrun, robot: Robot, wave: Path) -> None:
    stopped = replace(REACHED, status="cancelled")
    robot.script = {
        3: [RUNNING, KeyboardInterrupt(), stopped],
        4: [replace(RUNNING, number=4), replace(stopped, number=4)],
    }
    assert dxlrun("play", wave).code == 130
    assert robot.requests[1:3] == [("cancel", 3), ("cancel", 4)]


def test_mistakes_of_a_motion_have_their_places(dxlrun: Dxlrun, robot: Robot, wave: Path) -> None:
    fields = {"places": ["3:17", "4:1"], "problems": ["no leg", "no arm"], "fixes": ["known: arm", "add one"]}
    robot.refusals = {0: Refused("all", code="wrong_motion", fields=fields, wrong_input=True)}
    said = dxlrun("play", wave)
    assert (said.code, said.errors) == (
        2,
        [f"{wave}:3:17: no leg; known: arm", f"{wave}:4:1: no arm; add one"],
    )
    said = dxlrun("play", wave.parent / "wive.yaml")
    assert (said.code, "motion file" in said.err) == (2, True)


def test_a_motion_is_played_by_its_name(dxlrun: Dxlrun, robot: Robot, wave: Path) -> None:
    robot.script = {3: [RUNNING, replace(REACHED, controller="pages")]}
    assert dxlrun("play", "walk", "--speed", "0.5") == (
        0,
        "torso: walk (hip): goal 3 of pages reached after 1.50 s\n",
        "",
    )
    assert robot.requests == [("send", "pages", "play", {"motion": "walk", "speed": 0.5}, None)]
    robot.file = wave.parent / "torso.yaml"
    robot.requests.clear()
    robot.script = {3: [REACHED], 4: [replace(REACHED, number=4, controller="leg")]}
    assert dxlrun("play", "wave").out.startswith("torso: wave (shoulder, elbow): goal 3 of arm reached")
    assert robot.requests == [("play", str(wave), 1.0)]
    (wave.parent / "motions").mkdir()
    (wave.parent / "motions" / "bow.yaml").write_text("name: bow\n")
    said = dxlrun("play", "bow")
    assert said.code == 2
    assert said.err == (
        f"dxlrun: 2 motions have the name bow; choose one: `dxlrun play {wave.parent}/motions/bow.yaml`, "
        "`dxlrun send pages play motion=bow`\n"
    )
    said = dxlrun("play", "wolk")
    assert (
        said.code,
        "has no motion wolk, and no file has this name; did you mean walk?" in said.err,
    ) == (2, True)
    (wave.parent / "torso_two.yaml").write_text("name: torso_two\njoints: {}\n")  # a robot is no motion
    for folder in (wave.parent, wave.parent / "motions"):
        (folder / "wave.yaml").write_text("name: wave\nmotions: []\n")
    assert dxlrun("play", "dance").err.endswith("and no file has this name; known: bow, walk, wave\n")


def test_motions_are_played_one_after_the_other_until_one_does_not_reach_its_end(
    dxlrun: Dxlrun, robot: Robot
) -> None:
    reached = replace(REACHED, controller="pages")
    robot.script = {3: [reached, reached, reached, reached, MISSED]}
    assert dxlrun("play", "walk", "bow", "--loop", "3").code == 1
    assert [each[3]["motion"] for each in robot.requests] == ["walk", "bow", "walk", "bow", "walk"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ((), "name a motion; `dxlrun play --list` shows those of the robot"),
        (("walk", "--list"), "--list takes no motions; omit walk"),
        (("walk", "--loop", "0"), "--loop 0 is not a number of repetitions; give 1 to 10000"),
        (("walk", "bow", "--no-wait"), "--no-wait can start only one motion; omit --no-wait"),
        (("walk", "--loop", "2", "--no-wait"), "--no-wait can start only one motion; omit --no-wait"),
        (("walk", "nowhere/wave.yaml"), "motion file nowhere/wave.yaml not found; check the path"),
        (("walk", "wolk"), "has no motion wolk, and no file has this name; did you mean walk?"),
    ],
)
def test_nothing_is_played_of_what_cannot_be_played_whole(
    dxlrun: Dxlrun, robot: Robot, words: tuple[str, ...], said: str
) -> None:
    refused = dxlrun("play", *words)
    assert refused.code == 2
    assert said in refused.err
    assert robot.requests == []


def test_a_later_motion_with_a_mistake_is_told_before_the_first_begins(
    dxlrun: Dxlrun, robot: Robot, wave: Path
) -> None:
    wave.write_text("name: wave\nmotions: 3\n")
    refused = dxlrun("play", "walk", wave)
    assert (refused.code, f"{wave}:2:" in refused.err) == (2, True)
    assert robot.requests == []


def test_the_list_has_what_can_be_played_with_its_length(dxlrun: Dxlrun, robot: Robot, wave: Path) -> None:
    robot.file = wave.parent / "torso.yaml"
    joints = "{shoulder: {position: 20 deg}}"
    points = f"points: [{{time: 2 s, joints: {joints}}}]"
    wave.write_text(f"name: wave\nmotions:\n- controller: arm\n  start: 1 s\n  {points}\n")
    (wave.parent / "broken.yaml").write_text("name: broken\nmotions: 3\n")
    other = wave.read_text().replace("controller: arm", "controller: wing")
    (wave.parent / "flap.yaml").write_text(other)  # for another robot
    found = result_of(dxlrun("play", "--list", "--json").out)
    assert [(each["motion"], each["joints"], each["seconds"]) for each in found] == [
        ("bow", ["hip"], 1.25),
        ("broken", [], None),
        ("walk", ["hip"], 2.0),
        ("wave", ["shoulder"], 3.0),
    ]
    lines = dxlrun("play", "--list").out.splitlines()
    assert [line.split()[:4] for line in lines if "hip" in line] == [
        ["bow", "pages", "hip", "1.25"],
        ["walk", "pages", "hip", "2.00"],
    ]
