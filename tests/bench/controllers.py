"""How long update() of each standard controller takes with 20 joints, in motion.

    python tests/bench/controllers.py [--updates 5000] [--joints 20]

Prints the median and the 99th percentile in us: of update() alone, without gathering and gate, with states
that change each time. Processor time: on a busy machine the percentile of the time that passes is that of the
other programs. The bound is a median of 60 us.
"""

from __future__ import annotations

import argparse
import gc
import pkgutil
import statistics
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dxlrun import (
    Commands,
    Context,
    Controller,
    JointLimits,
    MotorLoad,
    MotorModel,
    Outcome,
    ServoModel,
    States,
    Stribeck,
)
from dxlrun_controllers.plugin import dxlrun_controllers

PERIOD_NS = 1_000_000
LIMIT = {"lower": -2.0, "upper": 2.0, "velocity": 5.0, "effort": 2.0}
GAINS = {"p": 3.0, "i": 1.0, "d": 0.1}
MOTOR = MotorModel(
    "MX-64", 12.0, 1.6, 3.6, 0.011, 0.1, 0.08, 0.001, Stribeck(0.05, 0.2), 0.158, 32, 1_000_000,
    MotorLoad(0.01, 0.5),
)  # fmt: skip
SERVO = ServoModel("XM430-W350", "ID 1 on bus main", "A", 4.1, 2.3, 12.0, 4.8, 80.0)
LIMITS = {"acceleration": "20 rad/s^2", "velocity": "3 rad/s"}


class Silent:
    """A goal whose reports go nowhere."""

    number = 1

    def __init__(self, kind: str) -> None:
        self.kind = kind

    def feedback(self, progress: float, error: float = 0.0) -> None:
        """Report nothing."""

    def end(
        self,
        outcome: Outcome,
        text: str = "",
        joint: str = "",
        error: float = 0.0,
        joints: Sequence[str] | None = None,
    ) -> None:
        """Report nothing."""


@dataclass(frozen=True)
class Case:
    """A controller with its parameters, and what it works on."""

    name: str
    type: str
    parameters: dict[str, object]
    command: tuple[str, dict[str, object]] | None = None
    chained: bool = False


def cases(joints: tuple[str, ...]) -> Iterator[Case]:
    """Return the controllers in each of their ways to command."""
    count, own = len(joints), {"joints": joints}
    lift = [1.0 - 0.1 * index for index in range(count)]
    points = [
        {"time": 1 + t, "positions": lift if t % 2 else [0.0] * count, "velocities": [0.1] * count}
        for t in range(60)
    ]
    trajectory = ("trajectory", {"points": points})
    for interface in ("position", "posvel", "velocity", "effort"):
        more = {"gains": GAINS} if interface in ("velocity", "effort") else {}
        parameters = {**own, **more, "command_interface": interface, "tolerances": {"path": "1000 rad"}}
        yield Case(f"trajectory, {interface}", "joint_trajectory_controller", parameters, trajectory)
    short = ("trajectory", {"points": points[:3]})  # 2 s of the 5: it is recorded, then learned
    for interface in ("position", "posvel"):
        parameters = {**own, "command_interface": interface, "motions": 1, "longest": "3 s"}
        yield Case(f"ilc, {interface}", "ilc_controller", parameters, short)
    for interface in ("effort", "velocity", "pwm", "position"):
        parameters = {**own, "gains": GAINS, "command_interface": interface, "derivative_filter": "5 ms"}
        yield Case(f"pid, {interface}", "pid_controller", parameters, chained=True)
    parameters = {**own, "gains": GAINS, "reference": "velocity"}
    yield Case("pid of velocities", "pid_controller", parameters, chained=True)
    yield Case("limiter, passing on", "joint_limiter", {**own, "limits": LIMITS}, chained=True)
    slow = {"acceleration": "20 rad/s^2", "velocity": "0.2 rad/s"}
    yield Case("limiter, behind", "joint_limiter", {**own, "limits": slow}, chained=True)
    group = ("posvel", {"positions": lift, "velocities": lift})
    yield Case("group, posvel", "joint_group_posvel_controller", own, group)
    half = count // 2
    base = {"left": joints[:half], "right": joints[half:], "separation": "0.4 m", "radius": "0.05 m"}
    yield Case("diff_drive", "diff_drive_controller", base, ("velocity", {"linear": 0.3, "angular": 0.2}))
    pairs = [{"joint": joint, "leader": f"leader_{joint}"} for joint in joints]
    yield Case("leader_follower", "leader_follower", {"pairs": pairs})
    pose = dict(zip(joints, (f"{value} rad" for value in lift), strict=True))
    motions = {"wave": {"steps": [{"time": "30 s", "pose": pose}], "repeat": 9}}
    yield Case(
        "keyframe_player", "keyframe_player", {**own, "motions": motions}, ("play", {"motion": "wave"})
    )
    samples = {"period": 0.01, "rows": [list(lift)] * 3000}
    yield Case("sample_player", "sample_player", own, ("samples", samples))
    yield Case("feed_forward", "feed_forward", own, chained=True)
    yield Case("gravity_compensation", "gravity_compensation", own, chained=True)
    yield Case("thermal_governor", "thermal_governor", own, chained=True)
    yield Case("gripper (1 joint)", "gripper_controller", {"joint": "j0"}, ("grip", {"position": 1.0}))
    yield Case("broadcaster", "joint_state_broadcaster", {})


def chain_of(joints: tuple[str, ...]) -> str:
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


def median_us(case: Case, joints: tuple[str, ...], updates: int) -> tuple[float, float]:
    """Return median and 99th percentile of update(), us."""
    kind: type[Controller[Any]] = pkgutil.resolve_name(dxlrun_controllers()[case.type])
    parameters = kind.Parameters.model_validate(case.parameters)
    interfaces = kind.interfaces(parameters, joints)
    count = len(interfaces.joints)
    controller = kind(parameters)
    context = Context(
        name=case.type,
        joints=interfaces.joints,
        period_ns=PERIOD_NS,
        limits=JointLimits(
            **{each: np.full(count, LIMIT.get(each, np.nan)) for each in JointLimits.__struct_fields__}
        ),
        states=States.empty(count),
        goals=Commands.empty(count),
        commands=Commands.empty(count),
        say=lambda text: None,
        warn=lambda text: None,
        publish=lambda topic="", message=None: None,
        references=Commands.empty(count),
        reads=np.zeros(len(interfaces.reads)),
        into=(),
        motors=(MOTOR,) * count,
        servos=(SERVO,) * count,
        urdf=chain_of(joints),
        provided=np.zeros(len(interfaces.provides)),
        keep=lambda state: None,
    )
    states, references = context.states, context.references
    states.motion.fill(0.0)
    states.valid.fill(True)
    states.age_ns.fill(0)
    controller.on_configure(context)
    controller.on_activate(0)
    if case.command is not None:
        name, values = case.command
        data = kind.prepare(name, kind.Commands[name].model_validate(values), parameters)
        if name in kind.Goals:
            controller.on_goal(Silent(name), data, 0)
        else:
            controller.on_command(name, data, 0)
    taken = []
    noise = np.random.default_rng(1).normal(scale=0.01, size=(64, 3, count))
    for index in range(1, updates + 1):
        time_ns = index * PERIOD_NS
        states.motion[:] = noise[index % 64]
        if case.chained:
            references.position[:] = np.sin(time_ns * 1e-9)
            references.velocity[:] = np.cos(time_ns * 1e-9)
        begun = time.thread_time_ns()
        controller.update(time_ns, PERIOD_NS)
        taken.append(time.thread_time_ns() - begun)
    return statistics.median(taken) * 1e-3, float(np.percentile(taken, 99)) * 1e-3


def main() -> None:
    """Measure, and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--updates", type=int, default=5000)
    parser.add_argument("--joints", type=int, default=20)
    options = parser.parse_args()
    joints = tuple(f"j{index}" for index in range(options.joints))
    gc.disable()  # as in the loop
    for case in cases(joints):
        median, late = median_us(case, joints, options.updates)
        print(f"{case.name:24} {median:6.1f} us median {late:7.1f} us 99 %")


if __name__ == "__main__":
    main()
