"""docs/examples/stand_up.py: robots/stand_up.yaml, pushed as in recipes.md, gets up and walks again."""

import math
import re
import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.kit.pages import page_text
from tests.kit.wire import all_writes

from dxlrun.channels.event_records import EventCode
from dxlrun.cli.steering.written import WrittenEntry
from dxlrun.log.log_reader import Log, read_log
from dxlrun.remote.client import RemoteGoal, RemoteRobot
from dxlrun.testing import plan_of
from dxlrun.tooling.runs import VirtualLink
from dxlsim.faults.fault import parse_fault
from dxlsim.faults.script import FaultScript

pytestmark = pytest.mark.long

ROOT = Path(__file__).parents[2]
PLAN = plan_of(ROOT / "robots" / "stand_up.yaml")
PUSHES = re.findall(r"^    dxlrun send (.+)$", page_text("recipes.md"), re.MULTILINE)
TORQUE_ENABLE = 64
"""e-Manual, X series"""
StandUp = runpy.run_path(str(ROOT / "docs" / "examples" / "stand_up.py"))["StandUp"]


class Stage:
    """The robot on virtual time, on which the program runs until it waits for something to happen."""

    def __init__(self, directory: Path) -> None:
        self.path = directory / "run.mcap"
        self.link = VirtualLink(PLAN, log=self.path)
        (self.bus,) = self.link.simulated.buses
        self.faults = FaultScript([])
        self.faults.attach([self.bus])
        self.robot = RemoteRobot(PLAN.robot, self.link)
        self.states = StandUp(self.robot).states()

    def until(self, state: str) -> list[str]:
        seen = []
        while not seen or seen[-1] != state:
            seen.append(next(self.states))
        return seen

    def push(self, line: str) -> None:
        """Do what a command line does."""
        controller, kind, *words = line.split()
        self.robot.send(controller, kind, WrittenEntry.from_words(words, None).data)

    def fault(self, text: str) -> None:
        self.faults.add(parse_fault(text), self.link.simulated.clock.now_ns())

    def cycles(self) -> Any:
        """Return the cycles since the last call."""
        return self.link.new()[0]

    def torque_writes(self) -> list[tuple[int, int]]:
        """Return what was written into Torque Enables, by the ledger: ID and value."""
        written = all_writes(self.bus.ledger.entries, PLAN.buses[0])
        return [(servo, data[0]) for _, servo, address, data in written if address == TORQUE_ENABLE]

    def ended(self) -> Log:
        self.robot.close()
        return read_log(self.path)


@pytest.fixture
def stage(tmp_path: Path) -> Stage:
    return Stage(tmp_path)


def players(log: Log) -> list[str]:
    """Return which player had the limbs, one after the other."""
    names = [one.name for one in PLAN.loop.controllers]
    masks = log.cycles["active"] & sum(1 << names.index(name) for name in ("walk", "curl", "get_up"))
    changes = masks[np.flatnonzero(np.diff(masks, prepend=0))].tolist()
    return [names[mask.bit_length() - 1] if mask else "none" for mask in changes]


def test_it_falls_to_both_sides_and_gets_up_and_walks(stage: Stage) -> None:
    assert stage.until("walking") == ["walking"]
    arms = []
    for line in PUSHES:
        stage.push(line)
        assert stage.until("getting up") == ["lying", "getting up"]
        tilt, arm = stage.robot.states().position[:2]
        assert abs(math.degrees(tilt)) == pytest.approx(80, abs=2)
        assert math.degrees(arm) == pytest.approx(80, abs=2)  # curled up
        assert stage.until("walking") == ["walking"]
        arms.append(np.degrees(stage.cycles()["position"][:, 1]))
        assert stage.robot.states().position[0] == pytest.approx(0, abs=0.03)  # upright
    assert arms[0].max() == pytest.approx(120, abs=2)  # pushes off in front, and then behind
    assert arms[1].min() == pytest.approx(-120, abs=2)
    walking = stage.robot.send("walk", "play", {"motion": "walk"}).goal
    stage.robot.goal_state(walking.number, wait=1.0)
    steps = np.degrees(stage.cycles()["position"][-80:, 3:])
    assert np.ptp(steps, axis=0).min() > 30
    written = stage.torque_writes()
    log = stage.ended()
    assert players(log) == ["walk", "curl", "get_up", "walk", "curl", "get_up", "walk"]
    falls = [event.text for event in log.events if event.code == EventCode.TAKEOVER]
    assert [text.rpartition(" pitch ")[2] for text in falls] == ["42 deg", "-42 deg"]
    assert (1, 1) in written
    assert written == sorted(written, key=lambda one: one[1])  # on at the start, never off in between


def test_it_gives_up_and_becomes_limp_where_it_stays_down(stage: Stage) -> None:
    stage.until("walking")
    stage.push(PUSHES[0])
    stage.until("getting up")
    stage.fault("jam servo=1")
    assert stage.until("given up") == ["lying", "getting up"] * 2 + ["lying", "given up"]
    assert not any(servo.torque_on for servo in stage.bus.servos)
    assert players(stage.ended()) == ["walk"] + ["curl", "get_up"] * 3 + ["none"]


def test_a_refusal_makes_it_look_again_and_a_cancelled_walk_ends_it(
    stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    stage.until("walking")
    stage.robot.switch(deactivate=["walk"])  # as the reflex does between a look and a request
    assert stage.until("walking") == ["lying", "getting up", "walking"]  # it is upright: nothing is played
    wait = RemoteGoal.wait
    monkeypatch.setattr(RemoteGoal, "wait", lambda goal: goal.cancel() and wait(goal))
    assert stage.until("stopped") == ["stopped"]
    assert players(stage.ended()) == ["walk", "none", "curl", "walk"]
