"""A replay of chains has no difference, and names the reference that differs where there is one."""

from collections.abc import Mapping
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.kit.changed_logs import flip, plan
from tests.kit.virtual_run import Asked, VirtualRun, ask, differing, rate, replayed, send, switch, torque

from dxlrun.channels.event_records import EventCode
from dxlrun.errors import InputError, LogError
from dxlrun.log.log_reader import read_log
from dxlrun_analysis.replay import Setting, replay_log

pytestmark = pytest.mark.long

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
  top: {type: ./law.py:Law, joints: [nod, pan], into: middle, gain: 0.3, rate: 25, fallback: spare}
  base: {type: ./law.py:Law, joints: [pan, tilt, nod], exports: [position, velocity], drives: true}
  beside: {type: ./law.py:Law, joints: [tilt], into: base, gain: 0.2}
  middle: {type: ./law.py:Law, joints: [pan, nod], into: base, exports: [position]}
  spare: {type: ./law.py:Law, joints: [pan, nod], into: middle, gain: -0.1, active: false}
  alone: {type: ./law.py:Law, joints: [pan, tilt, nod], drives: true, active: false}
"""
NAMES = ("top", "base", "beside", "middle", "spare", "alone")
LAW = '''\
"""A law that follows its references."""
from typing import Annotated

import numpy as np
from dxlrun import LIVE, CommandModel, Controller, Interfaces, Outcome, ParametersModel


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
'''


def write_robot(folder: Path) -> Path:
    (folder / "law.py").write_text(LAW)
    (folder / "chained.yaml").write_text(ROBOT)
    return folder / "chained.yaml"


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
    "goals of a chain": {
        3: [send("top", "move", 0.2), send("beside", "move", -0.1, lease_ns=60_000_000)],
        8: [ask("parameters", {"controller": "top", "values": {"gain": -0.2}}), rate(100)],
        12: [ask("cancel", {"goal": 0, "controller": "top"}), torque(["tilt"], on=False)],
        20: [ask("pause")],
        25: [ask("resume"), torque(["tilt"], on=True), rate(50)],
        30: [ask("halt")],
    },
}


@pytest.fixture(scope="module")
def story(tmp_path_factory):
    """Return the log of a story, which is run once."""
    robot = write_robot(tmp_path_factory.mktemp("chained"))

    def run(name: str) -> Path:
        return VirtualRun(robot, robot.with_name(f"{name}.mcap"), STORIES[name], duration_s=1.0).logged()

    return cache(run)


def active(cycles: NDArray[np.void], row: int) -> set[str]:
    return {name for bit, name in enumerate(NAMES) if int(cycles["active"][row]) >> bit & 1}


@pytest.mark.parametrize("name", STORIES)
def test_a_run_of_chains(story, name):
    assert np.isfinite(replayed(story(name)).cycles["reference"]).any()


def test_the_stories_do_what_they_are_there_for(story):
    log = read_log(story("switches"))
    base = [f"base/{joint}/{name}" for name in ("position", "velocity") for joint in ("pan", "tilt", "nod")]
    assert log.header.references == (*base, "middle/pan/position", "middle/nod/position")
    chain = {"top", "base", "middle"}
    assert [active(log.cycles, row) for row in (4, 5, 9, 15, 20)] == [
        chain | {"beside"},
        {"alone"},
        chain,
        chain - {"top"} | {"spare"},
        chain - {"top"} | {"spare", "beside"},
    ]
    assert "middle is commanded by top" in str(
        [event.text for event in log.events if event.code == EventCode.COMMAND_REFUSED]
    )
    log = read_log(story("a fallback"))
    assert active(log.cycles, -1) == {"base", "beside", "middle", "spare"}


FLIPPED = [
    (7, 12, "top", "nod", "middle/nod/position"),
    (0, 30, "middle", "pan", "base/pan/position"),
    (1, 3, "beside", "tilt", "base/tilt/position"),
    (4, 8, None, "tilt", "base/tilt/velocity"),
]


@pytest.mark.parametrize("flipped", FLIPPED, ids=[one[-1] for one in FLIPPED])
def test_a_flipped_bit_of_a_reference_is_found_and_named(story, changed, flipped):
    place, cycle, controller, joint, name = flipped
    report, first = differing(changed(story("a fallback"), flip("reference", cycle, place)))
    assert report.different == 1
    assert (first.cycle, first.controller, first.joint) == (cycle, controller, joint)
    assert first.what == f"reference {name}"
    (one,) = report.joints
    assert (one.joint, one.references, one.commands, one.goals) == (joint, 1, 0, 0)


def test_another_parameter_above_differs_first_in_its_references(story):
    report, first = differing(story("a restart"), "beside.gain=0.25")
    assert (first.what, first.controller) == ("reference base/tilt/position", "beside")
    (one,) = report.joints
    assert (one.joint, one.references >= one.commands > 0) == ("tilt", True)


def test_other_references_than_those_of_the_log_are_refused(story, changed):
    with pytest.raises(InputError, match="base: the exported references differ"):
        replay_log(story("a restart"), [Setting.parse("base.exports=[position]")])
    other = plan(lambda content: content["loop"]["controllers"][1].update(reference=["position"]))
    with pytest.raises(LogError, match="the log is damaged: plan and cycles differ in references"):
        replay_log(changed(story("a restart"), other))
