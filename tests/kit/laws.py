"""Stories of the standard controllers: each with its keys, and what servos, clients and others do to it."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pkgutil import resolve_name
from typing import Any

import numpy as np
from tests.kit.stages import Stage

from dxlrun import Controller, MotorLoad, MotorModel, Outcome, ServoModel, Stribeck
from dxlrun_controllers.plugin import dxlrun_controllers
from dxlrun_space.plugin import dxlrun_controllers as dxlrun_space_controllers

CONTROLLERS = {**dxlrun_controllers(), **dxlrun_space_controllers()}
"""Import path of each standard controller by its type."""

MOTOR = MotorModel(
    "MX-64", 12.0, 1.6, 3.6, 0.011, 0.1, 0.08, 0.001, Stribeck(0.05, 0.2), 0.158, 32, 1_000_000,
    MotorLoad(0.01, 0.5), torque_per_effort=1.5,
)  # fmt: skip
SERVO = ServoModel("XM430-W350", "ID 1 on bus main", "A", 4.1, 2.3, 12.0, 4.8, 80.0)
LIMITS = {"lower": -1.2, "upper": 1.2, "velocity": 5.0, "acceleration": 20.0, "effort": 2.0}
GAINS = {"gains": {"p": 3.0, "i": 1.0, "d": 0.1}, "derivative_filter": "5 ms"}
Ask = tuple[str, dict[str, Any]]


@dataclass(frozen=True)
class Case:
    """A controller with its keys, what clients send it, and the chain that it is in."""

    type: str
    keys: dict[str, Any]
    asks: Sequence[Ask] = ()
    changes: Sequence[dict[str, Any]] = ()
    """Of its live parameters"""
    others: tuple[str, ...] = ()
    """Joints of the robot beside its own"""
    into: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        shown = (self.keys.get(key) for key in ("command_interface", "reference", "orientation", "odometry"))
        return " ".join(map(str, (self.type, *filter(None, shown), *self.into)))

    @property
    def controller(self) -> type[Controller[Any]]:
        found: type[Controller[Any]] = resolve_name(CONTROLLERS[self.type])
        return found

    def stage(self, **options: Any) -> Stage:
        """Return it on a stage of its own, not active yet."""
        joints = tuple(self.keys.get("joints", ()))
        count = len(joints)
        robot = {"motors": (MOTOR,) * count, "servos": (SERVO,) * count, "urdf": chain_of(joints)}
        place = {"limits": LIMITS, "others": self.others, "into": self.into}
        return Stage(self.controller, self.keys, **{**robot, **place, **options})


def ways(interfaces: str, kind: str, keys: dict[str, Any], *asks: Ask, **more: Any) -> Iterator[Case]:
    """Yield a controller with each of these command interfaces."""
    for interface in interfaces.split():
        yield Case(kind, {**keys, "command_interface": interface}, asks, **more)


def cases(joints: tuple[str, ...] = ("a", "b", "c")) -> Iterator[Case]:
    """Yield every standard controller, in its ways to command."""
    own: dict[str, Any] = {"joints": list(joints)}
    high = [0.9 - 0.02 * number for number in range(len(joints))]
    yield from _motions(own, joints, high)
    positions, velocities = ("positions", {"positions": high}), ("velocities", {"velocities": high})
    law = own | GAINS | {"output_limit": 1.5}
    changed = {"changes": [{"gains": {"p": 1.0}}]}
    yield from ways("effort velocity pwm position", "pid_controller", law, positions, **changed)
    yield Case("joint_position_controller", law | {"reference": "velocity"}, [velocities])
    yield Case("joint_group_position_controller", own, [positions])
    yield Case("joint_group_velocity_controller", own, [velocities])
    yield Case("joint_group_effort_controller", own, [("efforts", {"efforts": high})])
    yield Case("joint_group_pwm_controller", own, [("pwm", {"pwm": high})])
    yield Case("joint_group_posvel_controller", own, [("posvel", {"positions": high, "velocities": high})])
    yield Case("joint_group_poseffort_controller", own, [("poseffort", {"positions": high, "efforts": high})])
    led = {"pairs": [{"joint": joint, "leader": f"l{joint}", "scale": -1.0} for joint in joints]}
    yield from ways("position posvel", "leader_follower", led, changes=[{"speed": "2 rad/s"}])
    free = {"pairs": [{"joint": joint} for joint in joints], "timeout": "1 s"}
    yield Case("leader_follower", free, [positions])
    scaled = {"changes": [{"scale": 0.5}]}
    yield from ways("position effort pwm", "feed_forward", own | {"most": 0.5}, **scaled)
    yield from ways("position effort pwm", "gravity_compensation", own, **scaled, others=("other",))
    yield from ways("position poseffort effort pwm", "thermal_governor", own | {"warn": 50.0, "limit": 60.0})
    place = {"x": 0.0, "y": 0.0, "z": -0.1 * len(joints), "rpy": [0.0, 0.9, 0.0], "path": "joints"}
    poses: list[Ask] = [("twist", {"wy": 0.5}), ("pose", place)]
    yield Case("cartesian_controller", own | {"tip": f"l{len(joints)}", "orientation": "exact"}, poses)
    yield from _machines(joints)


def _motions(own: dict[str, Any], joints: tuple[str, ...], high: list[float]) -> Iterator[Case]:
    low = [-each for each in high]
    way = [{"time": 0.5, "positions": high}, {"time": 1.0, "positions": low, "velocities": [0.1] * len(low)}]
    both: Ask = ("trajectory", {"points": way, "start_in": 1.0})
    first = {"points": [{"time": 1.0, "positions": high[:1]}], "joints": joints[:1], "timeout": 0.8}
    asks, speeds = (both, ("trajectory", first)), [{"speed": speed} for speed in (0.5, 0.0, 2.0)]
    keys = own | {"tolerances": {"path": "1 rad", "goal": "0.1 rad"}}
    player = "joint_trajectory_controller"
    yield from ways("position posvel", player, keys, *asks, changes=speeds)
    yield from ways("velocity effort", player, keys | GAINS, *asks, changes=speeds)
    yield from ways("position posvel", player, own, *asks, into=("lower",))
    yield from ways("position posvel", "ilc_controller", own | {"motions": 2, "longest": "3 s"}, both)
    steps = [
        {
            "time": "300 ms",
            "pause": "50 ms",
            "pose": {a: f"{at} rad" for a, at in zip(joints, row, strict=True)},
        }
        for row in (high, low)
    ]
    pages = {"wave": {"steps": steps, "repeat": 2, "next": "bow"}, "bow": {"steps": steps[:1], "speed": 1.5}}
    plays: list[Ask] = [("play", {"motion": name}) for name in pages]
    keys = own | {"motions": pages, "tolerance": "0.2 rad", "partial": True}
    yield from ways("position posvel", "keyframe_player", keys, *plays, changes=[{"speed": 2.0}])
    keys = own | {"bounds": {"temperature": 70.0, "effort": 0.9, "age": "100 ms"}}
    rows, twice = {"rows": [high, low, high]}, {"rows": [high * 2, low * 2]}
    period = {"period": 0.05}
    yield from ways(
        "position velocity effort pwm", "sample_player", keys, ("rows", rows), ("samples", rows | period)
    )
    yield from ways("posvel", "sample_player", keys, ("samples", twice | period))


def _machines(joints: tuple[str, ...]) -> Iterator[Case]:
    base = {"left": joints[:1], "right": joints[1:], "separation": "0.4 m", "radius": "0.05 m"}
    base |= {"linear": {"acceleration": "1 m/s^2", "jerk": "10 m/s^3"}, "angular": {"velocity": "1 rad/s"}}
    for odometry in ("position", "velocity", "command"):
        twist = ("velocity", {"linear": 0.3, "angular": 0.2})
        yield Case("diff_drive_controller", base | {"odometry": odometry}, [twist])
    grips: list[Ask] = [("grip", {"position": 0.9}), ("positions", {"positions": [-0.5]})]
    gripper = {"joint": joints[0], "timeout": "500 ms"}
    yield Case("gripper_controller", gripper, grips, [{"speed": "1 rad/s"}])
    yield Case("gripper_controller", gripper | {"effort": 0.5}, grips)
    for orientation in ("madgwick", "sensor", "none"):
        yield Case("imu_sensor_broadcaster", {"sensor": "imu", "orientation": orientation})
    yield Case("battery_state_broadcaster", {"voltages": ["power/voltage"], "warn": "11 V", "stop": "10 V"})
    yield Case("fall_reflex", {"imu": "imu", "activate": ["curl"]})
    yield Case("sensor_broadcaster", {"message": "Range", "fields": {"range": "sonar/range"}})
    lit: Ask = ("device_commands", {"values": {"board/led": 0.5}})
    yield Case("device_command_controller", {"commands": ["board/led", "board/buzzer"]}, [lit])
    yield Case("joint_state_broadcaster", {})


def chain_of(joints: Sequence[str]) -> str:
    """Return the URDF of rods of 0.1 kg, one behind the other."""
    rods = (
        f'<joint name="{joint}" type="continuous"><parent link="l{index}"/><child link="l{index + 1}"/>'
        f'<origin xyz="0 0 -0.1"/><axis xyz="0 1 0"/></joint><link name="l{index + 1}"><inertial>'
        '<origin xyz="0 0 -0.05"/><mass value="0.1"/>'
        '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
        "</inertial></link>"
        for index, joint in enumerate(joints)
    )
    return f'<robot name="chain"><link name="l0"/>{"".join(rods)}</robot>'


@dataclass
class Story:
    """What happens to a controller, cycle after cycle, by chance: the same for the same seed.

    Servos follow with a lag, miss replies, become warm; clients send and cancel; references come and go.
    """

    stage: Stage
    case: Case
    seed: int = 0
    quiet: bool = False
    """Nothing comes from clients."""
    period_ns: int = 20_000_000

    def __post_init__(self) -> None:
        self._chance = np.random.default_rng(self.seed)
        self._at = np.nan_to_num(self.stage.states.position)

    def cycles(self, count: int) -> Iterator[np.ndarray]:
        """Yield what is commanded in each cycle, shape (4, joints), and of devices."""
        chance, joints = self._chance, (count, len(self._at))
        drawn = zip(
            chance.random(joints) > 0.02,
            chance.uniform(-0.7, 0.91, joints),
            chance.normal(0, 1, joints),
            chance.normal(11.5, 0.2, joints),
            chance.normal(0.5, 0.1, (count, self.stage.context.reads.size)),
            strict=True,
        )
        for heard, effort, warmer, voltage, reads in drawn:
            if not self.quiet:
                self._steer()
            stage = self.stage
            stage.time_ns += self.period_ns
            stage.controller.update(stage.time_ns, self.period_ns)
            yield np.concatenate([stage.commands.values.ravel(), stage.context.device_commands])
            self._move(heard, effort)
            states = stage.states
            states.temperature[:] = np.rint(
                np.where(np.isnan(states.temperature), 45.0, states.temperature) + warmer
            )
            states.voltage[:] = voltage
            self._read(reads)

    def _steer(self) -> None:
        stage, chance, case = self.stage, self._chance, self.case
        dice = chance.random()
        if case.asks and dice < 0.03:
            kind, command = case.asks[int(chance.integers(len(case.asks)))]
            stage.send(None, kind, **command)
        elif dice > 0.99 and stage.goals and stage.goal.outcome is None:
            stage.cancel()
        elif case.changes and 0.03 < dice < 0.04:
            stage.change(None, **case.changes[int(chance.integers(len(case.changes)))])
        if stage.interfaces.reference and chance.random() < 0.05:
            for row in stage.context.references.values:
                row[:] = np.where(chance.random(row.size) < 0.7, chance.uniform(-1, 1, row.size), np.nan)

    def _move(self, heard: np.ndarray, effort: np.ndarray) -> None:
        states, commands = self.stage.states, self.stage.commands
        np.copyto(self.stage.sent.values, commands.values, where=np.isfinite(commands.values))
        wanted = np.where(np.isfinite(commands.position), commands.position, self._at)
        before, self._at = self._at, self._at + 0.6 * (wanted - self._at)
        states.valid[:] = heard
        np.copyto(states.position, self._at, where=heard)
        np.copyto(states.velocity, (self._at - before) / 0.02, where=heard)
        np.copyto(states.effort, effort, where=heard)
        states.age_ns[:] = np.where(heard, 1000, states.age_ns + self.period_ns)

    def _read(self, values: np.ndarray) -> None:
        reads, chance = self.stage.context.reads, self._chance
        reads[:] = values
        for place, name in enumerate(self.stage.interfaces.reads):
            if name.endswith("/age"):
                reads[place] = chance.choice([0.001, 0.3, 1.0], p=[0.98, 0.01, 0.01])
            elif not name.endswith(("/position", "/velocity")) and chance.random() < 0.01:
                reads[place] = np.nan  # of a sensor; that of a joint is the last one

    def end_goal(self) -> None:
        """End the goal, as the runtime does at a deactivation."""
        if self.stage.goals and self.stage.goal.outcome is None:
            self.stage.goal.end(Outcome.ABORTED)
