"""Goals and live parameters at the terminal: the cases of goals.txt, on the client's side of a robot."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace
from tests.kit.answers import result_of
from tests.kit.commands import Case, Dxlrun, Stage, cases, play

from dxlrun.cli.steering import goals, parameters, steer
from dxlrun.cli.steering import play as play_room
from dxlrun.errors import DxlrunError, Refused
from dxlrun.remote.client import Executed, RemoteGoal
from dxlrun.remote.requests.replies import GoalState, Parameter, TopicState

ENDS: dict[str, dict[str, Any]] = {
    "running": {},
    "reached": {"progress": 1.0, "ended": 1.5},
    "missed": {"text": "elbow is 0.1 off", "joint": "elbow", "error": 0.1, "ended": 2.0},
}
JOINTS = {"arm": ("shoulder", "elbow"), "leg": ("hip", "knee", "ankle", "toe"), "pages": ("hip",)}


def state(number: int, controller: str, origin: str, word: str) -> GoalState | BaseException:
    """Return a state of a goal, or what comes instead of it."""
    if word == "Ctrl-C":
        return KeyboardInterrupt()
    if word == "gone":
        return DxlrunError("torso no longer answers: closed")
    word, _, progress = word.partition(" ")
    running = GoalState(number, controller, "trajectory", origin, word, float(progress or 0.5), 0.01, "")
    return replace(running, **ENDS.get(word, {"ended": 2.0}))


class Robot:
    """A robot whose goals go through the states of a script."""

    name = "torso"

    def __init__(self) -> None:
        self.script: dict[int, list[GoalState | BaseException]] = {}
        self.begun: dict[int, list[GoalState | BaseException]] = {}
        """Goals that begin while Ctrl-C comes before the answer"""
        self.requests: list[str] = []
        self.drawn: list[str] = []
        """Texts and progress of the progress bar"""
        self.ended: set[int] = set()
        self.cancelled_once: set[int] = set()
        self.mistakes: list[tuple[str, str, str]] = []
        self.goals_begin = True
        self.file = Path("/nowhere/torso.yaml")
        self.omitted: list[str] = []
        self.paused = False
        self.answers: list[str] = []

    def __enter__(self) -> Robot:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def goal(self, line: str) -> None:
        self._script(self.script, line)

    def begin(self, line: str) -> None:
        self._script(self.begun, line)

    @staticmethod
    def _script(into: dict[int, list[GoalState | BaseException]], line: str) -> None:
        number, controller, origin, words = re.fullmatch(r"(\d+) of (\w+)(?: by (.+))?: (.+)", line).groups()  # type: ignore[union-attr]
        into[int(number)] = [
            state(int(number), controller, origin or "anna", word) for word in words.split(", ")
        ]

    def refuse(self, line: str) -> None:
        what, _, rest = line.partition(" ")
        if what == "cancel":
            self.ended.add(int(rest))
        elif what == "again":
            self.cancelled_once.add(int(rest))
        else:
            place, _, sentence = rest.partition(" ")
            self.mistakes.append((place, *sentence.split("; ")))  # type: ignore[arg-type]

    @contextmanager
    def progress_bar(self, *, hidden: bool) -> Iterator[Callable[[str, float], None]]:
        yield lambda text, share: self.drawn.append(f"{text} {share:g}")

    def _executed(self, *numbers: int) -> Executed:
        if self.begun:
            self.script |= self.begun
            raise KeyboardInterrupt
        return Executed(7, tuple(RemoteGoal(self, number) for number in numbers))  # type: ignore[arg-type]

    def send(
        self, controller: str, kind: str, command: Any, *, seconds: float | None = None, **_: Any
    ) -> Executed:
        self.requests.append(f"send {controller} {kind} {command} {seconds}")
        return self._executed(*[3] * self.goals_begin)

    def play(self, motion: Path, speed: float) -> Executed:
        self.requests.append(f"play {motion} {speed}")
        if self.mistakes:
            places, problems, fixes = map(list, zip(*self.mistakes, strict=True))
            fields = {"places": places, "problems": problems, "fixes": fixes}
            raise Refused("all", code="wrong_motion", fields=fields, wrong_input=True)
        return self._executed(3, 4)

    def info(self) -> dict[str, Any]:
        motions = {"pages": {"walk": 2.0, "bow": 1.25}}
        controllers = [
            {"name": name, "joints": moved, "motions": motions.get(name, {})}
            for name, moved in JOINTS.items()
        ]
        omitted = {"omitted": self.omitted} if self.omitted else {}
        facts = {"file": str(self.file), "groups": {}, "controllers": controllers, "paused": self.paused}
        return facts | omitted

    def topics(self) -> list[TopicState]:
        return [TopicState(name, "", (), 0, None) for name in self.answers]

    def goals(self) -> list[GoalState]:
        return [states[0] for states in self.script.values() if isinstance(states[0], GoalState)]

    def goal_state(self, number: int, wait: float = 0.0) -> GoalState:
        states = self.script[number]
        found = states.pop(0) if len(states) > 1 else states[0]
        if isinstance(found, BaseException):
            raise found
        return found

    def wait(self, number: int) -> GoalState:
        self.requests.append(f"wait {number}")
        for _ in range(10):
            if (found := self.goal_state(number)).status != "running":
                return found
        raise AssertionError("this waits for ever")

    def cancel(self, goal: int) -> Executed:
        if goal in self.ended:
            raise Refused(f"goal {goal} has ended already: reached", code="goal_ended")
        if f"cancel {goal}" in self.requests and goal in self.cancelled_once:
            raise Refused(f"goal {goal} is being cancelled already", code="cancelled_already")
        self.requests.append(f"cancel {goal}")
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
        self.requests.append(f"parameters {controller} {values}")
        return {name: (1.0, value) for name, value in values.items()}


@pytest.fixture
def robot(reader: Path, monkeypatch: pytest.MonkeyPatch) -> Robot:
    one = Robot()
    for room in (goals, parameters, play_room, steer):
        monkeypatch.setattr(room, "connect_robot", lambda name, verb: one)
    monkeypatch.setattr(goals, "progress_bar", one.progress_bar)
    return one


@pytest.mark.parametrize("case", cases("goals.txt"))
def test_goal_at_the_terminal(dxlrun: Dxlrun, robot: Robot, reader: Path, case: Case) -> None:
    stage = Stage()
    stage.given = {
        "goal": robot.goal,
        "begun": robot.begin,
        "refused": robot.refuse,
        "omits": robot.omitted.append,
        "topic": robot.answers.append,
        "paused": lambda _: setattr(robot, "paused", True),
        "no": lambda _: setattr(robot, "goals_begin", False),
        "at": lambda _: setattr(robot, "file", reader / "torso.yaml"),
    }
    stage.asked = {"sent": lambda: robot.requests or ["nothing"], "drawn": lambda: robot.drawn}
    play(case, dxlrun, stage)


def test_list_has_what_can_be_played_with_its_length(dxlrun: Dxlrun, robot: Robot, reader: Path) -> None:
    robot.file = reader / "torso.yaml"
    (reader / "torso_two.yaml").write_text("name: torso_two\njoints: {}\n")  # a robot is not a motion
    points = "points: [{time: 2 s, joints: {shoulder: {position: 20 deg}}}]"
    wave = f"name: wave\nmotions:\n- controller: arm\n  start: 1 s\n  {points}\n"
    (reader / "wave.yaml").write_text(wave)
    (reader / "broken.yaml").write_text("name: broken\nmotions: 3\n")
    (reader / "flap.yaml").write_text(
        wave.replace("controller: arm", "controller: wing")
    )  # for another robot
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
