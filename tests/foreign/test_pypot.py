"""pypot's own sample robot (six MX-28, four of them `indirect`), moved by pypot as it is published.

pypot is under the GPL: it runs as a program of its own, and nothing here imports it. It writes Moving Speed
with the goals, with bit 10 set for joints that are `indirect`.
"""

import importlib.util
import json
import subprocess
import sys
from typing import Any

import pytest

from dxlsim.simulation_plan import BusConfig, ServoConfig

IDS = range(11, 17)
MIDDLE = 3.141593
"""180 degrees, pypot's 0 of an MX-28, as rad from raw 0."""
BUSES = (BusConfig("ergo", 1_000_000, tuple(ServoConfig(each, "MX-28", MIDDLE) for each in IDS), 1.0),)
PROGRAM = """\
import json, sys, time
from pypot.robot import from_config
from pypot.robot.config import ergo_robot_config

ergo_robot_config["controllers"]["my_dxl_controller"]["port"] = sys.argv[1]
robot = from_config(ergo_robot_config)
for motor in robot.motors:
    motor.compliant = False
    motor.moving_speed = 120
positions = []
for goal in (30.0, -20.0):
    for motor in robot.motors:
        motor.goal_position = goal
    while True:
        present = {motor.name: motor.present_position for motor in robot.motors}
        if all(abs(value - goal) < 1.5 for value in present.values()):
            break
        time.sleep(0.02)
    positions.append(present)
print(json.dumps(positions))
robot.close()
"""


@pytest.mark.skipif(
    importlib.util.find_spec("pypot") is None, reason="pypot is installed on Python 3.11 only"
)
def test_its_sample_robot_moves_every_joint_both_ways(simulation: Any) -> None:
    simulation.expect_haste("ergo")  # it waits 50 ms for an answer, and asks again
    command = [sys.executable, "-W", "ignore", "-c", PROGRAM, simulation.ports["ergo"]]
    ran = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    up, down = json.loads(ran.stdout.splitlines()[-1])
    assert up == pytest.approx(dict.fromkeys((f"m{n}" for n in range(1, 7)), 30.0), abs=1.5)
    assert down == pytest.approx(dict.fromkeys((f"m{n}" for n in range(1, 7)), -20.0), abs=1.5)
