"""A replay of chains has no difference, and names the reference that differs where there is one.

CI tries 8 random runs; `DXLRUN_CHAIN_RUNS=500 pytest tests/analysis/replay/test_chains.py` tries more.
"""

from __future__ import annotations

import os
import random
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from tests.kit.stories import Asked, Clients, ask, plugin_folder, replayed, send, switch

from dxlrun.channels.commands import Command
from dxlrun.channels.events import EventCode
from dxlrun.errors import InputError, LogError
from dxlrun.log.reader import read_log
from dxlrun.testing import simulated_robot
from dxlrun_analysis.replay import Setting, replay_log

RUNS = int(os.environ.get("DXLRUN_CHAIN_RUNS", "8"))
ROBOT = """\
name: chained
buses:
  main: {port: sim, protocol: 1.0, baud_rate: 1_000_000, return_delay_time: 100 us, adapter: {latency: 1 ms}}
loop: {rate: 50}
joints:
  pan: {bus: main, id: 3, model: AX-12A, reference: 150 deg, direction: 1}
  tilt: {bus: main, id: 7, model: AX-12A, reference: 150 deg, direction: -1}
  nod: {bus: main, id: 8, model: AX-12A, reference: 150 deg, direction: -1}
controllers:
  top: {type: law, joints: [nod, pan], into: middle, gain: 0.3, rate: 25, fallback: spare}
  base: {type: law, joints: [pan, tilt, nod], exports: [position, velocity], drives: true}
  beside: {type: law, joints: [tilt], into: base, gain: 0.2}
  middle: {type: law, joints: [pan, nod], into: base, exports: [position]}
  eye: {type: eye, reads: [base/pan/position, middle/nod/position, tilt/age, pan/position]}
  spare: {type: law, joints: [pan, nod], into: middle, gain: -0.1, active: false}
  alone: {type: law, joints: [pan, tilt, nod], drives: true, active: false}
"""
PLUGIN = '''\
"""A law that follows its references, and one whose topic depends on what it reads."""
from typing import Annotated

import numpy as np
from dxlrun import LIVE, CommandModel, Controller, Interfaces, Outcome, ParametersModel, hookimpl


class Move(CommandModel):
    to: float


class LawParameters(ParametersModel):
    joints: tuple[str, ...]
    exports: tuple[str, ...] = ()
    drives: bool = False
    gain: Annotated[float, LIVE] = 0.0


class Law(Controller[LawParameters]):
    Parameters = LawParameters
    Commands = {"move": Move}
    Goals = frozenset({"move"})
    goal = None

    @classmethod
    def interfaces(cls, parameters, joints):
        command = ("position", "velocity") if parameters.drives else ("position",)
        return Interfaces(parameters.joints, command, parameters.exports)

    @staticmethod
    def prepare(kind, command, parameters):
        return np.array([command.to])

    def on_goal(self, goal, data, time_ns):
        self.goal, self.to, self.ends_ns = goal, float(data[0]), time_ns + 200_000_000

    def on_cancel(self, goal, time_ns):
        self.goal = None
        goal.end(Outcome.CANCELLED)

    def on_activate(self, time_ns):
        self.goal = None
        self.held = self.context.states.position.copy()
        self.held[np.isnan(self.held)] = 0.0

    def update(self, time_ns, period_ns):
        if time_ns > 700_000_000 and self.parameters.gain == 0.3:
            raise RuntimeError("out of ideas")
        references, commands = self.context.references, self.context.commands
        if self.goal is not None:
            self.held += 0.05 * (self.to - self.held)
            self.goal.feedback(0.5)
            if time_ns >= self.ends_ns:
                self.goal = self.goal.end(Outcome.REACHED)
        self.held = self.held * 0.9 + 0.1 * self.parameters.gain * np.sin(time_ns * 1e-8)
        given = references.position * 0.99 + self.context.states.position * 0.01
        np.copyto(commands.position, np.where(np.isnan(references.position), self.held, given))
        if self.parameters.drives:
            commands.velocity[:] = 1.0 + abs(np.nan_to_num(references.position))


class EyeParameters(ParametersModel):
    reads: tuple[str, ...]


class Eye(Controller[EyeParameters]):
    Parameters = EyeParameters

    @classmethod
    def interfaces(cls, parameters, joints):
        return Interfaces((), (), (), parameters.reads)

    def update(self, time_ns, period_ns):
        if time_ns < 200_000_000:
            self.context.say(" ".join(map(float.hex, self.context.reads.tolist())))


@hookimpl
def dxlrun_contract():
    return 1


@hookimpl
def dxlrun_controllers():
    return {"law": Law, "eye": Eye}
'''


@pytest.fixture(scope="module")
def law(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return plugin_folder(tmp_path_factory.mktemp("law"), "law_plugin", PLUGIN, "law")


@pytest.fixture(autouse=True)
def _installed(law: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(law)


STORIES: Mapping[str, Asked] = {
    "a fallback": {},
    "switches": {
        5: [switch(["alone"], ["top", "middle", "beside", "base"])],
        9: [switch(["top"], ["alone"]), switch([], ["middle"])],
        15: [switch(["spare"], ["top"])],
        20: [switch(["beside"])],
        30: [switch(["top"], ["spare", "top"])],
    },
    "a restart": {10: [switch(["top"], ["top", "middle"])]},
}


@pytest.fixture(scope="module")
def logs() -> dict[str, Path]:
    """The logs of the stories that were told already."""
    return {}


@pytest.fixture
def story(
    law: Path, logs: dict[str, Path], tmp_path_factory: pytest.TempPathFactory
) -> Callable[[str], Path]:
    """Return the log of a story, which is run once."""

    def told(name: str) -> Path:
        if name not in logs:
            directory = tmp_path_factory.mktemp("chained")
            file, log = directory / "chained.yaml", directory / "run.mcap"
            file.write_text(ROBOT)
            robot = simulated_robot(file, duration_s=1.0, log=log)
            Clients(robot, STORIES[name])
            robot.run()
            logs[name] = log
        return logs[name]

    return told


def active(cycles: NDArray[np.void], row: int) -> set[str]:
    names = ("top", "base", "beside", "middle", "eye", "spare", "alone")
    return {name for bit, name in enumerate(names) if int(cycles["active"][row]) >> bit & 1}


@pytest.mark.parametrize("name", STORIES)
def test_a_run_of_chains(story: Callable[[str], Path], name: str) -> None:
    assert np.isfinite(replayed(story(name)).cycles["reference"]).any()


def test_the_stories_do_what_they_are_there_for(story: Callable[[str], Path]) -> None:
    log = read_log(story("switches"))
    assert log.header.references == (
        "base/pan/position",
        "base/tilt/position",
        "base/nod/position",
        "base/pan/velocity",
        "base/tilt/velocity",
        "base/nod/velocity",
        "middle/pan/position",
        "middle/nod/position",
    )
    chain = {"top", "base", "middle", "eye"}
    assert [active(log.cycles, row) for row in (4, 5, 9, 15, 20)] == [
        chain | {"beside"},
        {"alone", "eye"},
        chain,
        chain - {"top"} | {"spare"},
        chain - {"top"} | {"spare", "beside"},
    ]
    assert "middle is commanded by top" in str(
        [event.text for event in log.events if event.code == EventCode.COMMAND_REFUSED]
    )
    log = read_log(story("a fallback"))
    assert active(log.cycles, -1) == {"base", "beside", "middle", "eye", "spare"}


def test_what_was_read_without_a_claim_is_what_the_log_has(story: Callable[[str], Path]) -> None:
    log = read_log(story("a fallback"))
    said = [event.text for event in log.events if event.source == "eye" and " " in event.text]
    for row in range(1, 9):
        cycle = log.cycles[row]
        expected = [
            cycle["reference"][0],
            cycle["reference"][7],
            cycle["age_ns"][1] * 1e-9,
            cycle["position"][0],
        ]
        texts = [text for text in said if text.count("0x") == 4]
        assert [float.fromhex(word) for word in texts[row].split()] == pytest.approx(expected, rel=0, abs=0)


FLIPPED = [
    (7, 12, "top", "nod", "middle/nod/position"),
    (0, 30, "middle", "pan", "base/pan/position"),
    (1, 3, "beside", "tilt", "base/tilt/position"),
    (4, 8, None, "tilt", "base/tilt/velocity"),
]


@pytest.mark.parametrize("flipped", FLIPPED, ids=[one[-1] for one in FLIPPED])
def test_a_flipped_bit_of_a_reference_is_found_and_named(
    story: Callable[[str], Path],
    changed: Callable[..., Path],
    flipped: tuple[int, int, str | None, str, str],
) -> None:
    place, cycle, controller, joint, name = flipped

    def flip(content: Any) -> None:
        content.cycles["reference"].view(np.uint64)[cycle, place] ^= 1

    report = replay_log(changed(story("a fallback"), flip))
    assert report.different == 1
    first = report.first
    assert first is not None
    assert (first.cycle, first.controller, first.joint, first.what) == (
        cycle,
        controller,
        joint,
        f"reference {name}",
    )
    assert [(one.joint, one.references, one.commands, one.goals) for one in report.joints] == [
        (joint, 1, 0, 0)
    ]


def test_another_parameter_above_differs_first_in_its_references(story: Callable[[str], Path]) -> None:
    report = replay_log(story("a restart"), [Setting.parse("beside.gain=0.25")])
    assert report.first is not None
    assert (report.first.what, report.first.controller) == ("reference base/tilt/position", "beside")
    assert [one.joint for one in report.joints] == ["tilt"]
    assert report.joints[0].references >= report.joints[0].commands > 0


def test_a_parameter_that_changes_what_is_exported_is_refused(story: Callable[[str], Path]) -> None:
    with pytest.raises(InputError, match="base: the controller would export other references"):
        replay_log(story("a restart"), [Setting.parse("base.exports=[position]")])


def test_a_log_whose_plan_has_other_references_is_damaged(
    story: Callable[[str], Path], changed: Callable[..., Path]
) -> None:
    def other(content: Any) -> None:
        plan = msgspec.json.decode(content.attachments["plan.json"])
        plan["loop"]["controllers"][1]["reference"] = ["position"]
        content.attachments["plan.json"] = msgspec.json.encode(plan)

    with pytest.raises(LogError, match="the plan in the log has other references than its cycles"):
        replay_log(changed(story("a restart"), other))


NAMES = ("top", "base", "beside", "middle", "eye", "spare", "alone")
INTO = {"top": {"middle"}, "spare": {"middle"}, "middle": {"base"}, "beside": {"base"}}


def random_commands(dice: random.Random) -> dict[int, list[Command]]:
    """Return what clients ask in a second: switches, goals, cancels, parameters, torque, rates, pauses."""
    asked: dict[int, list[Command]] = {}
    for _ in range(dice.randint(4, 16)):
        joints = dice.sample(("pan", "tilt", "nod"), dice.randint(1, 2))
        release = dice.random() < 0.7
        kind, data = dice.choice(
            [
                ("switch", {"activate": dice.sample(NAMES, dice.choice((0, 1, 1, 2))),
                            "deactivate": dice.sample(NAMES, dice.choice((0, 1, 2, 4)))}),
                ("switch", {"activate": [dice.choice(NAMES)], "deactivate": []}),
                ("switch", {"activate": ["top"], "deactivate": ["alone"]}),
                ("switch", {"activate": ["alone"], "deactivate": ["top", "middle", "beside", "base"]}),
                ("cancel", {"goal": 0, "controller": dice.choice(NAMES)}),
                ("parameters", {"controller": dice.choice(NAMES), "values": {"gain": dice.random() - 0.5}}),
                ("torque", {"joints": joints, "on": False, "release": release}),
                ("torque", {"joints": joints, "on": True}),
                ("reboot", {"joints": joints[:1], "release": release}),
                ("rate", {"rate": dice.choice((25.0, 50.0, 100.0))}),
                ("pause", None),
                ("resume", None),
                ("halt", None),
                ("move", None),
                ("move", None),
            ]
        )  # fmt: skip
        command = ask(kind, data)
        if kind == "move":
            lease_ns = dice.choice((0, 0, 60_000_000))
            angle = dice.uniform(-0.3, 0.3)
            command = send(dice.choice(NAMES), "move", angle, lease_ns=lease_ns)
        asked.setdefault(dice.randrange(45), []).append(command)
    # a pause has no end by itself
    return asked | {60: [ask("resume")], 120: [ask("stop")]}


def goal_writes(ledger: Sequence[Any]) -> Iterator[tuple[int, int]]:
    """Yield time and ID of each goal that a servo was sent: sync writes from address 30 on."""
    for entry in ledger:
        data = entry.data
        at = data.find(b"\xff\xff\xfe")
        if entry.direction == "in" and at >= 0 and data[at + 4 : at + 6] == b"\x83\x1e":
            length, end = data[at + 6], at + 3 + data[at + 3]
            for place in range(at + 7, end, length + 1):
                yield entry.t_ns, data[place]


@pytest.mark.campaign
@settings(
    max_examples=RUNS,
    deadline=None,
    derandomize=RUNS <= 100,
    database=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(seed=st.integers(0, 10**9))
def test_random_runs_of_chains(law: Path, tmp_path: Path, seed: int) -> None:
    """The replay has no difference; no joint has two commanders, by the ledger and by the masks."""
    dice = random.Random(seed)
    file, path = tmp_path / "chained.yaml", tmp_path / "run.mcap"
    file.write_text(ROBOT)
    path.unlink(missing_ok=True)
    robot = simulated_robot(file, duration_s=1.0, log=path)
    Clients(robot, random_commands(dice))
    if dice.random() < 0.4:
        servo = robot.buses[0].servo(dice.choice((3, 7, 8)))
        robot.buses[0].at(dice.randrange(10**8, 5 * 10**8), lambda: servo.silence(True))
        robot.buses[0].at(dice.randrange(5 * 10**8, 9 * 10**8), lambda: servo.silence(False))
    robot.run()
    log = replayed(path)
    for row in range(len(log.cycles)):
        now = active(log.cycles, row)
        for name in now:
            assert INTO.get(name, set()) <= now, (seed, row, name)
        assert len(now & {"alone", "base"}) < 2, (seed, row)
        assert len(now & {"top", "spare"}) < 2, (seed, row)
    woken, sent = log.cycles["woken_ns"], Counter[tuple[int, int]]()
    for t_ns, servo_id in goal_writes(robot.ledger.entries):
        sent[int(np.searchsorted(woken, t_ns, side="right")), servo_id] += 1
    assert not sent or max(sent.values()) == 1, (seed, sent.most_common(3))
