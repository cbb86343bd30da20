"""What a servo moves, felt through its registers: each joint by itself, and as a body of a URDF in MuJoCo."""

from __future__ import annotations

import math

import pytest
import serial
from tests.kit.bodies import Turned, bodies_of
from tests.kit.bus_process import BusProcess
from tests.kit.packets import packet2
from tests.kit.simulated_line import Line

from dxlrun_mujoco.mujoco_plant import mujoco_plant
from dxlsim.motion.mechanics import Mechanics
from dxlsim.motion.motor import motor_of
from dxlsim.simulation_plan import BusConfig, Load, ServoConfig, SimulationConfig
from dxlwire.control_table import find_table

TICK = math.tau / 4096
MASS, ARM = 0.5, 0.2
PULL = MASS * 9.81 * ARM
"""Nm of the arm where it sticks out"""
STALL = 4.1
"""Nm of an XM430-W350 at 12 V (e-Manual, Specifications)"""
START = 2048
"""Ticks; there the arm is horizontal."""

URDF = f"""<robot name="arm"><link name="base"/>
<link name="arm"><inertial><origin xyz="{ARM} 0 0"/><mass value="{MASS}"/>
<inertia ixx="1e-9" iyy="1e-9" izz="1e-9" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="shoulder" type="continuous"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/></joint>
</robot>"""
"""About +y: the arm sinks as its angle grows; the servo, which is mounted the other way round, turns back."""


def hang(physics: str) -> Line:
    """Return a line with one XM430-W350 that holds an arm, limp and horizontal at the start."""
    if physics == "mujoco":
        mechanics = Mechanics(0, mujoco_plant(bodies_of(URDF, (Turned("shoulder", START * TICK, -1),))))
        return Line("XM430-W350", 1, position=START * TICK, mechanics=mechanics)
    load = Load(inertia=MASS * ARM**2, gravity=PULL, gravity_angle=START * TICK - math.pi / 2)
    return Line("XM430-W350", 1, position=START * TICK, load=load)


def rubbing(torque: float, pull: float) -> float:
    """Return the friction that holds between the motor's torque and an arm's pull, Nm."""
    motor = motor_of(find_table("XM430-W350"))
    return motor.friction + motor.load_friction * abs(torque + pull)


by_mujoco = pytest.param("mujoco", marks=pytest.mark.needs("physics"))
both = pytest.mark.parametrize("physics", ["independent", by_mujoco])


@both
@pytest.mark.parametrize("gain", [400, 800, 1600])
def test_an_arm_sags_by_the_torque_that_the_p_gain_gives(physics, gain):
    line = hang(physics)
    line.put(position_p_gain=gain, torque_enable=1, goal_position=START)
    line.wait(3)
    # gain / 128 is the PWM of a tick, 885 the whole of it (e-Manual, Position PID Gain and Goal PWM)
    sag = START - line.get("present_position")
    torque, pull = sag * gain / 128 / 885 * STALL, PULL * math.cos(sag * TICK)
    assert abs(torque - pull) <= rubbing(torque, pull) + 0.02


@both
def test_a_limp_arm_falls_and_swings(physics):
    line = hang(physics)
    line.set("torque_enable", 0)
    lowest = 0
    for _ in range(100):
        line.wait(0.03)
        lowest = min(lowest, line.get("present_position") - START)
    assert lowest < -900, "a quarter of a turn is 1024"
    line.wait(20)
    hangs = 1024 + line.get("present_position") - START
    pull = PULL * math.sin(abs(hangs) * TICK)
    assert pull <= rubbing(0.0, pull) + 0.003


@pytest.mark.needs("physics")
def test_both_ways_of_moving_show_the_host_the_same():
    lines = [hang("independent"), hang("mujoco")]
    for line in lines:
        line.put(torque_enable=1, profile_velocity=60, goal_position=START + 600)
    for _ in range(40):
        alone, together = (line.get("present_position") for line in lines)
        assert together == pytest.approx(alone, abs=3)
        for line in lines:
            line.wait(0.05)
    assert alone > START + 500


def test_the_process_of_simulated_buses_moves_bodies():
    pytest.importorskip("mujoco")
    bodies = bodies_of(URDF, (Turned("shoulder", START * TICK, -1),))
    bus = BusConfig("main", 1_000_000, (ServoConfig(1, "XM430-W350", START * TICK),), 2.0)
    config = SimulationConfig((bus,), bodies=bodies)
    read = packet2(1, 0x02, bytes.fromhex("8400 0400"))  # present position
    with BusProcess(config) as process, serial.Serial(process.ports["main"], 1_000_000, timeout=20) as port:
        for _ in range(20_000):  # limp, it falls within a second, however busy the machine
            port.write(read)
            position = int.from_bytes(port.read(15)[9:13], "little", signed=True)
            if position < START - 500:
                break
    assert position < START - 500
