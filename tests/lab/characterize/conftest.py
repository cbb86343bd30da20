"""One simulated joint with known properties, measured on virtual time."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import pytest

from dxlrun_lab.characterize.joint_figure import JointFigure
from dxlrun_lab.characterize.procedure import TOLERANCE, CharacterizationExperiment
from dxlrun_lab.guided.choice import situation_of
from dxlrun_lab.guided.experiment import perform_experiment
from dxlrun_lab.guided.rig import Rig

PROTOCOLS = {"AX-12A": 1.0, "MX-64": 1.0, "XL430-W250": 2.0, "XM430-W350": 2.0}


@dataclass
class Done:
    result: Any
    rig: Rig

    def figure(self, name: str) -> JointFigure:
        (found,) = [one for one in self.result.joints[0].figures if one.name == name]
        return found


@pytest.fixture
def measures(own_rig, tmp_path):
    """Characterize a joint, or perform another experiment; other keys are those of the joint."""

    def measure(measurements, model="MX-64", *, reach=1.0, tolerance=TOLERANCE, each_cycle=None,
                baud_rate=1_000_000, rate=100, direction=1, more="", **keys):  # fmt: skip
        reference = "150 deg" if model == "AX-12A" else "180 deg"
        joint = f"bus: main, id: 1, model: {model}, reference: {reference}, direction: {direction}"
        joint += "".join(f", {key}: {value}" for key, value in keys.items())
        bus = f"port: sim, protocol: {PROTOCOLS[model]}, baud_rate: {baud_rate}, adapter: {{latency: 0 ms}}"
        file = tmp_path / "bench.yaml"
        file.write_text(
            f"name: bench\nbuses: {{main: {{{bus}}}}}\nloop: {{rate: {rate}}}\n"
            f"joints:\n  joint: {{{joint}}}\n{more}"
        )
        rig = own_rig(file)
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
