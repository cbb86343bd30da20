"""Campaign: random robots that a scripted hand sets up, calibrates and teaches.

References, directions, limits, IDs, rates, models and the file's layout are random. The file that was written
is judged byte by byte but for the values, and the values by the servos. CI runs a sample; all of it:

    pytest --campaign=release tests/hand/test_hands_campaign.py
"""

import math
import random
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest
from tests.kit.campaigns import campaign
from tests.kit.hands import HandLine, Script, written

from dxlrun.compile.robot_compiler import compile_files
from dxlrun.description.reading import read_robot
from dxlrun_hand.commands.calibrate import calibrated
from dxlrun_hand.commands.setup import set_up
from dxlrun_hand.servo_setup import ServoSetup, factory_rate
from dxlsim.simulation_plan import ServoConfig
from dxlwire.control_table import ControlTable, find_table

MODELS = {1.0: ("AX-12A", "MX-28", "MX-64"), 2.0: ("XL430-W250", "XM430-W350", "XL330-M288", "XH540-W150")}
NAMES = ("shoulder", "elbow", "wrist", "neck", "hip")


@dataclass
class Joint:
    """A joint as it is, and how the file has it before."""

    name: str
    model: str
    servo_id: int
    reference: float
    """degrees, as the limits"""
    direction: int
    lower: float
    upper: float
    begins: float
    """Where its servo is at first"""
    table: ControlTable

    def at(self, position: float) -> float:
        """Return the servo's angle at a position of the joint, degrees."""
        return self.reference + self.direction * position


@dataclass
class World:
    """A robot file of random layout, and its servos as they come from the factory."""

    protocol: float
    rate: int
    joints: list[Joint]
    text: str
    line: HandLine

    def turn_to(self, index: int, degrees: float, look: Callable[[], object], *, wander: float = 0.0) -> None:
        """Turn a servo to an angle, a bit there and back on the way."""
        servo = self.line.bus.servos[index]
        for angle in (degrees - wander, degrees) if wander else (degrees,):
            self.line.turn(servo.servo_id, angle - math.degrees(servo.shaft_angle), look)


def drawn(chance: random.Random) -> World:
    protocol = chance.choice((1.0, 2.0))
    count = chance.randint(1, 4)
    ids = chance.sample(range(1, 253), count)
    joints = [joint(chance, name, protocol, servo_id) for name, servo_id in zip(NAMES, ids, strict=False)]
    every = [set(one.table.baud_rates.values()) for one in joints]
    rate = chance.choice(sorted(rate for rate in set.intersection(*every) if 50_000 < rate <= 3_000_000))
    line = HandLine(
        *(ServoConfig(1, one.model, math.radians(one.begins)) for one in joints), protocol=protocol, rate=rate
    )
    for one, servo in zip(joints, line.bus.servos, strict=True):
        codes = one.table.baud_rates
        started = chance.choice([factory_rate(one.table), factory_rate(one.table), *codes.values()])
        servo.poke("baud_rate", next(code for code, value in codes.items() if value == started))
        servo.poke("id", chance.choice([1, 1, chance.randint(1, 252)]))
    line.connect()
    return World(protocol, rate, joints, text(chance, joints, protocol, rate), line)


def joint(chance: random.Random, name: str, protocol: float, servo_id: int) -> Joint:
    """Draw a joint whose ends lie in the turn of its servo."""
    model = chance.choice(MODELS[protocol])
    table = find_table(model, protocol)
    reach = math.degrees(table.max_tick * table.rad_per_tick)
    low, high = sorted(chance.sample(range(3, int(reach) - 3), 2))
    while high - low < 15:
        low, high = sorted(chance.sample(range(3, int(reach) - 3), 2))
    reference, direction = chance.uniform(low, high), chance.choice((1, -1))
    ends = sorted((direction * (low - reference), direction * (high - reference)))
    return Joint(name, model, servo_id, reference, direction, *ends, chance.uniform(low, high), table)


def text(chance: random.Random, joints: list[Joint], protocol: float, rate: int) -> str:
    """Return a robot file whose values are wrong, in a layout that is drawn."""
    lines = [
        f"# {chance.choice(('an arm', 'ein Arm für später ☂'))}",
        "name:   arm",
        'arguments: {port: {default: /dev/null, help: "the port"}}',
        "buses:",
        f'  main: {{port: "${{port}}", protocol: {protocol}, baud_rate: {rate}, adapter: {{latency: 0 ms}}}}',
        "loop: {rate: 2}",
        "joint_defaults: {bus: main, direction: 1}"
        if (default := chance.random() < 0.3)
        else "# no defaults",
        "joints:",
    ]
    for one in joints:
        unit, number = chance.choice(
            (("deg", f"{chance.randint(100, 200)}"), ("rad", f"{chance.randint(2, 3)}.5"))
        )
        keys = [f"id: {one.servo_id}", f"model: {one.model}", f"reference:  {number} {unit}"]
        keys += [] if default else ["bus: main", f"direction: {chance.choice((1, -1))}"]
        chance.shuffle(keys)
        limits = chance.choice((None, "[-1 deg,   10 deg]", "[-0.1 rad, 0.1 rad]"))
        keys += [f"limits: {{position: {limits}, velocity: 60 deg/s}}"] if limits else []
        if chance.random() < 0.5:
            lines.append(f"  {one.name}:   {{ {', '.join(keys)} }}  # {one.name} {chance.random()}")
        else:
            lines.append(f"  {one.name}:  # block")
            lines += [f"     {key}   # {chance.random()}" for key in keys]
    names = ", ".join(one.name for one in joints)
    kind = "joint_trajectory_controller, command_interface: position"
    lines += [f"controllers: {{arm: {{type: {kind}, joints: [{names}]}}}}", "# end", ""]
    return chance.choice(("\n", "\r\n")).join(lines)


def masked(text: str) -> str:
    """Return a text without the values that a calibration changes, and without the keys that it may add."""
    text = re.sub(r"(, |\r?\n +)limits: \{position: \[[^]]*\]\}(?= \}|, |\r?\n)", "", text)
    if "joint_defaults:" in text:
        text = re.sub(r"(, |\r?\n +)direction: -1(?= \}|, |\r?\n)", "", text)
    text = re.sub(r"reference:  [-\d.]+ ", "reference: # ", text)
    text = re.sub(r"direction: -?1", "direction: #", text)
    return re.sub(r"position: \[[-\d.]+ (deg|rad),( +)[-\d.]+ ", r"position: [# \1,\2# ", text)


@campaign(ci=3, night=12, release=50)
def test_random_robots_are_set_up_and_calibrated(number: int, chance: random.Random, tmp_path: Path) -> None:
    world = drawn(chance)
    print(world.text)
    robot = written(tmp_path, world.text)
    line = world.line
    setting_up = Script(
        *(
            (f"servo for {one.name} (", lambda index=index: line.connect(index))
            for index, one in enumerate(world.joints)
        ),
        ("Connect all", lambda: line.connect(*range(len(world.joints)))),
    )
    assert set_up(ServoSetup(read_robot(robot, {}), setting_up), line.open, tuple) == 0, setting_up.text
    for one, servo in zip(world.joints, line.bus.servos, strict=True):
        assert servo.servo_id == one.servo_id
        assert one.table.baud_rates[servo.registers["baud_rate"]] == world.rate
    steps: list[tuple[str, str | Callable[..., str | None]]] = [("hold the joints", "")]

    def to_zero() -> None:
        for index, one in enumerate(world.joints):
            world.turn_to(index, one.reference, lambda: None)

    steps.append(("zero pose", to_zero))
    for index, one in enumerate(world.joints):
        for question, end in (("positive", one.upper), ("negative", one.lower)):
            there, wander = one.at(end), chance.choice((0.0, 0.2 * one.direction * end))

            def move(
                look: Callable[[], object], index: int = index, there: float = there, wander: float = wander
            ) -> None:
                world.turn_to(index, there, look, wander=wander)

            steps.append((question, move))
    script = Script(*steps, ("Write this", "y"))
    assert calibrated(compile_files(robot, {}, []), script, line.open, (), ()) == 0, script.text
    after = robot.read_bytes().decode()
    assert masked(after) == masked(world.text), script.text
    plan = compile_files(robot, {}, []).plan
    for one, compiled in zip(world.joints, plan.loop.joints, strict=True):
        (_, servo), tick = plan.servos_by_joint[one.name][0], math.degrees(one.table.rad_per_tick)
        assert servo.direction == one.direction
        assert math.degrees(servo.reference) == pytest.approx(one.reference, abs=2 * tick)
        ends = math.degrees(compiled.lower), math.degrees(compiled.upper)
        assert ends == (
            pytest.approx(one.lower, abs=0.15 + 3 * tick),
            pytest.approx(one.upper, abs=0.15 + 3 * tick),
        )
