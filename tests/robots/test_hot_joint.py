"""A joint whose load is more than its servo can carry for long trips, with a thermal_governor it does not.

CI begins with hot servos that warm ten times as fast. `pytest --campaign=release -rP
tests/robots/test_hot_joint.py` has ten minutes from cold ones on, also for servos that warm twice as fast or
half as far as the simulation's.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from tests.kit.campaigns import campaign
from tests.kit.virtual_run import VirtualRun, replayed

from dxlrun.testing import read_log
from dxlsim.motion import mechanics

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


def run(case: Case, folder: Path, seconds: float, *, hot: bool, governed: bool) -> tuple[float, bool, Path]:
    """Run the robot from cold servos or hot ones on.

    Returns:
        The highest temperature, whether the servo tripped, and the log.
    """
    into = ", into: governor" if governed else ""
    text = ROBOT.format(**vars(case), into=into, governed=str(governed).lower())
    one = VirtualRun.of_text(folder, text, seconds)
    if hot:
        one.servos["j"].set_temperature(case.limit - 9.0)  # above `warn`: some of its torque is taken
    read = read_log(one.ended())
    tripped = any("overheating error" in event.text for event in read.events)
    return float(np.nanmax(read.cycles["temperature"])), tripped, read.path


def check_governor_prevents_trip(
    case: Case, heating: tuple[float, float], folder: Path, seconds: float, *, hot: bool
) -> Path:
    """Run without a governor and with it; return the log of the governed run."""
    slower, hotter = heating
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mechanics, "COOLING_S", mechanics.COOLING_S * slower)
        patch.setattr(mechanics, "STALLED_RISE_C", mechanics.STALLED_RISE_C * hotter)
        highest, tripped, _ = run(case, folder, seconds, hot=hot, governed=False)
        governed, trips, log = run(case, folder, seconds, hot=hot, governed=True)
    assert tripped or hotter < 1.0  # a weak heater may warm no more
    assert not trips
    assert governed <= case.limit - 2.0
    print(f"{case.model} {heating}: {highest:.0f} deg C, tripped {tripped}; governed {governed:.0f} deg C")
    record = read_log(log).cycles
    scale = record["source_state"][100:, 0]
    assert (scale >= 0).all()
    assert hotter < 1.0 or scale.min() < 0.9  # a weak heater may need less
    assert np.abs(np.diff(scale)).max() < 0.05  # smoothly
    assert hotter > 1.0 or scale[-1] > 0.1  # no more than it must
    return log


@pytest.mark.parametrize("case", CASES[::2], ids=lambda case: case.model)
def test_hot_servo_trips_without_a_governor_and_not_with_one(case, tmp_path):
    log = check_governor_prevents_trip(case, (0.1, 1.0), tmp_path, 18.0, hot=True)
    if case.protocol == 2.0:  # one replay is enough at each commit
        replayed(log)


@campaign(ci=0, night=600, release=600)
@pytest.mark.parametrize("heating", [(1.0, 1.0), (0.5, 1.0), (1.0, 0.5), (2.0, 2.0)])
@pytest.mark.parametrize("case", CASES, ids=lambda case: case.model)
def test_cold_servo_trips_without_a_governor_and_not_with_one(case, heating, tmp_path, amount):
    replayed(check_governor_prevents_trip(case, heating, tmp_path, amount, hot=False))
