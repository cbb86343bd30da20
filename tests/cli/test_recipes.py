"""The programs of docs/how-to/recipes.md and the notebook, on simulated robots in this process."""

import builtins
import csv
import json
import re
import runpy
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.kit.hands import LiveRobot
from tests.kit.pages import page_text

import dxlrun as face
from dxlrun import RemoteRobot, connect
from dxlrun.remote.live.listening import MessageIterator
from dxlrun.testing import plan_of
from dxlrun.tooling.runs import VirtualLink
from dxlsim.faults.fault import parse_fault
from dxlsim.faults.script import FaultScript

pytestmark = pytest.mark.long

ROOT = Path(__file__).parents[2]
PAGE = page_text("recipes.md")
PROGRAMS = dict(
    re.findall(r"^## ([^\n]+)$(?:(?!^## ).)*?^```python\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)
)
NOTEBOOK = json.loads((ROOT / "docs" / "examples" / "torso.ipynb").read_text())
CELLS = ["".join(cell["source"]) for cell in NOTEBOOK["cells"] if cell["cell_type"] == "code"]


Run = Callable[[str], dict[str, Any]]


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Run:
    """Run a program as `python` does, in a directory of its own; return its names."""
    monkeypatch.chdir(tmp_path)

    def run(program: str) -> dict[str, Any]:
        path = tmp_path / "recipe.py"
        path.write_text(program)
        return runpy.run_path(str(path))

    return run


def test_the_programs_are_short_and_all_of_them_are_run() -> None:
    assert set(PROGRAMS) == {"Teach and play", "Walk with one arm limp", "Log a value", "React to an event"}
    assert max(len(program.splitlines()) for program in PROGRAMS.values()) <= 30
    assert sum(bool(line) for cell in CELLS for line in cell.splitlines()) <= 11


# On virtual time


class Virtual:
    """A robot on virtual time, which is what `connect` finds."""

    def __init__(self, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
        self.link = VirtualLink(plan_of(ROOT / "robots" / f"{name}.yaml"))
        self.robot = RemoteRobot(name, self.link)
        self.faults = FaultScript([])
        self.faults.attach(self.link.simulated.buses)
        monkeypatch.setattr(face, "connect", self.connect)

    def connect(self, name: str, client: str) -> RemoteRobot:
        assert (name, bool(client)) == (self.robot.name, True)
        return self.robot

    def turn(self, **degrees: float) -> None:
        """Turn servos by hand, by ID (`id5=20`), and wait until they are there."""
        for name, by in degrees.items():
            fault = parse_fault(f"turn servo={name[2:]} by={by}deg for=200ms")
            self.faults.add(fault, self.link.simulated.clock.now_ns())
        for _ in range(15):
            self.link.run_cycle()


def test_teach_and_play(
    run: Run, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    virtual = Virtual("bioloid_torso", monkeypatch)
    asked: list[str] = []

    def hand(question: str) -> str:
        asked.append(question)
        if question.startswith("Bring"):
            virtual.turn(id1=10, id5=-12)
        return ""

    monkeypatch.setattr(builtins, "input", hand)
    poses = run(PROGRAMS["Teach and play"])["poses"]
    assert len(asked) == 4
    assert capsys.readouterr().out.startswith("reached")
    for before, after in pairwise(poses):
        assert [b - a for a, b in zip(before, after, strict=True)] == pytest.approx(
            [-0.175, 0, 0.209], abs=0.02
        )
    virtual.robot.close()


def test_walk_with_one_arm_limp(
    run: Run, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    virtual = Virtual("stand_up", monkeypatch)
    run(PROGRAMS["Walk with one arm limp"])
    assert "reached" in capsys.readouterr().out
    cycles, _ = virtual.link.new()
    swing = np.degrees(np.ptp(cycles["position"][:, 1:], axis=0))
    assert swing[0] < 1.0
    assert swing[1:].min() > 30.0
    virtual.robot.close()


# In real time


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveRobot]:
    directory = tmp_path_factory.mktemp("live")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_RUNTIME_DIR", str(directory))
        with LiveRobot(directory, ROOT / "robots" / "bioloid_torso.yaml") as live:
            yield live


@pytest.fixture
def live(shared: LiveRobot) -> LiveRobot:
    shared.restart()
    return shared


def test_log_a_value(run: Run, live: LiveRobot, tmp_path: Path) -> None:
    run(PROGRAMS["Log a value"].replace("50)", "5)"))
    with (tmp_path / "elbow.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 5
    times = [int(row["time_ns"]) for row in rows]
    assert times == sorted(set(times))
    assert {float(row["temperature_C"]) for row in rows} <= set(range(20, 50))
    with connect() as torso:
        there = torso.states().joint("left_elbow_joint")["position"]
    assert float(rows[-1]["position_rad"]) == pytest.approx(there, abs=0.01)


def test_the_notebook_moves_the_torso_and_draws_it(run: Run, live: LiveRobot) -> None:
    import matplotlib as mpl
    from matplotlib import pyplot as plt

    mpl.use("Agg")
    try:
        ran = run("\n".join(CELLS))
        lines = {str(line.get_label()): np.asarray(line.get_xydata()) for line in plt.gca().get_lines()}
    finally:
        plt.close("all")
    seen = ran["seen"]  # of 100 cycles: a busy machine skips some, and reads others after the end of the goal
    assert len(lines) == 3
    assert len(seen) > 1
    for joint, drawn in lines.items():
        at = seen[0].joints.index(joint)
        assert drawn[:, 1].tolist() == [one.message["position"][at] for one in seen]
        assert drawn[:, 0] * 1e9 == pytest.approx([one.time_ns - seen[0].time_ns for one in seen])
    with connect() as torso:
        assert torso.wait(ran["arm"].number).status == "reached"
        assert abs(torso.states().joint("left_elbow_joint")["position"]) < 0.1


def test_react_to_an_event(
    run: Run, live: LiveRobot, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The last one: it halts the torso."""
    listen = RemoteRobot.listen

    def silenced(robot: RemoteRobot, *topics: str) -> MessageIterator:
        heard = listen(robot, *topics)
        live.inject("silence servo=21 for=1s")
        return heard

    monkeypatch.setattr(RemoteRobot, "listen", silenced)
    run(PROGRAMS["React to an event"])
    out = capsys.readouterr().out
    assert re.search(r"servo_lost \w+ \(ID \d+ on bus main\)", out)  # on a busy machine another one
    assert "halted in cycle" in out
    with connect() as torso:
        active = {one["name"] for one in torso.info()["controllers"] if one["active"]}
    assert active == {"joint_state_broadcaster"}
