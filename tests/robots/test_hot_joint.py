"""A joint whose load is more than its servo can carry for long trips, with a thermal_governor it does not.

The sample begins with hot servos that warm ten times as fast. `DXLRUN_HOT_SECONDS=600 pytest -rP
tests/robots/test_hot_joint.py` has ten minutes from cold ones on, also for servos that warm twice as fast or
half as far as the simulation's.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from dxlrun.testing import read_log, simulated_robot
from dxlrun_analysis.replay import replay_log
from dxlsim.motion import mechanics

SECONDS = float(os.environ.get("DXLRUN_HOT_SECONDS", "18"))
WHOLE = SECONDS >= 600
ROBOT = """\
name: hot
buses: {{main: {{port: sim, protocol: {protocol}, baud_rate: 1_000_000, adapter: {{kind: direct}}}}}}
loop: {{rate: 50}}
joints:
  j:
    {{bus: main, id: 1, model: {model}, reference: 150 deg, direction: 1,
     simulation: {{inertia: 0.02 kg m^2, gravity: {load} Nm, gravity_angle: -90 deg}}}}
controllers:
  hold: {{type: joint_group_position_controller, joints: [j]{into}}}
  governor: {{type: thermal_governor, joints: [j], {keys}, active: {governed}}}
"""
"""At 0 the weight sticks out horizontally."""


@dataclass(frozen=True)
class Case:
    model: str
    protocol: float
    load: float
    """Nm, more than half of the stall torque"""
    keys: str
    limit: float
    """degrees C beyond which the servo trips"""


CASES = (
    Case("XM430-W350", 2.0, 2.4, "command_interface: poseffort", 80.0),
    Case("MX-64", 1.0, 3.4, "reach: 11.3 deg", 80.0),  # measures its output alone, as the next one
    Case("AX-12A", 1.0, 0.85, "reach: 9.4 deg", 70.0),
)


def run(case: Case, folder: Path, *, governed: bool) -> tuple[float, bool, Path]:
    """Return the highest temperature, whether it tripped, and the log."""
    path, log = folder / "robot.yaml", folder / f"{governed}.mcap"
    into = ", into: governor" if governed else ""
    path.write_text(ROBOT.format(**vars(case), into=into, governed=str(governed).lower()))
    robot = simulated_robot(path, duration_s=SECONDS, log=log)
    servo = robot.buses[0].servo(1)
    if not WHOLE:
        servo.set_temperature(case.limit - 9.0)  # above `warn`: some of its torque is taken
    assert robot.run().detail == ""
    read = read_log(log)
    tripped = any("overheating error" in event.text for event in read.events)
    return float(np.nanmax(read.cycles["temperature"])), tripped, log


@pytest.mark.campaign
@pytest.mark.parametrize(
    "heating", [(1.0, 1.0), (0.5, 1.0), (1.0, 0.5), (2.0, 2.0)] if WHOLE else [(0.1, 1.0)]
)
@pytest.mark.parametrize("case", CASES if WHOLE else CASES[::2], ids=lambda case: case.model)
def test_a_loaded_joint_trips_without_and_not_with_a_governor(case, heating, tmp_path, monkeypatch):
    slower, hotter = heating
    monkeypatch.setattr(mechanics, "COOLING_S", mechanics.COOLING_S * slower)
    monkeypatch.setattr(mechanics, "STALLED_RISE_C", mechanics.STALLED_RISE_C * hotter)
    highest, tripped, _ = run(case, tmp_path, governed=False)
    assert tripped or hotter < 1.0  # a weak heater may warm no more
    governed, trips, log = run(case, tmp_path, governed=True)
    assert not trips
    assert governed <= case.limit - 2.0
    print(f"{case.model} {heating}: {highest:.0f} deg C, tripped {tripped}; governed {governed:.0f} deg C")
    record = read_log(log).cycles
    scale = record["source_state"][100:, 0]
    assert (scale >= 0).all()
    assert scale.min() < 0.9
    assert np.abs(np.diff(scale)).max() < 0.05  # smoothly
    assert hotter > 1.0 or scale[-1] > 0.1  # no more than it must
    if not WHOLE and case.protocol == 1.0:
        return  # one replay is enough of a sample
    report = replay_log(log)
    assert (report.different, report.compared) == (0, report.cycles)
