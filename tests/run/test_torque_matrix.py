"""Every standard controller in every way to get torque: no joint moves until a client commands it.

A robot has a joint for each way to command of each standard controller (`tests.kit.laws`). Clients command
all of them; their servos lose torque, and each shaft is turned by 100 deg. When torque is back, the simulated
shafts are watched, then clients command again. Robots of pairs of servos and of differentials have a joint,
or two, for each mode.

Every way runs with plain joints, and every robot returns after a brown-out. Omitted is what leads to the same
return: a pause, a line or a requested reboot of other joints; all else of a gear; all but a request of
Protocol 1.0; a request of pairs.
"""

import itertools
import json
import math
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, partial
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from tests.kit.laws import CONTROLLERS, Case, cases, chain_of
from tests.kit.line_faults import turn_by_hand
from tests.kit.selection import CHECKED_LESS
from tests.kit.virtual_run import MS, VirtualRun, ask, replayed

from dxlrun.channels.answers import Refusal
from dxlrun.channels.cycle import Torque
from dxlrun.channels.event_records import EventCode
from dxlrun.plan.policy_plan import SLOW_SPEED
from dxlrun.plan.robot_plan import Plan
from dxlrun.testing import Log, plan_of, read_log
from dxlsim.bus.simulated_bus import SimulatedBus
from dxlsim.servo.simulated_servo import SimulatedServo
from dxlwire.modes import Mode

TURN = math.radians(100)
TICK = math.tau / 4096
BEGUN_MS, LOST_MS, TURNED_MS = 100, 800, 950
FOLLOWED_MS = 500  # Long enough for the slowest joint
STEP_MS = 20  # Between two looks at the shafts
WITHOUT_JOINTS = {
    "battery_state_broadcaster", "device_command_controller", "fall_reflex", "imu_sensor_broadcaster",
    "joint_state_broadcaster", "sensor_broadcaster",
}  # fmt: skip
MOTORS = Path(__file__).parents[2] / "robots/motors"
LIMIT = {"plain": 170, "geared": 80, "differential": 85}
COUPLED = ("pairs", "differential")
"""Robots of joints with several servos: two on one axis, or a differential for two joints."""
ROBOTS = ("plain", "geared", "protocol 1", *COUPLED)
PERIOD_MS = 20


@dataclass(frozen=True)
class Steered:
    """One way to command: its joints, its controllers, and what clients send."""

    case: Case
    joints: tuple[str, ...]
    leader: str
    controllers: dict[str, dict[str, Any]]
    top: str  # The controller that clients command
    asks: tuple[tuple[str, dict[str, Any]], ...]
    interfaces: tuple[str, ...]

    @property
    def other(self) -> str:
        """Another mode for its joints, and the controller that has it."""
        return "velocity" if "position" in self.interfaces else "position"


HAS_GRAVITY = find_spec("mujoco") is not None


@cache
def steered(each: int = 1) -> tuple[Steered, ...]:
    """Return every standard controller that claims a joint and is installed, in each of its ways to command.

    `each`: how many joints each has at least.
    """
    found = []
    for index, case in enumerate(cases(("x", "y"))):
        if case.type in WITHOUT_JOINTS or (case.type == "gravity_compensation" and not HAS_GRAVITY):
            continue
        count = 2 if case.type == "diff_drive_controller" else each
        names = (f"j{index}", f"k{index}")[:count]
        found.append(_steered(index, next(itertools.islice(cases(names), index, None)), names))
    return tuple(found)


def _steered(index: int, case: Case, joints: tuple[str, ...]) -> Steered:
    name, asks = f"c{index}", tuple(case.asks[-1:])
    controllers = {name: {"type": case.type, **json.loads(json.dumps(case.keys))}}
    if case.type == "keyframe_player":
        for motion in controllers[name]["motions"].values():
            for step in motion["steps"]:
                step["time"] = "2 s"  # as fast as a geared servo can
    parameters = case.controller.Parameters.model_validate(case.keys)
    interfaces = case.controller.interfaces(parameters, joints)
    leader = f"l{joints[0]}" if case.type == "leader_follower" and not asks else ""
    top = name
    if case.into:
        controllers[name]["into"] = f"{name}_lower"
        gains = {"gains": {"p": 3.0, "d": 0.1}, "derivative_filter": "5 ms"}
        below = {"type": "pid_controller", "command_interface": "effort", "joints": [*joints]}
        controllers[f"{name}_lower"] = below | gains
    if interfaces.reference and not asks:
        what = "position" if "position" in interfaces.reference else interfaces.reference[0]
        top, plural = f"{name}_upper", {"pwm": "pwm"}.get(what, f"{what}s")
        above = {"type": f"joint_group_{what}_controller", "joints": [*joints], "into": name}
        controllers[top], asks = above, ((plural, {plural: [0.9]}),)
    return Steered(case, joints, leader, controllers, top, asks, interfaces.command)


@pytest.mark.needs("physics")
def test_every_standard_controller_is_in_the_matrix():
    """A new standard type fails here until `tests.kit.laws` has a case for it."""
    assert {one.case.type for one in steered()} | WITHOUT_JOINTS == set(CONTROLLERS)
    assert all(
        not one.controller.interfaces(one.controller.Parameters.model_validate(one.keys), ("x", "y")).command
        for one in cases(("x", "y"))
        if one.type in WITHOUT_JOINTS
    )


@cache
def compiled(kind: str, policy: str) -> tuple[Plan, tuple[Steered, ...]]:
    """Return the plan of a robot with a joint for each way to command, and those ways."""
    text, ways = robot_text(kind, policy)
    with TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "robot.yaml").write_text(text)
        moved = [joint for one in ways if one.case.type == "cartesian_controller" for joint in one.joints]
        weights = [one.joints[0] for one in ways if one.case.type == "gravity_compensation"]
        urdf = chain_of([*moved, *weights]).replace('mass value="0.1"', 'mass value="1e-9"')
        (folder / "matrix.urdf").write_text(urdf)
        for motor in MOTORS.glob("*.motor.yaml"):  # without a load, as the simulated joints
            lines = motor.read_text().splitlines()
            (folder / motor.name).write_text(
                "\n".join(line for line in lines if not line.startswith("load:"))
            )
        return plan_of(folder / "robot.yaml", duration_s=8.0), ways


def robot_text(kind: str, policy: str) -> tuple[str, tuple[Steered, ...]]:
    """Return a robot file with a joint for each way to command, and those ways."""
    # an MX-64 of Protocol 1.0 has no PWM mode, and measures no current; a differential has no joint of a PWM
    without = {"protocol 1": [("pwm",), ("effort",)], "differential": [("pwm",)]}.get(kind, [])
    ways = tuple(one for one in steered(2 if kind == "differential" else 1) if one.interfaces not in without)
    if kind in COUPLED:  # one for each mode, and one whose goal is followed
        types = ("joint_group_", "joint_trajectory_controller")
        ways = tuple(one for one in ways if one.case.type.startswith(types) and not one.case.into)
        ways = tuple({one.interfaces: one for one in (*ways, ways[0])}.values())
    ways = tuple(
        {(one.case.type, one.interfaces, one.asks[:1] and one.case.into): one for one in ways}.values()
    )
    version, model, adapter = (1.0, "MX-64", 1) if kind == "protocol 1" else (2.0, "XM430-W350", 4)
    limit = LIMIT.get(kind, 170)
    place = (
        f"reference: 180 deg, direction: 1, model: {model}, limits: {{position: [-{limit} deg, {limit} deg]}}"
    )
    place += ", simulation: {inertia: 0.005 kg m^2, gravity: 0 Nm}"
    place += ", gear_ratio: 2" if kind == "geared" else ""
    turn = f"model: {model}, reference: 180 deg"
    joints: dict[str, str] = {}
    wrists: dict[str, str] = {}
    ids = [itertools.count(1) for _ in range(3)]
    for number, one in enumerate(ways):
        bus, own = f"b{number % 3}", ids[number % 3]
        if kind == "differential":
            sides = (
                f"{side}: {{bus: {bus}, id: {next(own)}, {turn}, direction: {way}}}"
                for side, way in (("left", 1), ("right", -1))
            )
            named, servos = ", ".join(one.joints), ", ".join(sides)
            wrists[f"w{number}"] = f"{{type: differential, joints: [{named}], servos: {{{servos}}}}}"
            joints |= dict.fromkeys(one.joints, f"{{{place[place.index('limits') :]}}}")
            continue
        for joint in (*one.joints, *([one.leader] if one.leader else [])):
            limp = ", torque: off" if joint == one.leader else ""
            moved = f"id: {next(own)}, motor: {model}.motor.yaml{limp}"
            if kind == "pairs":
                moved = f"servos: [{{id: {next(own)}}}, {{id: {next(own)}, direction: -1}}]"
            joints[joint] = f"{{bus: {bus}, {place}, {moved}}}"
    line = f"port: sim, protocol: {version}, baud_rate: {adapter}_000_000, return_delay_time: 0 us"
    controllers = {name: keys for one in ways for name, keys in one.controllers.items()}
    for what in ("velocity", "position"):
        others = [joint for one in ways if one.other == what for joint in one.joints]
        controllers[what] = {"type": f"joint_group_{what}_controller", "joints": others, "active": False}
    text = "\n".join((
        "name: matrix",
        "buses:",
        *(f"  b{number}: {{{line}, adapter: {{kind: direct}}}}" for number in range(3)),
        f"loop: {{rate: {1000 // PERIOD_MS}}}",
        "joints:",
        *(f"  {name}: {joint}" for name, joint in joints.items()),
        *(["transmissions:"] if wrists else []),
        *(f"  {name}: {wrist}" for name, wrist in wrists.items()),
        "controllers:",
        *(f"  {name}: {json.dumps(keys)}" for name, keys in controllers.items()),
        f"policies: {{on_returned_servo: {policy}}}",
        "model: {urdf: matrix.urdf}",
    ))  # fmt: skip
    return text, ways


class Story(VirtualRun):
    """A robot on virtual time, its clients, and a hand that turns its shafts."""

    def __init__(self, folder: Path, kind: str, policy: str = "hold") -> None:
        self.kind = kind
        plan, self.ways = compiled(kind, policy)
        super().__init__(plan, folder / "run.mcap")
        self.plans = {one.name: one for one in plan.loop.controllers}
        placed = {
            servo.row: (f"{servo.joint}, {planned.label(servo)}", bus.servo(servo.servo_id))
            for bus, planned in zip(self.buses, plan.buses, strict=True)
            for servo in planned.servos
        }
        self.by_name: dict[str, SimulatedServo] = dict(placed.values())
        self.shafts: dict[str, tuple[str, ...]] = {
            joint: tuple(
                placed[servo][0] for servo in (plan.mechanics.servo_rows(row) if plan.mechanics else (row,))
            )
            for joint, row in self.rows.items()
        }
        """Names of the shafts of each joint's servos."""
        self.joints = [joint for one in self.ways for joint in one.joints]
        self.names = list(dict.fromkeys(name for joint in self.joints for name in self.shafts[joint]))
        self.put: dict[str, float] = {}
        self.watched: list[list[float]] = []
        self.commanded_ms = math.inf
        self.fast: list[list[float]] = []
        self.again: set[str] = set()
        """Controllers that began again where their joints were."""

    def request(self, kind: str, **data: object) -> None:
        self.post(ask(kind, data or None))

    def command_all(self, other: bool = False) -> None:
        """Let clients command every joint; of leaders, turn them by hand."""
        for what, plural in (("velocity", "velocities"), ("position", "positions")) if other else ():
            rows = [self.rows[joint] for one in self.ways if one.other == what for joint in one.joints]
            # A goal on the other side of 0 is never where a joint already is.
            away = -np.copysign(0.9, self.record.states.position[rows])
            goals = away.tolist() if what == "position" else [0.9] * len(rows)
            self.post(self.prepared(what, plural, {plural: goals}))
        for one in self.ways:
            for kind, data in () if other else one.asks:
                self.post(self.prepared(one.top, kind, data))
            if one.leader:
                self.turn_leader(one, math.pi - 0.9)

    def turn_leader(self, one: Steered, angle: float) -> None:
        (name,) = self.shafts[one.leader]
        turn_by_hand(self.by_name[name], angle)

    def turn(self, names: list[str] | None = None) -> None:
        """Turn shafts without torque by 100 deg, toward the middle of their range."""
        for one in self.ways:
            for name in dict.fromkeys(name for joint in one.joints for name in self.shafts[joint]):
                if name in self.put or (names is not None and name not in names):
                    continue
                assert not self.by_name[name].shaft.torque_on or names is not None, name
                angle = self.by_name[name].shaft.angle
                self.put_at(name, angle - math.copysign(TURN, angle - math.pi))
                if one.leader:
                    self.turn_leader(one, math.tau - self.put[name])

    def put_at(self, name: str, angle: float) -> None:
        """Turn a shaft to an angle, rad, with the others that are on its axis."""
        turn_by_hand(self.by_name[name], angle)
        axis = next(names for names in self.shafts.values() if name in names)
        for other in axis if self.kind == "pairs" else (name,):
            self.put[other] = self.by_name[other].shaft.angle
            turn_by_hand(self.by_name[other], self.put[other])

    def watch(self, until: Callable[[], bool], then: Callable[[], object]) -> None:
        """Watch the shafts from now on; when it is time, let clients command again."""
        if self.commanded_ms == math.inf and until():
            self.commanded_ms = self.now_ms
            then()
        elif self.now_ms > self.commanded_ms + FOLLOWED_MS:
            self.stop.request()
            return
        angles = [self.by_name[name].shaft.angle for name in self.names]
        (self.fast if self.commanded_ms < self.now_ms else self.watched).append(angles)
        self.at(self.now_ms + STEP_MS, lambda: self.watch(until, then))

    def all_have_torque(self) -> bool:
        torque = self.record.states.torque
        return all(torque[self.rows[joint]] == Torque.ON for joint in self.joints)

    def judge(self) -> None:
        log = read_log(self.logged())
        assert self.commanded_ms < math.inf, "torque did not come back"
        refused = [one.text for one in self.inbox.answers.values() if isinstance(one, Refusal)]
        assert not refused
        put = np.array([self.put[name] for name in self.names])
        off = np.abs(np.array(self.watched) - put).max(axis=0) / TICK
        moved = {name: f"{ticks:.0f} ticks" for name, ticks in zip(self.names, off, strict=True) if ticks > 2}
        assert not moved
        assert len(self.watched) > 3
        self._judge_commanded()
        self._judge_log(log)

    def _judge_commanded(self) -> None:
        """Every joint follows its clients again, those that are led to positions or by velocities slowly."""
        angles = np.array([self.watched[-1], *self.fast])
        speed = np.abs(np.diff(angles, axis=0)).max(axis=0) / (STEP_MS * 1e-3)
        ratio = 2 if self.kind in {"geared", "differential"} else 1
        for one in self.ways:
            for joint in one.joints:
                places = [self.names.index(name) for name in self.shafts[joint]]
                moved = np.ptp(angles[:, places], axis=0).max()
                assert moved > 5 * TICK, f"{joint} ({one.case.name}) does not follow"
                if one.interfaces[0] in {"position", "velocity"} and not one.case.into:
                    fast = speed[places].max() >= 1.2 * SLOW_SPEED * ratio
                    assert not fast, f"{joint} ({one.case.name}) is fast"

    def _judge_log(self, log: Log) -> None:
        """Goals of before end as aborted and name a joint; controllers that begin again name their own."""
        before_ns = min(LOST_MS, self.commanded_ms) * MS
        joints = {name: self.plans[name].joints for name in self.plans}
        ends = {event.text.split()[1]: event for event in log.events if event.code == EventCode.GOAL_ENDED}
        for event in log.events:
            if event.code == EventCode.GOAL_ACCEPTED and event.t_ns < before_ns:
                end = ends[event.text.split()[1].rstrip(":")]
                named = [*joints[event.source], f"{event.source} was deactivated"]
                why = end.text.partition(" aborted: ")[2]
                assert end.t_ns < LOST_MS * MS or any(name in why for name in named), end.text
            if event.code == EventCode.POLICY and event.text.startswith("restarted at"):
                named = re.findall(r"\b[jk]\d+", event.text.partition(": ")[2])
                assert named
                assert set(named) <= set(joints[event.source]), event.text
                self.again.add(event.source)


WAYS: dict[str, Callable[[Story], None]] = {}


def way(name: str, kinds: tuple[str, ...] = ROBOTS, policy: str = "hold"):
    def enter(story):
        WAYS[name] = (story, kinds, policy)
        return story

    return enter


def faults(story: Story, text: str) -> None:
    story.fault(*(f"{text} bus={bus}" for bus in ("b0", "b1", "b2")))


def turned(story: Story, ms: float = TURNED_MS, *, watch: bool = True) -> None:
    """Turn the shafts, and watch them until all have torque; then clients command again."""
    story.at(ms, story.turn)
    if watch:
        story.at(ms + 1, lambda: story.watch(story.all_have_torque, story.command_all))


def activated(story: Story, ms: float) -> None:
    """Turn the shafts and watch them; activate what was deactivated when all have torque, then command."""

    def again() -> None:
        tops = [name for one in story.ways for name in one.controllers]
        story.request("switch", activate=tops, deactivate=[])

        def command() -> None:
            mask = story.record.active
            if all(mask >> list(story.plans).index(name) & 1 for name in tops):
                story.command_all()
            else:
                story.at(story.now_ms + STEP_MS, command)

        story.at(story.now_ms + STEP_MS, command)

    story.at(ms, story.turn)
    story.at(ms + 1, lambda: story.watch(story.all_have_torque, again))


@way("start", ("plain", *COUPLED))
def _(story: Story) -> None:
    for name in story.names:
        if name not in story.put:
            story.put_at(name, math.pi + 0.4)
    story.put.clear()
    story.turn()
    story.at(1, lambda: story.watch(lambda: story.record.cycle > 5, story.command_all))


@way("return after a brown-out")
def _(story: Story) -> None:
    faults(story, f"brownout at={LOST_MS}ms for=300ms")
    turned(story)


@way("return with the port", ("plain",))
def _(story: Story) -> None:
    faults(story, f"brownout at={LOST_MS}ms for=300ms")
    faults(story, f"unplug at={LOST_MS}ms for=400ms")
    turned(story)


@way("reboot that a client requests", ("plain",))
def _(story: Story) -> None:
    story.at(LOST_MS, lambda: story.request("reboot", joints=story.joints, release=True))
    activated(story, TURNED_MS)


@way("torque that a client requests", ("plain", "protocol 1", "differential"))
def _(story: Story) -> None:
    story.at(LOST_MS, lambda: story.request("torque", joints=story.joints, on=False, release=True))
    activated(story, TURNED_MS)
    story.at(TURNED_MS + 100, lambda: story.request("torque", joints=story.joints, on=True))


@way("torque that a client requests while controllers are active", ("plain", "protocol 1"), policy="limp")
def _(story: Story) -> None:
    faults(story, f"brownout at={LOST_MS}ms for=300ms")
    turned(story)

    def request() -> None:
        torque = story.record.states.torque
        if all(torque[story.rows[joint]] == Torque.OFF for joint in story.joints):
            story.request("torque", joints=story.joints, on=True)
        else:
            story.at(story.now_ms + STEP_MS, request)

    story.at(TURNED_MS + 100, request)


@way("return in a pause", ("plain",))
def _(story: Story) -> None:
    story.at(LOST_MS - 50, lambda: story.request("pause"))
    faults(story, f"brownout at={LOST_MS}ms for=300ms")
    turned(story, watch=False)

    def go_on() -> None:
        story.request("resume")
        story.at(story.now_ms + 200, story.command_all)

    story.at(TURNED_MS + 1, lambda: story.watch(story.all_have_torque, go_on))


@way("another mode", ("plain", *COUPLED))
def _(story: Story) -> None:
    leave = [name for one in story.ways for name in one.controllers]
    story.at(LOST_MS, lambda: story.request("switch", activate=["velocity", "position"], deactivate=leave))

    def turn(bus: SimulatedBus) -> None:
        """Turn the shafts that have no torque after each packet: a change takes a millisecond or two."""
        mine = [name for name in story.names if story.by_name[name] in bus.servos]
        story.turn([name for name in mine if not story.by_name[name].shaft.torque_on])
        if len(story.put) < len(story.names):
            bus.after(1, lambda: turn(bus))

    def ready() -> bool:
        modes = story.record.states.mode
        wanted = {joint: one.other for one in story.ways for joint in one.joints}
        changed = all(modes[story.rows[joint]] == Mode[mode.upper()] for joint, mode in wanted.items())
        return changed and story.all_have_torque()

    def watch() -> None:
        story.watch(ready, lambda: story.command_all(other=True))

    def stand() -> None:
        story.put |= {name: story.by_name[name].shaft.angle for name in story.names}
        until_ms = story.now_ms + 200
        story.watch(lambda: story.now_ms > until_ms, lambda: story.command_all(other=True))

    def watch_when(is_time: Callable[[], bool], then: Callable[[], None], after_ms: float) -> None:
        if is_time():
            story.at(story.now_ms + after_ms, then)
        else:
            story.at(story.now_ms + STEP_MS, lambda: watch_when(is_time, then, after_ms))

    if story.kind == "pairs":  # one servo holds the joint while the mode of the other one changes
        story.at(LOST_MS, lambda: watch_when(ready, stand, after_ms=200))  # until all have stopped
        return
    for bus in story.buses:
        story.at(LOST_MS, partial(turn, bus))
    story.at(LOST_MS, lambda: watch_when(lambda: len(story.put) == len(story.names), watch, after_ms=1))


RESTARTED = (
    "return after a brown-out",
    "return with the port",
    "return in a pause",
    "torque that a client requests while controllers are active",
)
"""Ways in which controllers stay active."""


def pairs() -> Iterator[tuple[str, str]]:
    for kind in ROBOTS:
        yield from ((name, kind) for name, (_, kinds, _) in WAYS.items() if kind in kinds)


@pytest.mark.parametrize(("name", "kind"), [*pairs()])
def test_no_joint_moves_until_a_client_commands_it(tmp_path, record_property, name, kind):
    if not HAS_GRAVITY:
        record_property(CHECKED_LESS, "gravity_compensation needs dxlrun[physics]")
    happens, _, policy = WAYS[name]
    story = Story(tmp_path, kind, policy)
    if name != "start":
        story.at(BEGUN_MS, story.command_all)
    happens(story)
    story.judge()
    stayed = {one for each in story.ways for one in each.controllers} if name in RESTARTED else set()
    assert story.again - {"position", "velocity"} == stayed
    if kind == next(iter(WAYS[name][1])):
        replayed(story.path)
