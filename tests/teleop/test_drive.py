"""Driving on virtual time: what moves, and that the robot holds, judged by the ledger of its servos."""

import math
from collections.abc import Callable, Mapping
from itertools import pairwise
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
import pytest
from tests.kit.judged_arms import arms
from tests.kit.virtual_run import DrivenRobot
from tests.kit.wire import changes

from dxlrun import RemoteRobot
from dxlrun_teleop.bank import banks_of
from dxlrun_teleop.drive import Drive
from dxlrun_teleop.source import InputState

pytestmark = pytest.mark.long

ROBOTS = Path(__file__).parents[2] / "robots"
BEGIN_S, END_S, HELD_S = 1.0, 2.0, 0.25
VELOCITY, POSITION = (104, 4), (116, 4)
"""Address and size of XL430 goals; AX-12: Goal Position at 30"""
ARM = """\
name: arm
buses: {main: {port: sim, protocol: 2.0, baud_rate: 1_000_000, adapter: {latency: 0 ms}}}
loop: {rate: 100}
joint_defaults:
  {bus: main, model: XL430-W250, reference: 180 deg, direction: 1, limits: {position: [-60 deg, 60 deg]}}
groups: {hand: {joints: [wrist]}}
joints: {elbow: {id: 1}, wrist: {id: 2}}
controllers: {arm: {type: joint_group_position_controller, joints: [elbow, wrist]}}
"""


class Hand:
    """A script: the axes of some time, held until another one; released, unplugged or killed then."""

    def __init__(self, drive: Drive, ending: str, axes: tuple[float, ...] = (1.0,)) -> None:
        self._drive, self._ending, self._axes = drive, ending, axes
        self.gone = False

    def __call__(self, now: float) -> None:
        if self.gone:
            return
        held = BEGIN_S <= now < END_S
        if now >= END_S and self._ending != "released":
            self.gone = True
            if self._ending == "unplugged":  # as the command's `finally` does
                self._drive.close()
            return
        self._drive.apply_input(InputState(self._axes if held else (0.0,) * len(self._axes), held), now)


def driven(
    robot: Path,
    ending: str,
    *targets: str,
    axes: tuple[float, ...] = (1.0,),
    factor: float = 1.0,
    arguments: Mapping[str, str] = MappingProxyType({}),
) -> DrivenRobot:
    run = DrivenRobot(robot, 3.5, arguments)

    def begin(client: RemoteRobot) -> Callable[[float], object]:
        return Hand(Drive(client, banks_of(client, targets, 8), factor), ending, axes)

    run.run(begin)
    return run


def goals_of(run: DrivenRobot, address: int, size: int) -> dict[int, list[tuple[float, int]]]:
    return changes(run.virtual.ledger.entries, run.virtual.plan, address, size)


def arm(directory: Path) -> Path:
    path = directory / "arm.yaml"
    path.write_text(ARM)
    return path


class Case(NamedTuple):
    robot: str
    item: tuple[int, int]
    targets: tuple[str, ...] = ()
    arguments: Mapping[str, str] = MappingProxyType({})
    axes: tuple[float, ...] = (1.0,)


SLOWING_S = {"base": 0.2, "space": 0.2}
"""A base, or a tip in space, slows down within its limit of acceleration from then on."""
CASES = {
    "base": Case("diff_drive.yaml", VELOCITY),
    "wheels": Case("diff_drive.yaml", VELOCITY, (), {"base": "false", "wheels": "true"}),
    "trajectory": Case("leader_follower.yaml", POSITION, ("left_arm",)),
    "posvel": Case("bioloid_torso.yaml", (30, 2), ("head",)),
    "group": Case("arm", POSITION, ("wrist",)),
    "space": Case("open_manipulator_x_space.yaml", POSITION, ("vz",), axes=(-1.0,)),
}


@pytest.mark.parametrize("ending", ["released", "unplugged", "killed"])
@pytest.mark.parametrize("case", CASES)
def test_the_robot_holds_within_250_ms(tmp_path, case, ending):
    name, item, targets, arguments, axes = CASES[case]
    robot = arm(tmp_path) if name == "arm" else ROBOTS / name
    run = driven(robot, ending, *targets, arguments=arguments, axes=axes)
    goals = {servo: found for servo, found in goals_of(run, *item).items() if found[-1][0] > BEGIN_S}
    goals.pop(3, None)  # the follower of leader_follower comes after the measured position of its leader
    assert goals
    for found in goals.values():
        moved = [at for at, _ in found if at > BEGIN_S]
        assert min(moved) < BEGIN_S + HELD_S
        assert max(moved) < END_S + HELD_S + SLOWING_S.get(case, 0.0)
        before = [value for at, value in found if at < END_S][-1]
        if item == VELOCITY:
            assert (before != 0, found[-1][1]) == (True, 0)
        else:
            assert abs(before - found[0][1]) > 50, found  # ticks: on the way, all the time
            assert len(moved) > 10


def test_tip_in_space_keeps_its_limits_and_those_of_the_joints():
    """Judged by the goals of the servos, with forward kinematics of the tests' own."""
    arm = arms()["open_manipulator_x"]
    run = driven(
        ROBOTS / "open_manipulator_x_space.yaml", "killed", "arm", axes=(-0.6, 0.3, -1, 0, 0.2, 0), factor=10
    )
    goals = goals_of(run, *POSITION)
    times = np.arange(BEGIN_S, 3.0, 0.05)
    rows = [
        [
            (next(value for at, value in reversed(goals[servo]) if at <= time) - 2048) * math.tau / 4096
            for servo in (11, 12, 13, 14)
        ]
        for time in times
    ]
    speeds = np.abs(np.diff(rows, axis=0)) / 0.05
    tips = np.array([arm.matrix(row)[:3, 3] for row in rows])
    tip_speeds = np.linalg.norm(np.diff(tips, axis=0), axis=1) / 0.05
    assert np.sign(tips[-1] - tips[0]).tolist() == [-1, 1, -1]  # backward, left, down
    assert speeds.max() < 4.8
    assert 0.15 < tip_speeds.max() < 0.2 * 1.05
    assert tip_speeds[times[1:] > END_S + 0.15 + 0.4 + 0.1].max() == 0.0  # lease, and 0.2 m/s at 0.5 m/s^2


def test_client_that_stood_still_moves_on_from_where_the_joint_is(tmp_path):
    """It does not make up for the time in which it did not run."""
    run = DrivenRobot(arm(tmp_path), 2.5, {})

    def begin(client: RemoteRobot) -> Callable[[float], object]:
        drive = Drive(client, banks_of(client, (), 8), 1.0)

        def step(now: float) -> None:
            if not 1.2 <= now < 1.7:
                drive.apply_input(InputState((0.5,), 0.9 <= now < 2.0), now)

        return step

    run.run(begin)
    goals = goals_of(run, *POSITION)[1]
    steps = [(at, abs(value - before)) for (_, before), (at, value) in pairwise(goals)]
    usual = max(step for at, step in steps if 0.9 < at < 1.2)
    assert {at for at, _ in steps if at >= 1.7}
    assert max(step for at, step in steps if at >= 1.2) <= 2 * usual
