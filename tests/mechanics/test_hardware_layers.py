"""Layers between joints and servos: a feature transforms goals by one file."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from tests.kit.stories import replayed

from dxlrun import features
from dxlrun.channels.cycle import Commands, States
from dxlrun.channels.event_records import EventSink
from dxlrun.contract.hardware import Hardware
from dxlrun.dynamixel.hardware_layer import HardwareLayer, HardwareLayers, LayerStage, PreparedLayer
from dxlrun.features.feature import Feature, S
from dxlrun.features.mechanics.joint_hardware import JointHardware
from dxlrun.plan.robot_plan import Plan
from dxlrun.testing import simulated_robot

OFFSET = 0.1
ROBOT = """\
name: pair
buses:
  main: {port: sim, protocol: 2.0, baud_rate: 1_000_000, return_delay_time: 0 us, adapter: {kind: direct}}
loop: {rate: 50}
joints:
  pan: {bus: main, id: 1, model: XL430-W250, reference: 180 deg, direction: 1}
  tilt: {bus: main, id: 2, model: XL430-W250, reference: 180 deg, direction: 1}
controllers:
  arm: {type: joint_group_position_controller, joints: [pan, tilt]}
"""
MOTION = """\
name: move
motions:
  - controller: arm
    points:
      - {time: 0 s, joints: {pan: {position: 0.5 rad}, tilt: {position: 0 rad}}}
"""


class OffsetLayer(HardwareLayer):
    """Adds an offset to the position goals of joints from their first motion on."""

    def __init__(self, hardware: Hardware, above: Commands, below: Commands) -> None:
        super().__init__(hardware)
        self.above, self.below = above, below
        self.first = np.full(above.position.shape, np.nan)

    def start(self, engaging: Callable[[], None] = lambda: None) -> None:
        super().start(engaging)
        self.above.values[:] = self.below.values
        self.first[:] = self.above.position

    def write_goals(self) -> None:
        self.below.values[:] = self.above.values
        self.below.position[self.above.position != self.first] += OFFSET
        super().write_goals()

    def follow_goals(self, rows: Sequence[int]) -> None:
        self.first[list(rows)] = self.above.position[list(rows)]
        super().follow_goals(rows)


def prepare_offset(plan: Plan, states: States, goals: Commands, events: EventSink) -> PreparedLayer | None:
    """Return the layer for every robot."""
    below = Commands.empty(len(plan.loop.joints))
    return PreparedLayer(states, below, lambda hardware: OffsetLayer(hardware, goals, below))


class OffsetFeature(Feature):
    """A feature that has a layer only."""

    def stage(self, kind: type[S]) -> S | None:
        found = LayerStage(prepare_offset)
        return found if isinstance(found, kind) else None


@pytest.fixture
def with_offset(monkeypatch: pytest.MonkeyPatch) -> None:
    """Register the layer next to the loop."""
    monkeypatch.setattr(features, "FEATURES", (OffsetFeature("offset", ""), *features.FEATURES))
    monkeypatch.setattr(features, "_installed", features._installed.__wrapped__)


def _moved(tmp_path: Path, log: Path | None = None) -> tuple[float, float]:
    """Return goal and position of a joint that was sent to 0.5 rad."""
    path, motion = tmp_path / "pair.yaml", tmp_path / "motion.yaml"
    path.write_text(ROBOT)
    motion.write_text(MOTION)
    robot = simulated_robot(path, play=[motion], duration_s=2.0, log=log)
    robot.run()
    return float(robot.record.goals.position[0]), float(robot.record.states.position[0])


def test_layer_changes_what_servos_get_and_no_record(with_offset, tmp_path):
    goal, position = _moved(tmp_path, tmp_path / "run.mcap")
    assert goal == pytest.approx(0.5, abs=1e-6)
    assert position == pytest.approx(0.5 + OFFSET, abs=0.01)
    replayed(tmp_path / "run.mcap")


def test_layer_above_the_mechanics_has_rows_of_joints(with_offset, plan):
    coupled = plan()
    states, goals = States.empty(5), Commands.empty(5)
    layers = HardwareLayers(coupled, states, goals, lambda *_: None)
    assert len(layers.goals.position) == len(coupled.mechanics.servos) > 5
    assert layers.refusals is not None
    built = layers.build(HardwareLayer(None))
    assert isinstance(built, OffsetLayer)
    assert built.above is goals
    assert isinstance(built._hardware, JointHardware)
