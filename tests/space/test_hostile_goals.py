"""Three clients send nonsense at 200 Hz; the judge is the goals that servos of the simulated bus receive."""

import itertools
import json
import random
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from tests.kit.campaigns import campaign
from tests.kit.judged_arms import arms
from tests.kit.virtual_run import replayed
from tests.kit.wire import values_written

from dxlrun.channels.commands import LOOP, CommandMessage, QueueInbox
from dxlrun.control.controllers.plugin_loading import load_plugins
from dxlrun.plan.robot_plan import Plan
from dxlrun.remote.preparation import Preparation, RefusedRequest
from dxlrun.testing import VirtualRobot, plan_of

ROBOT = Path(__file__).parents[2] / "robots/open_manipulator_x_space.yaml"
PERIOD_S = 0.005
TICK = 2 * np.pi / 4096
GOAL_POSITION = 116
WINDOW = 8  # cycles, because a tick a cycle is 0.3 rad/s
SPEED, RATE = 4.8, 20.0  # limit of the robot file, and the controller's default; rad/s, rad/s^2


def nonsense(chance: random.Random) -> tuple[str, str]:
    """Return a kind of command with its JSON; most are valid, and few can be done."""
    numbers = [0.0, 1e-9, -0.1, 0.1, 0.3, 99.0, -1e308, 1e308, float("nan"), float("inf"), "1 m", None]
    frames = ["", "link3", "link5", "end_effector_link", "left_finger", "nowhere", "x" * 300]
    quaternion = [chance.choice((-1, 1)) * each for each in (0.0, 0.6, 0.0, 0.8)]
    if chance.random() < 0.1:
        names = chance.sample(("x", "dx", "vx", "rpy", "frame", "seconds"), 2)
        wrong = {name: chance.choice(numbers) for name in names}
        return chance.choice(("pose", "twist")), json.dumps(wrong)
    if chance.random() < 0.5:
        twist = {
            axis: chance.choice((-1, 1)) * 10 ** chance.uniform(-3, 2)
            for axis in ("vx", "vy", "vz", "wy", "wz")
        }
        return "twist", json.dumps({**twist, "frame": chance.choice(frames[:5])})
    pose: dict[str, Any] = {name: chance.uniform(-0.4, 0.4) for name in chance.sample(("x", "y", "z"), 2)}
    pose |= {"d" + name: chance.uniform(-0.1, 0.1) for name in "xyz" if name not in pose}
    pose["path"] = chance.choice(("line", "joints"))
    if chance.random() < 0.5:
        pose["quaternion"] = [each * chance.choice((1, 1, 1, 1.2)) for each in quaternion]
    if chance.random() < 0.2:
        pose["seconds"] = 10 ** chance.uniform(-4, 1)
    if chance.random() < 0.3:
        pose["frame"] = chance.choice(frames)
    return "pose", json.dumps(pose)


class Clients(QueueInbox):
    """Clients that send something else in each cycle, or repeat one twist, or wait for the end of a pose."""

    def __init__(self, plan: Plan, chance: random.Random) -> None:
        super().__init__()
        self._chance, self._numbers, self._left = chance, itertools.count(1), 0
        self._repeated: tuple[str, str] | None = None
        self._arm = next(one for one in plan.loop.controllers if one.name == "arm")
        self._door = Preparation({joint.name: joint for joint in plan.loop.joints}, load_plugins())

    def drain_commands(self) -> Sequence[CommandMessage]:
        chance = self._chance
        self._left -= 1
        begins = self._left < 0
        if begins:
            self._left = chance.randrange(300)
            self._repeated = nonsense(chance) if chance.random() < 0.8 else None
        sent = self._repeated or nonsense(chance)
        if begins or sent[0] == "twist" or not self._repeated:
            self._send(chance.choice(("anna", "bert", "cleo")), *sent)
        return super().drain_commands()

    def _send(self, client: str, kind: str, text: str) -> None:
        if self._chance.random() < 0.05:
            cancel = json.dumps({"controller": "arm"}).encode()
            self.waiting.append(CommandMessage(next(self._numbers), LOOP, "cancel", cancel, client))
            return
        try:
            data = self._door.command(self._arm, kind, text.encode()).data
        except RefusedRequest:
            return
        lease_ns = self._chance.choice((0, 1, 30_000_000)) if kind == "twist" else 0
        self.waiting.append(CommandMessage(next(self._numbers), "arm", kind, data, client, lease_ns))


@campaign(ci=4, night=120, release=600)
def test_hostile_goals_are_within_the_limits_of_the_joints(
    amount: float, chance: random.Random, tmp_path: Path
) -> None:
    plan = plan_of(ROBOT, arguments={"rate": "200"}, duration_s=amount)
    robot = VirtualRobot(plan, inbox=Clients(plan, chance), log=tmp_path / "run.mcap")
    result = robot.run()
    assert (result.reason, result.detail) == ("ended", "")
    replayed(tmp_path / "run.mcap")
    (bus,) = plan.buses
    goals: dict[int, list[tuple[int, int]]] = {}
    for t_ns, servo, value in values_written(robot.ledger.entries, bus, GOAL_POSITION, 4, signed=True):
        goals.setdefault(servo, []).append((t_ns, value))
    tips, sent = arms()["open_manipulator_x"], list[Any]()
    for joint, servo in zip(plan.loop.joints[:4], (11, 12, 13, 14), strict=True):
        times, ticks = np.array(goals[servo]).T  # a goal that does not change is not sent again
        cycles = np.arange(times[0], times[-1], PERIOD_S * 1e9)
        rows = (ticks[np.searchsorted(times, cycles, "right") - 1] - 2048) * TICK
        assert np.ptp(rows) > 0.1, joint.name
        assert rows.min() >= joint.lower - TICK
        assert rows.max() <= joint.upper + TICK
        assert np.abs(np.diff(rows)).max() <= SPEED * PERIOD_S + TICK
        speeds = (rows[WINDOW:] - rows[:-WINDOW]) / (WINDOW * PERIOD_S)
        rates = (speeds[WINDOW:] - speeds[:-WINDOW]) / (WINDOW * PERIOD_S)
        assert np.abs(rates).max() <= RATE * 1.05 + 2 * TICK / (WINDOW * PERIOD_S) ** 2
        sent.append(rows)
    count = min(map(len, sent))
    places = np.array(
        [tips.matrix(row)[:3, 3] for row in np.transpose([row[:count] for row in sent])[::WINDOW]]
    )
    speeds = np.linalg.norm(np.diff(places, axis=0), axis=1) / (WINDOW * PERIOD_S)
    assert speeds.max() <= 0.2 * 1.05 + 2 * TICK * 0.4 / (WINDOW * PERIOD_S)
