# ruff: noqa: E501 (a mistake and its sentence are read best side by side)

from __future__ import annotations

import math

import pytest
from pydantic import ValidationError
from tests.kit import desk
from tests.kit.desk import TORSO

from dxlrun.description.bus import Adapter, Bus
from dxlrun.description.form import Form
from dxlrun.description.joints.joints import Joint
from dxlrun.description.joints.mechanics import Limits
from dxlrun.description.robot import (
    ControllerEntry,
    Loop,
    Policies,
    PoseStep,
    Robot,
    Scheduler,
    TorqueStep,
)
from dxlrun.errors import Mark

DAMAGES = [
    ("id: 5", 'id: §"5"', "joints.elbow.id is the text '5', but must be a whole number; take the quotes away"),
    ("id: 5", "id: §5.0", "joints.elbow.id is 5.0, but must be a whole number; write"),
    ("id: 5", "id: §true", "joints.elbow.id is true, but must be a whole number; write"),
    ("id: 5", "id: §254", "joints.elbow.id is 254, but must be at most 253; write"),
    ("id: 5", "id: §-1", "joints.elbow.id is -1, but must be at least 0; write"),
    ("id: 5", "id: §null", "joints.elbow.id is empty, but must be a whole number; write"),
    ("id: 5", "id§:", "a ':' stands where none can be; write `key: value` with a space behind the ':'"),
    ("elbow: {bus: main, id: 5, ", "§elbow: {bus: main, ", "joints.elbow has no id; add `id: 1`"),
    ("id: 5", "id: 5, §Id: 5", "joints.elbow has an unknown key 'Id'; did you mean id?"),
    ("direction: 1}", "direction: §0}", "joints.elbow.direction is 0, but must be 1 or -1; write"),
    ("direction: 1}", "direction: §true}", "joints.elbow.direction: a direction is 1 or -1; write"),
    ("direction: 1}", "direction: §1.0}", "joints.elbow.direction: a direction is 1 or -1; write"),
    ("150 deg", "§150", "joints.elbow.reference: 150 has no unit; write an angle with its unit"),
    ("position: [-180 deg, 60 deg]", "§position: [-180 deg]", "joints.swing.limits.position has too few values; add"),
    ("[-180 deg, 60 deg]", "§[0 deg, 1 deg, 2 deg]", "joints.swing.limits.position is too long; keep 2"),
    ("[-180 deg, 60 deg]", "[-180 deg, §60]", "joints.swing.limits.position[1]: 60 has no unit; write"),
    ("[-180 deg, 60 deg]", "§[60 deg, 60 deg]", "joints.swing.limits.position: the lower limit is not below"),
    ("[-180 deg, 60 deg]", "§60 deg", "joints.swing.limits.position is the text '60 deg', but must be a list"),
    ("position: [-180 deg, 60 deg]", "velocity: §0 deg/s", "joints.swing.limits.velocity is the text '0 deg/s', but must"),
    ("protocol: 1.0", "protocol: §3", "buses.main.protocol: there is no Protocol 3; write 1.0 or 2.0"),
    ("baud_rate: 1_000_000", "baud_rate: §0", "buses.main.baud_rate is 0, but must be greater than 0; write"),
    ("adapter: {latency: 1 ms}", "adapter: §1 ms", "buses.main.adapter is the text '1 ms', but must be a mapping"),
    ("latency: 1 ms", "latency: §1", "buses.main.adapter.latency: 1 has no unit; write a duration"),
    ("direction: 1}", "direction: 1, simulation: {inertia: §0 kg m^2}}", "joints.elbow.simulation.inertia is the text '0 kg m^2', but must be greater than 0; write for example `inertia: 0.01"),
    ("direction: 1}", "direction: 1, simulation: {friction: §-1 Nm}}", "joints.elbow.simulation.friction is the text '-1 Nm', but must be at least 0; write for example `friction: 0.05 Nm`"),
    ("direction: 1}", "direction: 1, simulation: {gravity: §0.3}}", "joints.elbow.simulation.gravity: 0.3 has no unit; write a torque"),
    ("adapter: {latency: 1 ms}", "simulation: {latency_timer: §256 ms}", "buses.main.simulation.latency_timer: no adapter gathers bytes for so long; write 255 ms at most"),
    ("adapter: {latency: 1 ms}", "simulation: {absent: §dead}", "buses.main.simulation.absent is the text 'dead', but must be silent or slot; write"),
    ("lock_memory: true", "lock_memory: §yes", "loop.scheduler.lock_memory is the text 'yes', but must be true or"),
    ("round_robin", "§rr", "loop.scheduler.policy is the text 'rr', but must be other, fifo or round_robin; write"),
    ("priority: 31", "priority: §100", "loop.scheduler.priority is 100, but must be at most 99; write"),
    ("rate: ${rate}", "rate: §0", "loop.rate is 0, but must be at least 0.001; write"),
    ("rate: ${rate}", "rate: §.inf", "loop.rate is .inf, but must be a finite number; write"),
    ("rate: ${rate}", "rate: §50 deg", "loop.rate: '50 deg' has the unit deg, which is not one of a rate; write it as 50, 50 Hz or 1 kHz"),
    ("rate: 25", "rate: §-1", "controllers.broadcaster.rate is -1, but must be at least 0.001; write"),
    ("rate: 25", "rate: §1.0e-300", "controllers.broadcaster.rate is 1e-300, but must be at least 0.001; write"),
    ("broadcaster: {type: joint_state_broadcaster, ", "§broadcaster: {", "controllers.broadcaster has no type; add"),
    ("  broadcaster: {", "  §broad caster: {", "controllers.broad caster: 'broad caster' is no name; start"),
    ("on_exit: limp", "on_exit: §stop", "policies.on_exit is the text 'stop', but must be limp or hold; write"),
    ("on_exit: limp", "on_exit: §[]", "policies.on_exit has too few entries; write at least 1"),
    ("on_exit: limp", "on_exit: §{pose: a}", "policies.on_exit is a mapping, but must be a list; write [a, b, ...]"),
    ("on_exit: limp", "on_exit: [§stop]", "policies.on_exit[0] is the text 'stop', but must be limp or hold; write"),
    ("on_exit: limp", "on_exit: [§{pose: home}]", "policies.on_exit[0] has no speed; add `speed: 60 deg/s`"),
    ("on_exit: limp", "on_exit: [{pose: home, speed: §60}]", "policies.on_exit[0].speed: 60 has no unit; write"),
    ("on_exit: limp", "on_exit: [{reduce_torque: §1}]", "policies.on_exit[0].reduce_torque is 1, but must be less"),
    ("on_exit: limp", "on_exit: [{reduce_torque: 0.5, §step: 3}]", "policies.on_exit[0] has an unknown key 'step'; did"),
    ("recording:", "poses: {home: {elbow: §1}}\nrecording:", "poses.home.elbow: 1 has no unit; write an angle"),
    ("recording:", "poses: {home: §{}}\nrecording:", "poses.home has too few entries; write at least 1"),
    ("rate: 25", "fallback: §5", "controllers.broadcaster.fallback is 5, but must be text; put"),
    ("exit_timeout: 3 s", "exit_timeout: §0 s", "policies.exit_timeout is 0, but must be greater than 0; write"),
    ("directory: elsewhere", "directory: §5", 'recording.directory is 5, but must be text; put it in quotes: "5"'),
    ("directory: elsewhere", 'directory: §""', "recording.directory is too short; write something"),
    ("name: torso", "name: §2torso", "name: '2torso' is no name; start with a letter"),
    ("name: torso\n", "§", "the file has no name; add `name: bioloid_torso`"),
    ("recording:", "include: §fragment.yaml\nrecording:", "include is the text 'fragment.yaml', but must be a list"),
    ("recording:", "include: [§5]\nrecording:", "include[0] is 5, but must be a file's name; name it"),
    ("recording:", 'include: [§"${port}.yaml"]\nrecording:', "arguments are not put into include; write"),
    ("recording:", "processes: {§view: {}}\nrecording:", "processes.view is not possible; this version has"),
    ("recording:", "§model: {}\nrecording:", "model has no urdf; add `urdf: torso.urdf`"),
    ("recording:", 'model: {urdf: §""}\nrecording:', "model.urdf is too short; write something"),
    ("recording:", "§includes: []\nrecording:", "the file has an unknown key 'includes'; did you mean include?"),
    ("recording:", "§recordings:", "the file has an unknown key 'recordings'; did you mean recording?"),
]  # fmt: skip


@pytest.mark.parametrize(("right", "wrong", "expected"), DAMAGES)
def test_each_mistake_is_named_where_it_stands(right: str, wrong: str, expected: str) -> None:
    text, place = desk.pointed(TORSO, right, wrong)
    (problem,) = desk.refusals(text)
    assert problem.startswith(f"robot.yaml:{place}: {expected}")


def test_a_robot_file_becomes_si_units() -> None:
    robot = desk.robot(TORSO).robot
    assert robot.name == "torso"
    bus = robot.buses["main"]
    assert (bus.protocol, bus.baud_rate, bus.adapter.latency, bus.return_delay_time) == (
        1.0,
        1_000_000,
        10**6,
        250_000,
    )
    swing = robot.joints["swing"]
    assert (swing.bus, swing.id, swing.model, swing.direction) == ("main", 1, "AX-12A", -1)
    assert swing.reference == pytest.approx(math.pi / 3)
    assert swing.limits.position == pytest.approx((-math.pi, math.pi / 3))
    scheduler = robot.loop.scheduler
    assert (scheduler.policy, scheduler.priority, scheduler.lock_memory) == ("round_robin", 31, True)
    assert robot.policies.exit_timeout == 3_000_000_000
    assert robot.recording.directory == "elsewhere"
    arm = robot.controllers["arm"]
    assert (arm.type, arm.active, arm.rate) == ("joint_group_position_controller", False, None)
    assert arm.parameters == {"joints": ["swing", "elbow"]}
    assert robot.controllers["broadcaster"].rate == 25.0


def test_what_simulated_servos_are_like_becomes_si_units() -> None:
    text = TORSO.replace(
        "direction: 1}",
        "direction: 1, simulation: {inertia: 5 kg cm^2, gravity: 300 mNm, gravity_angle: -90 deg}}",
        1,
    ).replace(
        "adapter: {latency: 1 ms}", "simulation: {latency_timer: 4 ms, split: byte, echo: true, absent: slot}"
    )
    robot = desk.robot(text + "simulation: {physics: mujoco}\n").robot
    moved = robot.joints["elbow"].simulation
    assert (moved.inertia, moved.friction, moved.gravity) == (pytest.approx(5e-4), None, pytest.approx(0.3))
    assert moved.gravity_angle == pytest.approx(-math.pi / 2)
    bus = robot.buses["main"].simulation
    assert (bus.latency_timer, bus.split, bus.echo, bus.absent) == (4_000_000, "byte", True, "slot")
    assert robot.simulation.physics == "mujoco"


def test_what_is_left_out_has_its_default() -> None:
    robot = desk.robot(
        "name: x\nbuses: {m: {port: sim, protocol: 1, baud_rate: 57600}}\nloop: {rate: 50}\n"
        "joints: {j: {bus: m, id: 1, model: A, reference: 0 deg, direction: +1}}\n"
    ).robot
    assert (robot.buses["m"].adapter.latency, robot.buses["m"].return_delay_time) == (16_000_000, 500_000)
    assert (robot.loop.scheduler.policy, robot.loop.scheduler.priority, robot.loop.overrun) == (
        "other",
        31,
        "skip",
    )
    assert not robot.loop.scheduler.lock_memory
    assert (robot.joints["j"].limits.position, robot.joints["j"].limits.velocity) == (None, None)
    assert robot.controllers == {}
    assert (robot.policies.on_exit, robot.policies.exit_timeout) == ("limp", 2_000_000_000)
    assert robot.recording.directory == "logs"


def test_a_robot_needs_buses_and_joints() -> None:
    assert desk.refusals("name: x\nloop: {rate: 1}\nbuses: {}\njoints: {}\n") == [
        "robot.yaml:3:8: buses has too few entries; write at least 1",
        "robot.yaml:4:9: joints has too few entries; write at least 1",
    ]


def test_a_description_cannot_be_changed() -> None:
    description = desk.robot(TORSO)
    with pytest.raises(ValidationError, match="frozen"):
        description.robot.loop.rate = 1.0
    with pytest.raises(AttributeError):
        description.text = ""


def test_the_text_and_the_places_are_kept() -> None:
    description = desk.robot(TORSO)
    assert description.text == TORSO
    file = str(description.path)
    assert description.marks.key("joints", "elbow") == Mark(file, 12, 3)
    assert description.marks.value("controllers", "arm", "joints", 1) == Mark(file, 15, 64)
    assert description.marks.value("joints", "elbow", "limits", "position") == Mark(file, 12, 3)


@pytest.mark.parametrize(
    "part",
    [Robot, Bus, Adapter, Loop, Scheduler, Joint, Limits, ControllerEntry, Policies, PoseStep, TorqueStep],
)
def test_every_key_is_described_with_an_example(part: type[Form]) -> None:
    for key, field in part.model_fields.items():
        assert field.description, key
        assert field.examples or key == "parameters", key


# Ten mistakes of ten kinds in one file, as a tired person makes them.
TEN = """\
name: torso
arguments:
  rate: {default: 50, help: "loop rate, Hz"}
buses:
  main: {port: sim, protocol: 1.0, baudrate: 1_000_000, baud_rate: 1_000_000}
loop:
  rate: ${rat}
  scheduler: {policy: realtime}
joints:
  swing:
    bus: main
    id: "1"
    model: AX-12A
    reference: 60
    direction: 1
    limits: {position: [90 deg, -90 deg]}
  elbow: {bus: main, id: 300, model: AX-12A, reference: 150 deg, direction: 1}
  head: {bus: main, id: 20, model: AX-12A, direction: 1}
  elbow: {bus: main, id: 6, model: AX-12A, reference: 150 deg, direction: 1}
controllers:
  broadcaster: {type: joint_state_broadcaster, active: on}
"""


def test_ten_mistakes_give_ten_errors_with_their_places() -> None:
    assert desk.refusals(TEN) == [
        "robot.yaml:5:36: buses.main has an unknown key 'baudrate'; did you mean baud_rate?",
        "robot.yaml:7:9: there is no argument 'rat'; did you mean rate?",
        "robot.yaml:8:23: loop.scheduler.policy is the text 'realtime', but must be other, fifo or round_robin;"
        " write it so",
        "robot.yaml:12:9: joints.swing.id is the text '1', but must be a whole number; take the quotes away",
        "robot.yaml:14:16: joints.swing.reference: 60 has no unit; write an angle with its unit, such as"
        " 60 deg or 1.05 rad",
        "robot.yaml:16:24: joints.swing.limits.position: the lower limit is not below the upper one;"
        " write [lower, upper]",
        "robot.yaml:17:26: joints.elbow.id is 300, but must be at most 253; write for example `id: 1`",
        "robot.yaml:18:3: joints.head has no reference; add `reference: 150 deg`",
        "robot.yaml:19:3: joints.elbow was already given in line 17; keep one of the two",
        "robot.yaml:21:56: controllers.broadcaster.active is the text 'on', but must be true or false;"
        " write for example `active: false`",
    ]


def test_a_survey_keeps_what_is_right_for_further_checks() -> None:
    text = TORSO.replace("id: 1,", "id: 999,").replace("rate: ${rate}", "rate: ${rat}").replace("3 s", "3")
    survey = desk.survey(text + "sensors: 5\n")
    assert len(survey.problems) == 4
    description = survey.description
    assert set(description.robot.joints) == {"elbow", "swing"}
    assert (description.robot.joints["swing"].id, survey.otherwise.robot.joints["swing"].id) == (0, 1)
    assert (description.robot.loop.rate, survey.otherwise.robot.loop.rate) == (1.0, 1000.0)
    assert description.robot.policies.exit_timeout == 2_000_000_000
    assert description.left_out == {
        ("loop", "rate"),
        ("policies", "exit_timeout"),
        ("sensors",),
    }
    assert set(description.robot.controllers) == {"broadcaster", "arm"}


def test_a_survey_of_a_right_file_leaves_nothing_out() -> None:
    survey = desk.survey(TORSO)
    assert survey.problems == ()
    assert survey.otherwise is None
    assert survey.description == desk.robot(TORSO)
    assert survey.description.left_out == frozenset()


def test_a_survey_says_when_too_little_is_right() -> None:
    survey = desk.survey("joints: 5\n")
    assert survey.description is None
    assert len(survey.problems) == 4


def test_controllers_and_loop_that_are_no_mappings_are_left_out() -> None:
    head = TORSO[: TORSO.index("controllers:")]
    survey = desk.survey(head.replace("loop:\n", "loop: 50\nlop:\n") + "controllers: {a: 5}\n")
    assert [problem.what for problem in survey.problems] == [
        "loop is 50, but must be a mapping",
        "the file has an unknown key 'lop'",
        "controllers.a is 5, but must be a mapping",
    ]
    assert survey.description.left_out == {("loop",), ("lop",), ("controllers", "a")}
    assert survey.description.robot.controllers == {}
