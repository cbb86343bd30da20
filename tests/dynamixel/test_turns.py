"""Random robots whose servos count from anywhere, judged on the simulated shafts: no angle is wrong by more
than a tick, no joint moves at the start, limits hold, also after a reboot within the run and a power cycle.
"""

import math
import random
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
from tests.kit.campaigns import campaign
from tests.kit.line_faults import turn_by_hand
from tests.kit.rigs import make_rig

from dxlrun.channels.cycle import Commands, States
from dxlrun.compile.robot_compiler import compile_files
from dxlrun.dynamixel.dynamixel_hardware import DynamixelHardware, ServoArrays
from dxlwire.bus_plan import BusPlan
from dxlwire.control_table import ControlTable, find_table
from dxlwire.plan.mode_plan import can_count_turns

MODELS = {
    1.0: ("AX-12A", "RX-28", "MX-28", "MX-64"),
    2.0: ("XM430-W350", "XL430-W250", "XL330-M288", "MX-64", "H54-200-S500-R", "XL-320"),
}
BUS = "buses: {main: {port: sim, protocol: %s, baud_rate: 1_000_000, adapter: {kind: direct}, %s}}"
ROBOT = """\
name: any
%s
loop: {rate: 50}
joints:
%s
controllers: {states: {type: joint_state_broadcaster}}
policies: {on_returned_servo: hold}
"""
OFF = math.radians(4.0)  # an XL-320 holds as loosely
OVERSHOOT = math.radians(3.0)
NEAR = math.radians(1.5)
SPEED = 2.0  # rad/s of a servo; faster ones overshoot their goals
EXTENDED = 4


@dataclass
class Joint:
    """A joint as it is on the bench: its servo is at `angle`, rad from raw 0, over turns."""

    table: ControlTable
    servo_id: int
    reference: float
    direction: int
    gear: float
    low: float
    high: float
    """Ends of its travel, rad of the servo from raw 0, over turns."""
    offset: int
    angle: float = 0.0

    @property
    def tick(self) -> float:
        return self.table.rad_per_tick

    def position(self, angle: float) -> float:
        return self.direction * (angle - self.reference) / self.gear

    @property
    def text(self) -> str:
        ends = sorted(map(self.position, (self.low, self.high)))
        return (
            f"  j{self.servo_id}: {{bus: main, id: {self.servo_id}, model: {self.table.model}, "
            f"reference: {self.reference:.9f} rad, direction: {self.direction}, gear_ratio: {self.gear}, "
            f"limits: {{position: [{ends[0]:.9f} rad, {ends[1]:.9f} rad]}}}}"
        )

    def draw(self, chance: random.Random) -> float:
        """Return an angle within the travel; often near an end, where friction leaves a servo within it."""
        inside = self.low + NEAR, self.high - NEAR
        return chance.choice((*inside, chance.uniform(*inside), chance.uniform(*inside)))


def draw_joint(chance: random.Random, protocol: float, servo_id: int) -> Joint:
    table = find_table(chance.choice(MODELS[protocol]), protocol)
    first, last = (tick * table.rad_per_tick for tick in (table.min_tick, table.max_tick))
    if can_count_turns(table):
        width = chance.uniform(math.radians(20), math.radians(355))
        # half of them near the place where the count begins again
        middle = first + chance.choice((chance.uniform(0, math.tau), chance.gauss(0, 0.5)))
        low, high = middle - width / 2, middle + width / 2
        turn = round(math.tau / table.rad_per_tick)
        offset = chance.choice(
            (0, chance.randint(-turn // 4, turn // 4), chance.randint(-2 * turn, 2 * turn))
        )
    else:
        width = chance.uniform(math.radians(20), last - first)
        low = chance.uniform(first, last - width)
        high = low + width
        offset = chance.randint(-20_000, 20_000) if "multi_turn_offset" in table.items else 0
    direction, gear = chance.choice((1, -1)), chance.choice((1.0, 1.0, 2.5))
    return Joint(table, servo_id, chance.uniform(low, high), direction, gear, low, high, offset)


def compiled(joints: list[Joint], protocol: float, folder: Path) -> BusPlan:
    path = folder / "robot.yaml"
    bus = BUS % (protocol, "return_delay_time: 0 us" if protocol == 2.0 else "return_delay_time: 500 us")
    path.write_text(ROBOT % (bus, "\n".join(joint.text for joint in joints)))
    (plan,) = compile_files(path, {}, []).plan.buses
    return plan


class Bench:
    """Joints of a robot and the rig that moves them."""

    def __init__(self, chance: random.Random, joints: list[Joint], plan: BusPlan) -> None:
        self.chance, self.joints = chance, joints
        self.before: dict[int, float] = {}
        self.rig = make_rig(plan)
        for joint in joints:
            servo = self.rig.servo(joint.servo_id)
            for name in ("homing_offset", "multi_turn_offset"):
                if joint.offset and name in joint.table.items:
                    servo.poke(name, joint.offset)
            if can_count_turns(joint.table) and chance.random() < 0.5:
                servo.poke("operating_mode", EXTENDED)

    def rest(self) -> None:
        """Move the joints by hand, and switch their power off and on, before or after."""
        for joint in self.joints:
            joint.angle = joint.draw(self.chance)
            servo = self.rig.servo(joint.servo_id)
            turns = 0
            if servo.registers.get("operating_mode") == EXTENDED and self.chance.random() < 0.5:
                turns = self.chance.randint(-3, 3)
            else:
                servo.power_cycle()
            turn_by_hand(servo, joint.angle + turns * math.tau)
            if not turns:
                servo.power_cycle()

    def start(self) -> None:
        self.rig.hardware.start()
        self.cycles(5)
        self.are_at()

    def cycles(self, count: int) -> None:
        """Run cycles, and follow each shaft over its turns; it must stay within its limits."""
        for _ in range(count):
            self.rig.cycle()
            for joint in self.joints:
                shaft = self.rig.servo(joint.servo_id).shaft_angle
                joint.angle += math.remainder(shaft - joint.angle, math.tau)
                assert joint.low - OVERSHOOT < joint.angle < joint.high + OVERSHOOT, joint

    def are_at(self, off: float = 0.0) -> None:
        """Check that each joint shows where its shaft is, and that this is where it was, or was sent.

        `off` is how far friction may leave it, rad; it may always be a tick.
        """
        for row, joint in enumerate(self.joints):
            shown, true = self.rig.states.position[row], joint.position(joint.angle)
            assert self.rig.states.valid[row], joint
            assert shown == pytest.approx(true, abs=joint.tick / joint.gear), joint
            expected = self.before[joint.servo_id]
            assert joint.angle == pytest.approx(expected, abs=off + joint.tick), joint
        assert all(self.rig.torque())

    def remember(self) -> None:
        self.before = {joint.servo_id: joint.angle for joint in self.joints}

    def move(self) -> None:
        """Send every joint beyond its travel, where its limit stops it, and then to a place in it."""
        for beyond in (self.chance.choice((1.0, -1.0)), 0.0):
            for row, joint in enumerate(self.joints):
                aim = joint.draw(self.chance) + beyond
                self.rig.goals.position[row] = joint.position(aim)
                self.rig.goals.velocity[row] = SPEED / joint.gear
                self.before[joint.servo_id] = min(max(aim, joint.low), joint.high)
            self.cycles(180)
            self.are_at(OFF)
        self.remember()

    def reboot(self) -> None:
        """Cut the power of a servo within the run; it gets torque back by the policy."""
        joint = self.chance.choice(self.joints)
        servo = self.rig.servo(joint.servo_id)
        servo.cut_power(self.rig.clock.now_ns() + 300_000_000)
        self.cycles(10)
        assert not self.rig.states.valid.all()
        for _ in range(150):
            self.cycles(1)
            if self.rig.states.valid.all():
                break
        self.cycles(10)
        self.are_at()
        self.remember()

    def start_again(self) -> None:
        """End the run, move the joints by hand, and start the next run on the same servos."""
        rig = self.rig
        assert not rig.hardware.stop()
        self.rest()
        count = len(self.joints)
        states, goals = States.empty(count), Commands.empty(count)
        hardware = DynamixelHardware(rig.lines, rig.packets, ServoArrays(states, goals), rig.events)
        self.rig = replace(rig, states=states, goals=goals, hardware=hardware)
        self.remember()
        self.start()


@campaign(ci=4, night=60, release=200)
def test_servos_may_count_from_anywhere(number: int, chance: random.Random, tmp_path: Path) -> Iterator[None]:
    protocol = chance.choice((1.0, 2.0, 2.0))
    joints = [draw_joint(chance, protocol, servo_id) for servo_id in range(1, chance.randint(2, 4))]
    bench = Bench(chance, joints, compiled(joints, protocol, tmp_path))
    bench.rest()
    bench.remember()
    bench.start()
    bench.move()
    bench.reboot()
    bench.move()
    bench.start_again()
    bench.move()
