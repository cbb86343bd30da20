"""Runs of the experiment on virtual time, where wake-ups are late by injected times."""

import itertools
import random
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pytest

from dxlrun.compile.robot_compiler import compile_files
from dxlrun.plan.robot_plan import Plan
from dxlrun.testing import Log, VirtualRobot, read_log
from dxlrun_lab.tracking.desired_motion import DesiredMotion, desired_motion
from dxlrun_lab.tracking.motion_evaluation import SetupResult, measure_tracking
from dxlrun_lab.tracking.setups import Setup, chosen
from dxlsim.bus.ledger import LedgerEntry

ROBOT = Path(__file__).parents[3] / "robots" / "single_joint.yaml"
PERIOD_NS = 3_125_000
ACTIVE = {"position_trajectory": "false", "posvel_trajectory": "true"}
MOTION = """\
name: short
motions:
  - controller: posvel_trajectory
    duration: {duration}
    samples: {samples}
    joints:
      joint: {{position: 0.5 * (sin(2 * t) - sin(4 * t)), velocity: cos(2 * t) - 2 * cos(4 * t)}}
"""


@dataclass
class Ran:
    """A run, and the motion that it sent."""

    setup: Setup
    log: Log
    ledger: tuple[LedgerEntry, ...]
    plan: Plan
    desired: DesiredMotion
    injected_ns: list[int]
    """How late each wake-up was made."""

    @property
    def measured(self) -> SetupResult | None:
        return measure_tracking(self.log, self.setup, self.desired, self.ledger)


def delays(kind: str) -> Iterator[int]:
    """Yield how late each wake-up is made: `none`, `random` up to three periods, or `once`, wake-up 400."""
    chance = random.Random(1)
    for number in itertools.count():
        if kind == "random":
            yield (chance.random() < 0.3) * chance.randrange(3 * PERIOD_NS)
        else:
            yield 5 * PERIOD_NS // 2 * (kind == "once" and number == 400)


@pytest.fixture(scope="session")
def runs(tmp_path_factory):
    """Return what gives the run of a set-up with such delays, or of so many cycles; each is made once."""

    @cache
    def ran(setup, delay, cycles=0):
        return _run(setup, delays(delay), tmp_path_factory.mktemp(setup), cycles)

    return ran


@pytest.fixture
def motion_file(tmp_path):
    """Return what writes a motion file of so long, with so many samples."""

    def write(duration, samples):
        file = tmp_path / "motion.yaml"
        file.write_text(MOTION.format(duration=duration, samples=samples))
        return file

    return write


def _run(name: str, late_ns: Iterator[int], folder: Path, cycles: int) -> Ran:
    (setup,) = chosen([name])
    motion = folder / "short.yaml"
    motion.write_text(MOTION.format(duration="1 s", samples=50))
    plan = setup.plan(compile_files(ROBOT, ACTIVE, [motion]).plan)
    path, injected = folder / "run.mcap", list[int]()
    robot = VirtualRobot(plan, log=path)
    clock = robot.clock

    class LateClock:
        now_ns = clock.now_ns

        def wait_until(self, deadline_ns: int) -> int:
            if cycles and robot.cycles >= cycles:
                robot.stop.request()
            injected.append(next(late_ns))
            return clock.wait_until(max(deadline_ns, clock.now_ns()) + injected[-1])

    robot.robot.loop.clock = LateClock()
    robot.run()
    desired = desired_motion(motion, plan)
    return Ran(setup, read_log(path), tuple(robot.ledger.entries), plan, desired, injected)
