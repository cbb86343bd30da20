"""The fall reflex of robots/fall_reflex.yaml: when it acts, what leaves on the bus, and its replay."""

import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from tests.kit.virtual_run import VirtualRun, source_states

from dxlrun.channels.event_records import EventCode
from dxlrun.log.log_reader import Log

ROBOT = Path(__file__).parents[2] / "robots" / "fall_reflex.yaml"
MOTION = """\
name: tip
motions:
  - controller: stand
    points:
      - {time: 100 ms, joints: {tilt: {position: 0 deg, velocity: 0 rad/s}}}
      - {time: 800 ms, joints: {tilt: {position: -60 deg, velocity: 0 rad/s}}}
"""
BOUND, TIME, PERIOD = math.radians(40), 0.03, 0.01
SYNC_WRITE, GOAL_CURRENT = 0x83, 102
REDUCED = round(0.3 / 2.69e-3)
"""Of the effort of the pose, in steps of Goal Current (e-Manual, XM430-W350)."""


class Fall(NamedTuple):
    run: VirtualRun
    log: Log

    def states(self, name: str) -> Any:
        return source_states(self.log)[name]


@pytest.fixture(scope="module")
def fall(tmp_path_factory: pytest.TempPathFactory) -> Fall:
    directory = tmp_path_factory.mktemp("fall")
    (directory / "tip.yaml").write_text(MOTION)
    run = VirtualRun(ROBOT, directory / "run.mcap", play=[directory / "tip.yaml"], duration_s=1.4)
    return Fall(run, run.finish())


def pitch(fall: Fall) -> Any:
    x, y, z, w = (fall.states(f"imu/orientation.{axis}") for axis in "xyzw")
    return np.arcsin(2 * (w * y - z * x))


def acting(fall: Fall) -> int:
    """Return in which row of the cycles the reflex acts."""
    names = [one.name for one in fall.run.plan.loop.controllers]
    return int(np.argmax(fall.log.cycles["active"] >> names.index("curl") & 1))


def test_it_acts_in_the_cycle_in_which_its_time_is_over(fall):
    names = [one.name for one in fall.run.plan.loop.controllers]
    active = fall.log.cycles["active"]
    beyond = int(np.argmax(np.abs(pitch(fall)) > BOUND))
    acted = acting(fall)
    assert active[acted] >> names.index("curl") & 1
    assert beyond > 20
    assert acted == beyond + round(TIME / PERIOD)
    assert not active[acted] >> names.index("wave") & 1
    assert active[acted - 1] >> names.index("wave") & 1
    (event,) = [event for event in fall.log.events if event.code == EventCode.TAKEOVER]
    assert event.text.startswith("curl takes over from wave: falls with roll 0 deg, pitch -4")
    efforts = fall.log.cycles["goal_effort"][:, 1:]
    assert efforts[acted - 1] == pytest.approx([1.2, 1.2])
    assert efforts[acted] == pytest.approx([0.3, 0.3])
    assert fall.log.cycles["goal_position"][-1, 1:] == pytest.approx(np.radians([80, 80]), abs=0.02)
    assert fall.states("fall/fallen")[[beyond, acted - 1, acted, -1]].tolist() == [0, 0, 1, 1]


def test_the_reduced_effort_is_on_the_wire_at_the_end_of_that_cycle(fall):
    cycle = fall.log.cycles[acting(fall)]
    written = [one for one in fall.run.buses[0].ledger.entries if one.direction == "in"]
    reduced = REDUCED.to_bytes(2, "little")
    goals = [one for one in written if one.data[7:10] == bytes([SYNC_WRITE, GOAL_CURRENT, 0])]
    first = next(one for one in goals if bytes([2]) + reduced in one.data)
    assert bytes([3]) + reduced in first.data
    assert cycle["updated_ns"] <= first.t_ns < cycle["scheduled_ns"] + round(PERIOD * 1e9)
