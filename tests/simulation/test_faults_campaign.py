"""Campaign: storms of faults on whole robots on virtual time, from the set-up to the end.

Judged by the simulated buses' ledger alone, see fault_judge.py: the eight promises of a robot in trouble.

CI runs 4 short storms from a fixed seed, and storms in the set-up until a start of each robot has failed with
torque on. The full campaign before a release, 30 s of the robots' time each:

    DXLRUN_STORMS=500 python -m pytest tests/simulation/test_faults_campaign.py -q

`DXLRUN_STORM_SEED` (default 1) is what the storms are drawn from; a test's name is its robot and its storm.
"""

from __future__ import annotations

import json
import math
import os
import random
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dxlrun.channels.answers import Answer, Code, Refusal, Waiting
from dxlrun.channels.commands import Command
from dxlrun.log.reader import read_log
from dxlrun.simulation.faults.fault import KINDS
from dxlrun.testing import VirtualRobot, simulated_robot

ROBOTS = Path(__file__).parents[2] / "robots"
TORSO = ROBOTS / "bioloid_torso.yaml", ROBOTS / "motions/three_parts.yaml"
HEAD = """\
name: {name}
loop: {{rate: 50}}
buses:
"""
BUS = "  {bus}: {{port: sim, protocol: {protocol}, baud_rate: 1_000_000, return_delay_time: 100 us}}\n"
JOINT = (
    "  j{number}: {{bus: {bus}, id: {number}, model: {model}, reference: {middle} deg, "
    "direction: {direction}, limits: {{position: [-1.2 rad, 1.2 rad], velocity: 4 rad/s}}}}\n"
)
MODELS = {1.0: ("AX-12A", 150), 2.0: ("XM430-W350", 180)}
ROBOT_OF = {
    "torso": None,
    "eight_x": {"main": (2.0, 8)},
    "two_buses": {"left": (1.0, 4), "right": (2.0, 4)},
}
LASTING = ",".join(name for name in KINDS if name not in {"storm", "tip", "unplug"})
ALL = f"{LASTING},unplug"
FULL = "DXLRUN_STORMS" in os.environ
DURATION_S = 30.0 if FULL else 2.5
CLIENT = "anna"
CUTTING = "silence,reboot,brownout"
"""Faults that a start does not bear, and that leave a line on which the other servos hear."""
STARTS = max(1, int(os.environ.get("DXLRUN_STORMS", "8")) // 8)
"""Failed starts of each robot."""
MOST_STARTS = 20
"""Storms that are drawn for each of them at most."""


def storms() -> list[Any]:
    """Return robots in turn, and what happens to them."""
    chance = random.Random(int(os.environ.get("DXLRUN_STORM_SEED", "1")))
    drawn = []
    for index in range(int(os.environ.get("DXLRUN_STORMS", "4"))):
        robot = tuple(ROBOT_OF)[index % len(ROBOT_OF)]
        kinds = chance.choice(("", f" kinds={LASTING}", f" kinds={ALL}", f" kinds={ALL}"))
        begin = chance.choice((0, 300, 300, 300))  # the set-up is over after some 200 ms
        seed, faults = chance.randrange(10**6), chance.randint(1, 10)
        within = round((DURATION_S - 0.5) * 1000)
        storm = f"storm seed={seed} faults={faults} within={within}ms{kinds} at={begin}ms"
        drawn.append(pytest.param(robot, storm, id=f"{robot}-{seed}"))
    return drawn


def built(name: str, directory: Path, policies: str = "", duration_s: float = DURATION_S) -> VirtualRobot:
    """Return a robot of eight servos whose goals move: by a motion, or by a client's commands."""
    log = directory / "run.mcap"
    lines = ROBOT_OF[name]
    if lines is None:
        return simulated_robot(TORSO[0], play=[TORSO[1]], duration_s=duration_s, log=log)
    text, joints, number = HEAD.format(name=name), "joints:\n", 0
    for bus, (protocol, count) in lines.items():
        model, middle = MODELS[protocol]
        text += BUS.format(bus=bus, protocol=protocol)
        for _ in range(count):
            number += 1
            joints += JOINT.format(
                number=number, bus=bus, model=model, middle=middle, direction=1 if number % 2 else -1
            )
    names = ", ".join(f"j{one}" for one in range(1, number + 1))
    controllers = f"controllers:\n  all: {{type: joint_group_position_controller, joints: [{names}]}}\n"
    path = directory / f"{name}.yaml"
    path.write_text(text + joints + controllers + policies)
    return simulated_robot(path, duration_s=duration_s, log=log)


def ended(answer: Answer) -> bool:
    """Return whether the run's end refused a command, which is not logged then."""
    return isinstance(answer, Refusal) and answer.code is Code.RUN_ENDING


def commanded(robot: VirtualRobot) -> dict[int, bytes]:
    """Let a client send goals to every joint ten times a second; return them by number."""
    sent: dict[int, bytes] = {}
    rows = len(robot.plan.loop.joints)
    for number in range(1, round(10 * DURATION_S) - 5):
        goals = np.array([0.5 * math.sin(0.3 * number + row) for row in range(rows)])
        command = Command(number, "all", "positions", goals.tobytes(), CLIENT)
        sent[number] = command.data
        at_ns = 300_000_000 + number * 100_000_000
        robot.buses[0].at(at_ns, lambda command=command: robot.inbox.waiting.append(command))
    return sent


FIRST_REQUEST = 100_000
"""Number of the first request for joints."""


def requested(robot: VirtualRobot, storm: str) -> int:
    """Let another client switch torque, reboot servos and activate what was released; return how often."""
    chance = random.Random(storm)
    joints = [joint.name for joint in robot.plan.loop.joints]
    controllers = [one.name for one in robot.plan.loop.controllers if one.command]
    count = chance.choice((0, 3, round(2 * DURATION_S)))
    for number in range(count):
        some = chance.sample(joints, chance.choice((1, 1, 2, len(joints))))
        kind, data = chance.choice(
            (
                ("torque", {"joints": some, "on": False, "release": chance.random() < 0.9}),
                ("torque", {"joints": some, "on": True}),
                ("torque", {"joints": some, "on": True}),
                ("reboot", {"joints": some[:2], "release": chance.random() < 0.7}),
                ("switch", {"activate": [chance.choice(controllers)], "deactivate": []}),
            )
        )
        command = Command(FIRST_REQUEST + number, "", kind, json.dumps(data).encode(), "berta")
        at_ns = chance.randrange(300, round(DURATION_S * 1000)) * 1_000_000
        robot.buses[0].at(at_ns, lambda command=command: robot.inbox.waiting.append(command))
    return count


@pytest.mark.campaign
@pytest.mark.parametrize(("name", "storm"), storms())
def test_a_storm_breaks_no_promise(name, storm, tmp_path, judge):
    print(storm)
    robot = built(name, tmp_path)
    sent = {} if name == "torso" else commanded(robot)
    requested(robot, storm)
    trial = judge.Trial.of(robot, [storm])
    started = trial.run()
    log = read_log(tmp_path / "run.mcap")
    trial.judge(log)
    answers = {number: answer for number, answer in robot.inbox.answers.items() if number in sent}
    accepted = {number for number, answer in answers.items() if not ended(answer)}
    assert not any(isinstance(answer, Waiting) for answer in robot.inbox.answers.values())
    logged = [command for command in log.commands if command.origin == CLIENT]
    assert [one.data for one in logged] == [sent[number] for number in sorted(accepted)]
    assert {one.origin for one in log.commands} <= {
        CLIENT,
        "berta",
        "loop",
        *(str(p) for p in TORSO),
    } or not sent
    assert not started or not sent or accepted


@pytest.mark.campaign
@pytest.mark.parametrize("name", ROBOT_OF)
def test_a_start_that_fails_after_torque_was_given_leaves_no_servo_with_it(name, tmp_path, judge):
    """Storms in the set-up, until enough starts have failed when some servos had their torque."""
    chance = random.Random(f"{os.environ.get('DXLRUN_STORM_SEED', '1')} {name}")
    reached = 0
    for number in range(MOST_STARTS * STARTS):
        storm = f"storm seed={chance.randrange(10**6)} faults=4 within=80ms kinds={CUTTING}"
        storm += f" at={chance.choice((60, 120, 180))}ms"
        directory = tmp_path / str(number)
        directory.mkdir()
        trial = judge.Trial.of(built(name, directory, duration_s=0.1), [storm])
        started = trial.run()
        print(storm, "started" if started else trial.refusal)
        trial.judge(read_log(directory / "run.mcap"))
        reached += trial.torque_was_given and not started
        if reached == STARTS:
            return
    raise AssertionError(f"only {reached} of {STARTS} starts failed with torque on: other faults or times?")
