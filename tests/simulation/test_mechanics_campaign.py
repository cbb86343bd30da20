"""Campaign: random robots with gears, slides, several servos on a joint, differentials and matrices.

Judged by the simulated bus' ledger alone: what the servos were sent and what they answered, in ticks, against
what the log says of their joints. CI runs a sample of 1.5 s each; the full campaign, of 6 s each:

    pytest --campaign=release tests/simulation/test_mechanics_campaign.py -rP
"""

from __future__ import annotations

import json
import math
import random
from bisect import bisect_right
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from tests.kit.campaigns import campaign
from tests.kit.virtual_run import VirtualRun, send
from tests.kit.wire import FACTS, instructions, states, value_at, written

from dxlrun.channels.cycle import LIMP
from dxlrun.errors import DxlrunError
from dxlrun.log.log_reader import Log, read_log
from dxlrun.run.virtual_run import VirtualRobot
from dxlsim.faults.kinds import KINDS
from dxlwire.bus_plan import BusPlan, ServoPlan

LONGEST_S = 6.0
RATE = 50
SYNC_WRITE = 0x83
MODELS = {1.0: ("AX-12A", 150, 140), 2.0: ("XM430-W350", 180, 170)}
"""Model, middle of its travel, and how far from there it surely goes, deg"""
LASTING = ",".join(name for name in KINDS if name not in {"storm", "tip", "unplug"})


def drawn(chance: random.Random) -> str:
    """Return a robot with every kind of joint, on one bus of either protocol."""
    protocol = chance.choice((1.0, 2.0))
    model, middle, reach = MODELS[protocol]
    number = 0

    def servo(*more: str, ids: bool = True) -> str:
        nonlocal number
        reference = round(middle + chance.uniform(-10, 10), 2)
        keys = [f"reference: {reference} deg", f"direction: {chance.choice((1, -1))}", *more]
        if ids:
            number += 1
            keys = [f"id: {number}", *keys]
        return ", ".join(keys)

    used = f"bus: main, model: {model}"
    room = reach - 12.0
    gear, slide = round(chance.uniform(0.5, 4), 3), round(chance.uniform(10, 90), 2)
    limit = round(0.8 * room / gear, 2)
    way = round(0.8 * room / 360 * slide, 3)
    low, high = round(0.8 * room, 2), round(0.7 * room, 2)
    pair = ", ".join(f"{{{servo()}}}" for _ in range(chance.choice((2, 2, 3))))
    inputs = [round(chance.uniform(0.7, 1.5), 3) for _ in range(2)]
    wrist = [f"{{{used}, {servo(f'gear_ratio: {ratio}')}}}" for ratio in inputs]
    turned = round(0.45 * room / max(inputs), 2)
    a, d = (chance.uniform(0.6, 1.4) * chance.choice((1, -1)) for _ in range(2))
    b, c = (chance.uniform(-0.4, 0.4) for _ in range(2))
    rows = f"[[{a:.3f}, {b:.3f}], [{c:.3f}, {d:.3f}]]"
    inverse = np.linalg.inv(np.array(json.loads(rows)))
    shared = round(0.8 * room / float(np.abs(inverse).sum(axis=1).max()), 2)
    legs = [f"{{{used}, {servo()}}}" for _ in range(2)]
    joints = ["hip", "knee", "slide", "pitch", "roll", "swing", "lift"]
    return f"""\
name: drawn
loop: {{rate: {RATE}}}
buses:
  main: {{port: sim, protocol: {protocol}, baud_rate: 1_000_000, return_delay_time: 100 us}}
joints:
  hip: {{{used}, {servo(ids=False)}, servos: [{pair}], limits: {{position: [{-low} deg, {high} deg]}}}}
  knee: {{{used}, {servo(f"gear_ratio: {gear}")}, limits: {{position: [{-limit} deg, {limit} deg]}}}}
  slide: {{{used}, {servo(f"travel_per_turn: {slide} mm")}, limits: {{position: [{-way} mm, {way} mm]}}}}
  pitch: {{limits: {{position: [{-turned} deg, {turned} deg]}}, simulation: {{inertia: 0.002 kg m^2}}}}
  roll: {{limits: {{position: [{-turned} deg, {turned} deg], velocity: 3 rad/s}}}}
  swing: {{limits: {{position: [{-shared} deg, {shared} deg]}}}}
  lift: {{limits: {{position: [{-shared} deg, {shared} deg]}}, simulation: {{gravity: 0.1 Nm}}}}
transmissions:
  wrist: {{type: differential, joints: [pitch, roll], servos: {{left: {wrist[0]}, right: {wrist[1]}}}}}
  leg: {{type: matrix, joints: [swing, lift], matrix: {rows}, servos: {{inner: {legs[0]}, outer: {legs[1]}}}}}
controllers:
  all: {{type: joint_group_position_controller, joints: [{", ".join(joints)}]}}
policies: {{on_lost_servo: hold, on_returned_servo: {chance.choice(("hold", "limp"))}}}
"""


def built(chance: random.Random, directory: Path, duration_s: float, *, beyond: float = 1.0) -> VirtualRun:
    """Return a robot to which a client sends random goals; `beyond` 1: up to its limits, else beyond them."""
    robot = VirtualRun.of_text(directory, drawn(chance), duration_s)
    joints = robot.plan.loop.joints
    for number in range(1, round(duration_s * 10)):
        goals = [chance.uniform(beyond * joint.lower, beyond * joint.upper) for joint in joints]
        robot.post_at(250 + number * 100, send("all", "positions", *goals))
    return robot


def coordinate(servo: ServoPlan, raw: int) -> float:
    """Return what a servo does at its joint, rad or m, worked out anew from the robot file's keys."""
    theta = raw * FACTS[servo.model].rad_per_tick
    return servo.direction * (theta - servo.reference) * servo.ratio


def tick(servo: ServoPlan) -> float:
    return FACTS[servo.model].rad_per_tick * servo.ratio


@dataclass
class Spaces:
    """The joints of a robot in ticks of its servos, from the plan."""

    robot: VirtualRobot
    bus: BusPlan
    matrix: np.ndarray
    """q = matrix @ s, joints by servos"""
    inverse: np.ndarray

    @classmethod
    def of(cls, robot: VirtualRobot) -> Spaces:
        (bus,), plan = robot.plan.buses, robot.plan
        matrix = np.zeros((len(plan.loop.joints), len(bus.servos)))
        for joint, servo in plan.mechanics.direct:
            matrix[joint, servo] = 1.0
        for one in plan.mechanics.couplings:
            matrix[np.ix_(one.joints, one.servos)] = one.matrix
        inverse = np.linalg.pinv(matrix)
        return cls(robot, bus, matrix, np.where(np.abs(inverse) < 1e-12, 0.0, inverse))

    def goals(self, log: Log) -> int:
        """Judge that no goal is outside of either space, and both are equal to a tick; return how many."""
        sent = list(instructions(self.robot.ledger.entries, self.bus))
        cycles, joints = log.cycles, self.robot.plan.loop.joints
        lower = np.array([joint.lower for joint in joints])
        upper = np.array([joint.upper for joint in joints])
        goals = cycles["goal_position"]
        # the goal of a joint without torque is where it stands, wherever it fell, and is sent to no servo
        known = np.isfinite(goals) & ~np.isin(cycles["torque"], LIMP)
        assert (np.where(known, goals, lower) >= lower - 1e-9).all()
        assert (np.where(known, goals, upper) <= upper + 1e-9).all()
        begun = cycles["read_ns"].tolist()
        compared = 0
        for t_ns, servo, raw in written(sent, self.bus, "goal_position"):
            most = round(2 * math.pi / FACTS[servo.model].rad_per_tick) if servo.model != "AX-12A" else 1024
            assert 0 <= raw < most, (t_ns, servo.own_name, raw)
            assert servo.lower_tick <= raw <= servo.upper_tick, (t_ns, servo.own_name, raw)
        for t_ns, servo, raw in written(
            [one for one in sent if one.instruction == SYNC_WRITE], self.bus, "goal_position"
        ):
            cycle = bisect_right(begun, t_ns) - 1
            if cycle < 0 or not known[cycle, self.inverse[servo.row] != 0.0].all():
                continue
            goal = float(self.inverse[servo.row] @ np.nan_to_num(goals[cycle]))
            assert abs(goal - coordinate(servo, raw)) <= tick(servo) * 1.001, (t_ns, servo.own_name)
            compared += 1
        return compared

    def positions(self, log: Log) -> int:
        """Judge that each position is what the servos of its joint answered last, through M; return how many.

        Only of runs without faults: a reply that came too late is on the wire, and not in the log.
        """
        entries = self.robot.ledger.entries
        cycles, servos = log.cycles, {servo.servo_id: servo for servo in self.bus.servos}
        answered: dict[int, list[tuple[int, float]]] = {each: [] for each in servos}
        for reply in states(entries, self.bus):
            servo = servos[reply.servo_id]
            raw = value_at(servo, "present_position", servo.state.address, reply.data)
            answered[reply.servo_id].append((reply.t_ns, coordinate(servo, raw)))
        times = {each: [t_ns for t_ns, _ in found] for each, found in answered.items()}
        compared = 0
        for cycle in range(len(cycles)):
            written_ns = int(cycles["written_ns"][cycle])
            now = {}
            for servo_id, servo in servos.items():
                place = bisect_right(times[servo_id], written_ns) - 1
                now[servo.row] = answered[servo_id][place][1] if place >= 0 else math.nan
            s = np.array([now[row] for row in range(len(servos))])
            for row in np.flatnonzero(cycles["valid"][cycle]).tolist():
                movers = np.flatnonzero(self.matrix[row])
                said = float(self.matrix[row, movers] @ s[movers])
                assert abs(said - cycles["position"][cycle, row]) < 1e-9, (cycle, log.joints[row])
                compared += 1
        return compared


@campaign(ci=1, night=8, release=40)
def test_random_motions_are_the_same_in_both_spaces_to_a_tick(number, amount, chance, tmp_path):
    robot = built(chance, tmp_path, min(LONGEST_S, 1.5 * amount))
    log = robot.finish()
    assert log.cycles["valid"].all()
    spaces = Spaces.of(robot)
    goals, positions = spaces.goals(log), spaces.positions(log)
    print(f"{number}: {goals} goals of servos and {positions} positions of joints")
    assert goals > 10 * len(robot.plan.buses[0].servos)
    assert positions == len(log.cycles) * len(log.joints)
    way = np.ptp(log.cycles["position"], axis=0) / [
        joint.upper - joint.lower for joint in robot.plan.loop.joints
    ]
    assert (way > 0.05).all(), "each joint moved"


@campaign(ci=2, night=60, release=300)
def test_no_goal_leaves_either_space_in_a_storm(number, amount, chance, tmp_path):
    duration_s = min(LONGEST_S, 0.75 * amount)
    robot = built(chance, tmp_path, duration_s, beyond=chance.choice((1.0, 1.5, 4.0)))
    within = round((duration_s - 0.5) * 1000)
    faults, begin = chance.randint(1, 12), chance.choice((0, 300, 300))
    storm = (
        f"storm seed={chance.randrange(10**6)} faults={faults} within={within}ms at={begin}ms kinds={LASTING}"
    )
    print(f"{number}: {storm}")
    robot.fault(storm)
    try:
        robot.run()
    except DxlrunError as error:
        print("did not start:", "; ".join(error.sentences))
    print(f"{Spaces.of(robot).goals(read_log(tmp_path / 'run.mcap'))} goals of servos")
