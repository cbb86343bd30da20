"""Runs of simulated servos for identifications: recorded once, with noise of seeds, spoilt by a test."""

import functools
from dataclasses import dataclass

import numpy as np
import pytest
from msgspec.structs import replace
from numpy.typing import NDArray

from dxlrun.plan.loop_plan import ScheduledCommand
from dxlrun.testing import Log, VirtualRobot, plan_of, read_log
from dxlrun_lab.identify.excitation import Room, excitation
from dxlrun_lab.identify.fit import fit_run
from dxlrun_lab.identify.joint_recording import measured
from dxlrun_lab.identify.known_servo import Servo, servos_in
from dxlrun_lab.identify.result import IdentifiedServo, KnownLoad, identified

GRAVITY, INERTIA = 0.3, 0.005
"""Of the load that the simulated servos move"""
ROBOT = """name: one
buses: {{main: {{port: sim, protocol: {protocol}, baud_rate: 1_000_000, return_delay_time: 0 us}}}}
loop: {{rate: {rate}}}
joints:
  elbow:
    bus: main
    id: 1
    model: {model}
    reference: 150 deg
    direction: {direction}
    {motor}
    simulation: {{inertia: 0.005 kg m^2, gravity: {gravity} Nm, gravity_angle: 20 deg}}
controllers: {{arm: {{type: joint_group_position_controller, joints: [elbow]}}}}
"""


@dataclass(frozen=True)
class Run:
    """One joint's run on simulated servos."""

    log: Log
    servo: Servo

    @property
    def cycles(self) -> NDArray[np.void]:
        """A copy, to be spoilt."""
        return np.array(self.log.cycles)

    def identified(self, cycles: NDArray[np.void], load: KnownLoad) -> IdentifiedServo:
        data = measured(cycles, 0, self.servo)
        return identified(data, fit_run(data), load, "test")

    def noisy(self, seed: int, *, position_ticks: float = 1.0, effort: float = 0.02) -> NDArray[np.void]:
        """Return the cycles with noise on what was measured: normal, and rounded to ticks."""
        random, cycles = np.random.default_rng(seed), self.cycles
        tick = self.servo.tick
        position = cycles["position"][:, 0] + random.normal(0.0, position_ticks * tick, len(cycles))
        cycles["position"][:, 0] = np.round(position / tick) * tick
        spread = effort * float(np.ptp(cycles["effort"][:, 0]))
        cycles["effort"][:, 0] += random.normal(0.0, spread, len(cycles))
        cycles["voltage"][:, 0] = np.round(cycles["voltage"][:, 0] + random.normal(0.0, 0.05, len(cycles)), 1)
        return cycles


@pytest.fixture(scope="session")
def record(tmp_path_factory):
    """Return what records a run of a model's simulated servo, each once."""

    @functools.cache
    def record(model, protocol, *, seconds=14.0, rate=200, **more):
        folder = tmp_path_factory.mktemp("run")
        values = {"direction": 1, "motor": "", "gravity": GRAVITY} | more
        (folder / "one.yaml").write_text(ROBOT.format(model=model, protocol=protocol, rate=rate, **values))
        plan = plan_of(folder / "one.yaml")
        parts = excitation(Room(-0.6, 0.6), seconds, 1 / rate, start=0.0)
        commands = tuple(
            ScheduledCommand(
                at_ns=round((index + 20) * 1e9 / rate),
                controller="arm",
                kind="PositionsCommand",
                data=np.array([goal], dtype="<f8").tobytes(),
                origin="test",
            )
            for index, goal in enumerate(np.concatenate([part.goals for part in parts]))
        )
        loop = replace(plan.loop, commands=commands, end_ns=round((len(commands) + 40) * 1e9 / rate))
        path = folder / "one.mcap"
        VirtualRobot(replace(plan, loop=loop), log=path).run()
        log = read_log(path)
        return Run(log, *servos_in(log, ["elbow"]))

    return record


@pytest.fixture(scope="session")
def mx64(record):
    return record("MX-64", 1.0)


@pytest.fixture(scope="session")
def xl330(record):
    return record("XL330-M288", 2.0)


@pytest.fixture(scope="session")
def fitted_xl330(xl330):
    """Return the noisy run of an XL330, and its fits."""
    run = measured(xl330.noisy(2), 0, xl330.servo)
    return run, fit_run(run)
