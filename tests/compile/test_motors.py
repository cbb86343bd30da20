"""Motor files of a robot file: compared with the joints, and their way to the plan and the simulation."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from msgspec.structs import replace
from tests.kit.answers import result_of
from tests.kit.robots import compile_text, problems_in

from dxlrun import MotorLoad, MotorModel, Stribeck
from dxlrun.cli.app import run_tokens
from dxlrun.compile.simulation import simulation_of
from dxlrun.control.controllers.plugin_loading import load_plugins
from dxlrun.description.joints.motor_file import motor_text
from dxlrun.errors import InputError
from dxlrun.plan.robot_plan import from_json, to_json
from dxlrun.remote.preparation import Preparation, RefusedRequest
from dxlrun_analysis.replay.changes import Setting, with_settings
from dxlsim.simulation_plan import Load

MOTOR = MotorModel(
    "MX-64", 12.0, 1.6, 3.5, 0.011, 0.1, 0.08, 0.001, Stribeck(0.05, 0.2), 0.158, 32, 1_500_000,
    MotorLoad(0.004, 0.2, 0.5), "a log",
)  # fmt: skip
ROBOT = """\
name: arm
buses:
  main: {port: sim, protocol: 1.0, baud_rate: 1_000_000, return_delay_time: 0 us}
loop: {rate: 200}
joints:
  shoulder: {bus: main, id: 1, model: MX-64, reference: 180 deg, direction: -1, motor: shoulder.yaml}
  elbow: {bus: main, id: 2, model: MX-64, reference: 180 deg, direction: 1}
"""

CHAIN = "controllers:\n  law: {type: feed_forward, joints: [shoulder]}\n"
NEEDING = ROBOT + "controllers:\n  law: {type: part, motors: [resistance], joints: [shoulder, elbow]}\n"


MOTOR_FILE = Path("shoulder.yaml")


@pytest.fixture(autouse=True)
def _motor_file(here: None) -> None:
    MOTOR_FILE.write_text(motor_text(MOTOR, {}))


def _shoulder(more: str) -> str:
    return ROBOT.replace("motor: shoulder.yaml}", f"motor: shoulder.yaml, {more}}}")


@pytest.mark.parametrize(
    ("more", "turns", "count"),
    [("gear_ratio: 2", 2.0, 1), ("servos: [{id: 1}, {id: 3, direction: 1}]", 1.0, 2)],
)
def test_a_joint_has_the_motor_that_it_feels(more: str, turns: float, count: int) -> None:
    """Torque, speed without load, power and friction are those of the servos behind the gear."""
    text = _shoulder(more).replace("id: 1, model", "model") if count == 2 else _shoulder(more)
    plan = compile_text(text).plan
    joint, model = plan.loop.joints[0].motor, plan.loop.joints[0].servo_model
    assert joint is not None
    assert joint.stiffness is not None
    assert MOTOR.stiffness is not None

    def torque(motor: MotorModel, duty: float, speed: float) -> float:
        drive = duty * motor.voltage - motor.torque_constant * speed
        return motor.torque_constant / motor.resistance * drive

    for error, speed in ((0.1, 0.0), (0.02, 1.5), (-0.05, -3.0)):
        at_servo = torque(MOTOR, MOTOR.stiffness * error * turns, speed * turns)
        assert torque(joint, joint.stiffness * error, speed) == pytest.approx(count * turns * at_servo)
    assert joint.inertia == pytest.approx(count * turns**2 * MOTOR.inertia)
    assert joint.friction == pytest.approx(count * turns * MOTOR.friction)
    assert joint.viscous_friction == pytest.approx(count * turns**2 * MOTOR.viscous_friction)
    assert joint.stribeck == Stribeck(0.05 * count * turns, 0.2 / turns)
    assert joint.load == MOTOR.load
    if count == 2:
        assert model is None  # of several servos each has a heat of its own
    else:
        assert model is not None
        assert (model.stall_torque, model.stall_current) == (12.0, 4.1)
        assert model.no_load_speed == pytest.approx(6.6 / 2, abs=0.01)


def test_a_motor_reaches_the_plan_the_log_and_the_simulated_servo() -> None:
    plan = compile_text(ROBOT).plan
    assert from_json(to_json(plan)) == plan
    assert [joint.motor for joint in plan.loop.joints] == [MOTOR, None]
    assert plan.included == {"shoulder.yaml": motor_text(MOTOR, {})}
    shoulder, elbow = simulation_of(plan).buses[0].servos
    assert shoulder.motor == MOTOR
    # the joint's 0.5 rad are the servo's 180 deg - 0.5 rad
    assert shoulder.load == Load(0.004, 0.0, 0.2, pytest.approx(math.pi - 0.5))
    assert (shoulder.times.response_delay_ns, elbow.times.response_delay_ns) == (1_500_000, 0)
    assert (elbow.motor, elbow.load) == (None, Load())


def test_keys_of_the_joint_count_before_the_load_of_its_motor_file() -> None:
    (load,) = compile_text(_shoulder("simulation: {inertia: 0.02 kg m^2}")).plan.simulation.loads.values()
    assert load == Load(0.02, 0.0, 0.2, 0.5)
    (load,) = compile_text(_shoulder("simulation: {gravity: 0.3 Nm}")).plan.simulation.loads.values()
    assert load == Load(0.004, 0.0, 0.3, 0.0)


def test_a_simulated_servo_may_have_another_motor_than_the_controllers_know() -> None:
    worn = replace(MOTOR, friction=0.2, load=MotorLoad())
    Path("worn.yaml").write_text(motor_text(worn, {}))
    plan = compile_text(_shoulder("simulation: {motor: worn.yaml}")).plan
    assert plan.loop.joints[0].motor == MOTOR
    assert plan.simulation.motors == {"shoulder": worn}
    assert plan.simulation.loads == {}
    assert sorted(plan.included) == ["shoulder.yaml", "worn.yaml"]


def test_the_p_gain_is_the_one_that_the_servo_has() -> None:
    (joint, _) = compile_text(_shoulder("registers: {p_gain: 8}")).plan.loop.joints
    assert joint.motor == replace(MOTOR, p_gain=8)
    MOTOR_FILE.write_text(motor_text(replace(MOTOR, p_gain=16), {}))
    (warning,) = problems_in(ROBOT)
    assert (warning.severity, warning.what) == (
        "warning",
        "shoulder was identified with p_gain = 16, but servos start with 32",
    )
    assert problems_in(_shoulder("registers: {p_gain: 32}")) == ()


def test_a_file_is_looked_for_beside_the_file_that_names_it() -> None:
    Path("arms").mkdir()
    MOTOR_FILE.rename(Path("arms", "shoulder.yaml"))
    head, joints = ROBOT.split("joints:\n")
    Path("arms", "joints.yaml").write_text(f"joints:\n{joints}")
    plan = compile_text(f"include: [arms/joints.yaml]\n{head}").plan
    assert plan.simulation.motors["shoulder"] == MOTOR
    assert sorted(plan.included) == ["arms/joints.yaml", "arms/shoulder.yaml"]


@pytest.mark.parametrize(
    ("change", "at", "what"),
    [
        ({"model": "MX-28"}, "robot.yaml:6", "shoulder.yaml describes an MX-28, but shoulder is an MX-64"),
        ({"p_gain": None}, "shoulder.yaml:11", "has a position_gain without a p_gain"),
    ],
)
def test_a_file_that_does_not_fit_is_refused(change: dict[str, object], at: str, what: str) -> None:
    changed = replace(MOTOR, **change)  # type: ignore[arg-type]  # names of any field
    MOTOR_FILE.write_text(motor_text(changed, {}))
    (problem,) = problems_in(ROBOT)
    assert (problem.severity, what in problem.what) == ("error", True)
    assert f"/{at}:" in str(problem)


@pytest.mark.parametrize(("model", "per_effort"), [("XM430-W350", 1.6), ("XL430-W250", None)])
def test_an_effort_in_ampere_is_so_much_torque(
    part_plugins: object, model: str, per_effort: float | None
) -> None:
    MOTOR_FILE.write_text(motor_text(replace(MOTOR, model=model, p_gain=800), {}))
    text = NEEDING.replace("MX-64", model).replace("protocol: 1.0", "protocol: 2.0")
    text = text.replace("shoulder, elbow]", "shoulder]")
    motor = compile_text(text).plan.loop.joints[0].motor
    assert motor is not None
    assert motor.torque_per_effort == per_effort
    text = text.replace("resistance", "torque_per_effort")
    if per_effort is None:
        with pytest.raises(
            InputError, match="but its servo measures neither torque nor current; command posi"
        ):
            compile_text(text)
    else:
        compile_text(text)


def test_a_servo_without_a_p_gain_has_all_of_it_in_the_position_gain() -> None:
    text = ROBOT.replace("MX-64", "AX-12A").replace("180 deg", "150 deg")
    MOTOR_FILE.write_text(motor_text(replace(MOTOR, model="AX-12A"), {}))
    assert [problem.what for problem in problems_in(text)] == ["an AX-12A has no P gain"]
    MOTOR_FILE.write_text(motor_text(replace(MOTOR, model="AX-12A", p_gain=None), {}))
    assert problems_in(text) == ()


def test_mistakes_of_a_motor_file_of_two_joints_are_reported_once_with_those_of_the_robot() -> None:
    MOTOR_FILE.write_text(motor_text(MOTOR, {}).replace("12 V", "12 A") + "x: 1\n")
    text = ROBOT.replace("direction: 1}", "direction: 1, motor: shoulder.yaml}").replace("id: 2", "id: 1")
    assert [(Path(each.mark.file).name, each.mark.line) for each in problems_in(text)] == [
        ("robot.yaml", 7),
        ("shoulder.yaml", 3),
        ("shoulder.yaml", 15),
    ]


def test_a_file_that_is_missing_or_something_else_is_one_error() -> None:
    MOTOR_FILE.unlink()
    (problem,) = problems_in(ROBOT)
    assert (problem.mark.line, problem.what) == (6, "motor file shoulder.yaml not found")
    assert "make the file by `dxlrun identify`" in problem.fix
    MOTOR_FILE.mkdir()
    assert [each.what for each in problems_in(ROBOT)] == ["this is a directory"]
    (problem,) = problems_in(ROBOT.replace("shoulder.yaml", "robot.yaml"))
    assert problem.what.startswith("this is not a motor file")


def test_a_controller_that_needs_motors_is_refused_where_there_are_none(part_plugins: object) -> None:
    (problem,) = problems_in(NEEDING)
    assert problem.what == "law needs the motor of elbow, but elbow has no motor file"
    assert problem.fix.startswith("measure it with `dxlrun identify elbow`")
    assert (problem.mark.line, problem.mark.column) == (9, 62)
    assert problems_in(NEEDING.replace("direction: 1}", "direction: 1, motor: shoulder.yaml}")) == ()
    MOTOR_FILE.write_text(motor_text(replace(MOTOR, model="MX-28"), {}))
    assert [each.what for each in problems_in(NEEDING.replace("shoulder, elbow]", "shoulder]"))] == [
        "shoulder.yaml describes an MX-28, but shoulder is an MX-64"
    ]


def test_a_controller_that_needs_a_figure_is_refused_where_the_file_lacks_it(part_plugins: object) -> None:
    text = NEEDING.replace("shoulder, elbow]", "shoulder]").replace("resistance", "position_gain")
    compile_text(text)
    MOTOR_FILE.write_text(motor_text(replace(MOTOR, position_gain=None, p_gain=None), {}))
    with pytest.raises(
        InputError, match="law needs the position_gain of shoulder, missing in its motor file"
    ):
        compile_text(text)
    with pytest.raises(InputError, match="needs unknown motor data: colour"):
        compile_text(text.replace("position_gain", "colour"))


def test_a_controller_of_a_running_robot_or_a_replay_needs_them_too() -> None:
    loop, plugins = compile_text(ROBOT + CHAIN).plan.loop, load_plugins()
    preparation = Preparation({joint.name: joint for joint in loop.joints}, plugins)
    entry = {"name": "more", "type": "feed_forward", "joints": ["shoulder"]}
    assert preparation.controller(entry, {}, 200.0).joints == ("shoulder",)
    with pytest.raises(RefusedRequest, match="more needs the motor of elbow, but elbow has no motor file"):
        preparation.controller(entry | {"joints": ["elbow"]}, {}, 200.0)
    assert with_settings(loop, [Setting("law", ("scale",), 0.5)], plugins) != loop
    with pytest.raises(InputError, match="--set law: law needs the motor of elbow"):
        with_settings(loop, [Setting("law", ("joints",), ["elbow"])], plugins)


def test_check_shows_which_joints_have_a_motor_file(capsys: pytest.CaptureFixture[str]) -> None:
    Path("robot.yaml").write_text(ROBOT)
    assert run_tokens(["check", "robot.yaml"]) == 0
    rows = {line.split()[0]: line.split()[-1] for line in capsys.readouterr().out.splitlines() if line}
    assert (rows["joint"], rows["shoulder"], rows["elbow"]) == ("file", "shoulder.yaml", "none")
    assert run_tokens(["check", "robot.yaml", "--json"]) == 0
    joints = result_of(capsys.readouterr().out)["joints"]
    assert [joint["motor"] for joint in joints] == ["shoulder.yaml", None]
