"""What the robot file says of simulated servos and adapters, on its way to the simulated bus."""

from __future__ import annotations

import importlib.util
import math
import sys
from pathlib import Path

import pytest
from msgspec.structs import replace
from tests.kit.robots import PAIR, compile_text, problems_in

from dxlrun.compile.simulation import simulation_of
from dxlrun.errors import InputError
from dxlrun.plan.mechanics_plan import CouplingPlan, MechanicsPlan
from dxlrun.plan.robot_plan import SimulationPlan, from_json, to_json
from dxlsim.simulation_plan import (
    AdapterConfig,
    Load,
    Mechanism,
    MechanismServo,
    ServoTimes,
    UrdfBodies,
)

SIMULATED = PAIR.replace("/dev/ttyUSB0", "sim")


def _joint(text: str, simulation: str) -> str:
    """Say something of the left arm, whose reference is 60 deg and whose direction is -1."""
    return text.replace("    direction: -1\n", f"    direction: -1\n    simulation: {simulation}\n", 1)


def _bus(text: str, simulation: str) -> str:
    return text.replace("adapter: {latency: 1 ms}}", f"simulation: {simulation}}}", 1)


def test_what_a_servo_moves_reaches_the_simulated_servo() -> None:
    text = _joint(
        SIMULATED, "{inertia: 0.01 kg m^2, friction: 50 mNm, gravity: 0.3 Nm, gravity_angle: 90 deg}"
    )
    (bus,) = simulation_of(compile_text(text).plan).buses
    # the joint's +90 deg are the servo's 60 deg - 90 deg
    assert bus.servos[0].load == Load(0.01, 0.05, 0.3, pytest.approx(math.radians(-30)))
    assert bus.servos[1].load == Load()


def test_how_slow_a_servo_is_reaches_the_simulated_servo() -> None:
    plan = compile_text(_joint(SIMULATED, "{response_delay: 20 ms, write_time: 1 ms}")).plan
    (bus,) = simulation_of(from_json(to_json(plan))).buses
    assert bus.servos[0].times == ServoTimes(20_000_000, 1_000_000)
    assert bus.servos[1].times == ServoTimes()


def test_a_weight_hangs_down_where_the_joint_is_zero_if_nothing_else_is_said() -> None:
    (bus,) = simulation_of(compile_text(_joint(SIMULATED, "{gravity: 0.3 Nm}")).plan).buses
    assert bus.servos[0].load == Load(gravity=0.3, gravity_angle=pytest.approx(math.radians(60)))


def test_a_load_is_felt_through_the_ratio_of_its_joint() -> None:
    told = "{inertia: 0.02 kg m^2, friction: 50 mNm, gravity: 0.4 Nm, gravity_angle: 30 deg}"
    plan = compile_text(_joint(SIMULATED, told)).plan
    geared = replace(plan.buses[0].servos[0], ratio=0.25)
    (bus,) = simulation_of(replace(plan, buses=(replace(plan.buses[0], servos=(geared,)),))).buses
    # direction is -1: 30 deg of the joint are 120 deg of the servo, on the other side of its 60 deg
    down = pytest.approx(math.radians(60 - 120))
    assert bus.servos[0].load == Load(0.02 / 16, 0.0125, 0.1, down, turns=0.25)


def test_a_linear_joint_has_a_mass_and_forces() -> None:
    slide = _joint(SIMULATED, "{mass: 0.2 kg, friction: 2 N, gravity: 1.5 N}").replace(
        "    direction: -1\n", "    direction: -1\n    travel_per_turn: 62.8 mm\n", 1
    )
    slide = slide.replace("[-80 deg, 60 deg]", "[-5 mm, 5 mm]").replace(
        "[-1.4 rad, 1.0 rad]", "[-5 mm, 5 mm]"
    )
    plan = compile_text(slide).plan
    assert plan.simulation.loads["left_arm_joint"] == Load(0.2, 2.0, steady=1.5)
    ratio = 0.0628 / math.tau
    (bus,) = simulation_of(plan).buses
    expected = Load(
        pytest.approx(0.2 * ratio**2), pytest.approx(2 * ratio), steady=pytest.approx(-1.5 * ratio)
    )
    assert bus.servos[0].load == expected


@pytest.mark.needs("physics")
def test_servos_that_share_joints_are_simulated_together() -> None:
    plan = compile_text(_with_bodies(_joint(SIMULATED, "{inertia: 0.02 kg m^2}"))).plan
    coupling = CouplingPlan("arms", (0, 1), (1, 0), ((0.5, 0.5), (0.5, -0.5)), ((1, 1), (1, -1)))
    coupled = replace(plan, mechanics=MechanicsPlan((coupling,), servos=("left", "right")))
    simulation = simulation_of(coupled)
    left, right = plan.buses[0].servos
    assert simulation.mechanisms == (
        Mechanism(
            (MechanismServo(1, right.reference, 1.0), MechanismServo(0, left.reference, -1.0)),
            ("left_arm_joint", "right_arm_joint"),
            coupling.matrix,
            (Load(0.02), Load()),
        ),
    )
    assert simulation.bodies is not None
    assert simulation.bodies.mechanisms == simulation.mechanisms
    assert [servo.load for servo in simulation.buses[0].servos] == [Load(), Load()], "it is the joints'"
    real = replace(coupled, buses=(*plan.buses, replace(plan.buses[0], port="/dev/x", servos=(right,))))
    elsewhere = replace(real, buses=(replace(plan.buses[0], servos=(left,)), real.buses[1]))
    (alone,) = simulation_of(elsewhere).mechanisms
    assert alone.is_single, "one of them is on a real port"


def test_how_the_adapter_behaves_reaches_the_simulated_bus() -> None:
    plan = compile_text(_bus(SIMULATED, "{latency_timer: 4 ms, split: byte, echo: true}")).plan
    (bus,) = simulation_of(plan).buses
    assert bus.adapter == AdapterConfig(latency_timer_ns=4_000_000, split="byte", echo=True)
    assert bus.adapter.absent == "silent"


def test_the_time_budget_counts_the_simulated_timer() -> None:
    without = compile_text(SIMULATED).plan.buses[0]
    with_timer = compile_text(_bus(SIMULATED, "{latency_timer: 2 ms}")).plan.buses[0]
    assert (without.latency_ns, with_timer.latency_ns) == (0, 2_000_000)
    assert with_timer.budget.total_ns > without.budget.total_ns


def test_a_real_port_does_not_use_it_and_refuses_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    told = PAIR.replace("latency: 1 ms}", "latency: 1 ms}, simulation: {latency_timer: 255 ms}")
    compiled = compile_text(_joint(told, "{gravity: 90 Nm}") + "simulation: {physics: mujoco}\n")
    (bus,) = compiled.plan.buses
    assert bus.latency_ns == 1_000_000
    assert not compiled.plan.simulated
    assert [each.what for each in compiled.warnings if "physics: mujoco" in each.what] == [
        "with physics: mujoco the URDF defines the gravity of left_arm_joint",
        "physics: mujoco needs a URDF",
        "MuJoCo, needed for physics: mujoco, is not installed",
    ]


def test_the_plan_keeps_it_and_old_plans_have_none() -> None:
    plan = compile_text(_bus(_joint(SIMULATED, "{friction: 0.1 Nm}"), "{split: random}")).plan
    assert plan.simulation == SimulationPlan(
        {"left_arm_joint": Load(friction=0.1)}, {"main": AdapterConfig(split="random")}
    )
    assert from_json(to_json(plan)) == plan
    text = to_json(compile_text(SIMULATED).plan)
    _, _, rest = text.partition(b',"simulation":')
    old = text[: -len(rest) - len(b',"simulation":')] + b"}"
    assert from_json(old).simulation == SimulationPlan()


def test_mujoco_that_is_not_installed_is_named_with_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    Path("pair.urdf").write_text("<robot name='pair'><link name='body'/></robot>", encoding="utf-8")
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    text = SIMULATED + "model: {urdf: pair.urdf}\nsimulation: {physics: mujoco}\n"
    (problem,) = [each for each in problems_in(text) if each.severity == "error"]
    assert problem.what == "MuJoCo, needed for physics: mujoco, is not installed"
    assert "pip install 'dxlrun[physics]'" in problem.fix


URDF = """<robot name="pair"><link name="body"/><link name="left"/><link name="right"/>
<joint name="left_arm_joint" type="revolute"><parent link="body"/><child link="left"/>
<limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
<joint name="right_arm_joint" type="continuous"><parent link="body"/><child link="right"/></joint></robot>
"""


def _with_bodies(text: str, urdf: str = URDF) -> str:
    Path("pair.urdf").write_text(urdf, encoding="utf-8")
    return text + "model: {urdf: pair.urdf}\nsimulation: {physics: mujoco}\n"


def test_without_a_word_each_joint_moves_by_itself() -> None:
    assert simulation_of(compile_text(SIMULATED).plan).bodies is None


@pytest.mark.needs("physics")
def test_bodies_are_turned_by_the_servos_in_the_order_of_the_buses() -> None:
    # the first joint of the file stands on the second bus
    two = SIMULATED.replace("loop:", "  second: {port: sim, protocol: 1.0, baud_rate: 1_000_000}\nloop:", 1)
    two = two.replace("bus: main\n    id: 1", "bus: second\n    id: 1", 1)
    plan = compile_text(_with_bodies(two)).plan
    assert [each.servo_id for bus in simulation_of(plan).buses for each in bus.servos] == [2, 1]
    assert simulation_of(plan).bodies == UrdfBodies(
        URDF,
        (
            Mechanism((MechanismServo(0, pytest.approx(math.radians(240)), 1),), ("right_arm_joint",)),
            Mechanism((MechanismServo(1, pytest.approx(math.radians(60)), -1),), ("left_arm_joint",)),
        ),
    )


@pytest.mark.needs("physics")
def test_bodies_that_cannot_be_moved_are_told_before_a_process_starts() -> None:
    loose = URDF.replace(
        '<link name="left"/>', '<link name="left"><inertial><mass value="-1"/></inertial></link>'
    )
    with pytest.raises(InputError, match="MuJoCo cannot load the URDF"):
        simulation_of(compile_text(_with_bodies(SIMULATED, loose)).plan)


@pytest.mark.needs("physics")
def test_mujoco_that_cannot_be_loaded_is_named_with_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    plan = compile_text(_with_bodies(SIMULATED)).plan
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(InputError, match=r"MuJoCo, needed.*pip install 'dxlrun\[physics\]'"):
        simulation_of(plan)


def test_bodies_without_a_urdf_are_told_when_a_real_port_is_simulated_after_all() -> None:
    plan = compile_text(PAIR + "simulation: {physics: mujoco}\n").plan
    with pytest.raises(InputError, match=r"needs a URDF; write `model: \{urdf: \.\.\.\}`"):
        simulation_of(plan)


def test_with_mujoco_the_urdf_says_what_a_joint_moves() -> None:
    pytest.importorskip("mujoco")
    text = _with_bodies(_joint(SIMULATED, "{inertia: 1 kg cm^2, friction: 0.1 Nm}"))
    told = [each.what for each in problems_in(text) if "physics" in each.what]
    assert told == ["with physics: mujoco the URDF defines the inertia of left_arm_joint"]
