"""One simulated joint with known properties, measured on virtual time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import pytest

from dxlrun_lab.characterize.joint_figure import JointFigure
from dxlrun_lab.characterize.procedure import TOLERANCE, CharacterizationExperiment
from dxlrun_lab.guided.choice import situation_of
from dxlrun_lab.guided.experiment import perform_experiment
from dxlrun_lab.guided.rig import Rig

REFERENCES = {"AX-12A": "150 deg"}


@dataclass
class Done:
    result: Any
    rig: Rig

    def figure(self, name: str) -> JointFigure:
        (found,) = [one for one in self.result.joints[0].figures if one.name == name]
        return found


Measures = Callable[..., Done]


def robot_text(  # the keys of a robot file, each with what most tests leave as it is
    model: str = "MX-64",
    *,
    protocol: float = 1.0,
    baud_rate: int = 1_000_000,
    rate: float = 100,
    simulation: str = "{}",
    registers: str = "{}",
    limits: str = "{}",
    direction: int = 1,
    more: str = "",
) -> str:
    bus = f"port: sim, protocol: {protocol}, baud_rate: {baud_rate}, adapter: {{latency: 0 ms}}"
    joint = (
        f"bus: main, id: 1, model: {model}, reference: {REFERENCES.get(model, '180 deg')}, "
        f"direction: {direction}, simulation: {simulation}, registers: {registers}, limits: {limits}"
    )
    top = f"name: bench\nbuses: {{main: {{{bus}}}}}\nloop: {{rate: {rate}}}\n"
    return f"{top}joints:\n  joint: {{{joint}}}\n{more}"


@pytest.fixture
def measures(stage):
    """Characterize a joint, or perform another experiment."""

    def measure(measurements, model="MX-64", *, reach=1.0, tolerance=TOLERANCE, each_cycle=None, **keys):
        file = stage.directory / f"{len(stage.rigs)}.yaml"
        file.write_text(robot_text(model, **keys))
        rig = stage.rig(file)
        if each_cycle is not None:
            rig.robot.link.each_cycle = lambda cycle: each_cycle(rig, cycle)
        experiment = (
            CharacterizationExperiment(measurements, tolerance)
            if isinstance(measurements, Sequence)
            else measurements
        )
        situation = situation_of(rig, ["joint"], {"joint": (-reach, reach)})
        done = perform_experiment(rig, experiment, situation)
        return Done(experiment.evaluate_recordings(situation, done.recorded, done.why), rig)

    return measure
