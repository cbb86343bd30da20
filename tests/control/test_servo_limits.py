"""Registers of a servo that limit its goals: what they take off counts as a clamp, and is named."""

from pathlib import Path
from typing import NamedTuple

import msgspec
import pytest
from tests.kit.loops import GateRig
from tests.kit.stories import replayed, send, silence, tell
from tests.kit.wire import all_writes

from dxlrun.channels.cycle import Clamp
from dxlrun.channels.event_records import EventCode, Severity
from dxlrun.errors import StartUpError
from dxlrun.plan.loop_plan import JointPlan, ServoLimit
from dxlrun.testing import VirtualRobot, simulated_robot
from dxlwire.control_table import find_table
from dxlwire.modes import Mode

ROBOT = """\
name: limited
buses: {{main: {{port: sim, protocol: {protocol}, baud_rate: 1_000_000, adapter: {{kind: direct}}}}}}
loop: {{rate: 100}}
joints:
  a: {{bus: main, id: 1, model: {model}, reference: {reference} deg, direction: -1, {limits}}}
controllers:
  c: {{type: joint_group_{kind}_controller, joints: [a]}}
"""


class Case(NamedTuple):
    model: str
    register: str
    kind: str  # Of the controller and its command
    goal: str  # The item that the register limits
    clamp: Clamp
    title: str  # The register with its value, as events name it

    @property
    def protocol(self) -> float:
        return 1.0 if self.model == "AX-12A" else 2.0

    @property
    def raw(self) -> int:
        """Value of the register"""
        return int(self.title.partition(" = ")[2].partition(",")[0])


CURRENT, VELOCITY = "Current Limit (38) = 20, 0.0538 A", "Velocity Limit (44) = 50, 68.7 deg/s"
PRO = "Velocity Limit (44) = 600, 36.0 deg/s"
CASES = (
    Case("XM430-W350", "current_limit", "effort", "goal_current", Clamp.EFFORT, CURRENT),
    Case("XM430-W350", "current_limit", "poseffort", "goal_current", Clamp.EFFORT, CURRENT),
    Case("XM430-W350", "velocity_limit", "velocity", "goal_velocity", Clamp.VELOCITY, VELOCITY),
    Case("XM430-W350", "velocity_limit", "posvel", "profile_velocity", Clamp.VELOCITY, VELOCITY),
    Case("XM430-W350", "pwm_limit", "pwm", "goal_pwm", Clamp.PWM, "PWM Limit (36) = 200, 22.6 %"),
    Case("XL430-W250", "velocity_limit", "velocity", "goal_velocity", Clamp.VELOCITY, VELOCITY),
    Case(
        "PH42-020-S300",
        "current_limit",
        "effort",
        "goal_current",
        Clamp.EFFORT,
        "Current Limit (38) = 100, 0.1 A",
    ),
    Case("PH42-020-S300", "velocity_limit", "posvel", "profile_velocity", Clamp.VELOCITY, PRO),
    Case(
        "H42-20-S300-R",
        "torque_limit",
        "effort",
        "goal_torque",
        Clamp.EFFORT,
        "Torque Limit (30) = 40, 0.161 A",
    ),
    Case(
        "YM070-210-R051",
        "current_limit",
        "effort",
        "goal_current",
        Clamp.EFFORT,
        "Current Limit (66) = 30, 0.3 A",
    ),
    Case("AX-12A", "max_torque", "poseffort", "torque_limit", Clamp.EFFORT, "Max Torque (14) = 300, 29.3 %"),
)


def run(case: Case, tmp_path: Path, share: float, limits: str = "limits: {position: [-10 deg, 10 deg]}"):
    """Command a share of the register's limit for some cycles; return the log, and the goals on the wire."""
    table = find_table(case.model, case.protocol)
    file, robots = tmp_path / "robot.yaml", []
    reference = 180 if table.min_tick == 0 and table.max_tick > 1023 else 150 if table.min_tick == 0 else 0
    file.write_text(
        ROBOT.format(
            model=case.model, protocol=case.protocol, kind=case.kind, reference=reference, limits=limits
        )
    )

    def set_register(robot: VirtualRobot) -> None:
        registers = robot.buses[0].servo(1).registers
        registers[case.register] = case.raw
        if case.model.startswith("Y"):  # shipped with limits of a few degrees
            registers["min_position_limit"], registers["max_position_limit"] = -1_000_000, 1_000_000
        robots.append(robot)

    command = {"effort": "efforts", "velocity": "velocities"}.get(case.kind, case.kind)
    toward = [0.01] if case.kind.startswith("pos") else []
    story = {number: [send("c", command, *toward, limit_of(case) * share)] for number in range(30, 34)}
    log = tell(file, story, tmp_path / "run.mcap", seconds=0.8, before=set_register)
    (robot,) = robots
    item = table.items[case.goal]
    sent = [
        int.from_bytes(data[item.address - begin :][: item.size], "little", signed=item.signed)
        for _, _, begin, data in all_writes(tuple(robot.ledger.entries), robot.plan.buses[0])
        if begin <= item.address and item.address + item.size <= begin + len(data)
    ]
    return replayed(log), sent


def limit_of(case: Case) -> float:
    """Return the limit in the unit of the command, as the servo's table has it."""
    table = find_table(case.model, case.protocol)
    if case.kind in {"velocity", "posvel"}:
        return case.raw * table.rad_s_per_tick
    if case.kind == "pwm":
        return case.raw * table.items["goal_pwm"].scale
    return case.raw * (table.effort_per_tick if case.protocol == 2.0 else 1 / 1023)


@pytest.mark.parametrize(("share", "held"), [(1.5, True), (0.9, False)])
@pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case.model} {case.register} {case.kind}")
def test_only_a_goal_beyond_a_register_is_held_to_it_counted_and_named(case, share, held, tmp_path):
    log, sent = run(case, tmp_path, share)
    highest = max(map(abs, sent))
    assert highest == case.raw if held else highest <= case.raw
    assert (log.cycles["clamped"][:, 0] & case.clamp).any() == held
    texts = [event.text.lower() for event in log.events if event.code == EventCode.GATE]
    expected = [f"a, controller c: goal clamped by register {case.title}".lower()]
    assert [text for text in texts if "register" in text] == expected * held


@pytest.mark.parametrize(("share", "held"), [(0.75, True), (0.45, False)])
def test_a_velocity_register_limits_a_geared_joint_at_the_speed_of_its_output(share, held, tmp_path):
    limits = "gear_ratio: 2, limits: {position: [-10 deg, 10 deg]}"
    log, sent = run(CASES[2], tmp_path, share, limits)
    assert (max(map(abs, sent)) == 50) is held
    assert (log.cycles["clamped"][:, 0] & Clamp.VELOCITY).any() == held
    told = [event.text for event in log.events if "clamped by register" in event.text]
    assert told == ["a, controller c: goal clamped by register Velocity Limit (44) = 50, 34.3 deg/s"] * held


@pytest.mark.parametrize(
    ("limits", "severity"),
    [("limits: {effort: 0.5 A}", Severity.WARNING), ("limits: {effort: 0.04 A}", None), ("", Severity.INFO)],
)
def test_the_start_reports_a_register_that_is_tighter_than_the_file(limits, severity, tmp_path):
    log, _ = run(CASES[0], tmp_path, 0.5, limits or "limits: {position: [-10 deg, 10 deg]}")
    told = [event for event in log.events if event.code == EventCode.SERVO_LIMITS and "effort" in event.text]
    assert [event.severity for event in told] == ([severity] if severity else [])
    for event in told:
        held = "goals of effort are held to Current Limit (38) = 20, 0.0538 A"
        remedy = (
            ", tighter than `limits.effort` in the robot file; lower `limits.effort`, or raise the register"
        )
        assert held + (remedy if severity is Severity.WARNING else "") in event.text
        assert event.text.startswith("a (ID 1 on bus main): ")
        limits_found = msgspec.json.decode(event.data, type=tuple[ServoLimit, ...])
        assert limits_found[-1].interface in {"effort", "velocity"}


@pytest.mark.parametrize("gears", [False, True], ids=["single", "transmission"])
@pytest.mark.parametrize(("before", "after"), [(1023, 50), (50, 1023), (50, 40)])
def test_limits_are_read_again_when_another_servo_took_the_place_of_a_lost_one(
    gears, before, after, tmp_path
):
    """Its goals are held to its own registers, an event names them, and a replay decides like the run."""
    text = ROBOT.format(model="XM430-W350", protocol=2.0, kind="velocity", reference=180, limits="LIMITS")
    if gears:
        text = text.replace(
            "joints:\n  a: {bus: main, id: 1, model: XM430-W350, reference: 180 deg, direction: -1, LIMITS}",
            "joints: {a: {limits: {position: [-90 deg, 90 deg]}}}\n"
            "transmissions: {g: {type: matrix, matrix: [[1]], joints: [a], servos: "
            "{s: {bus: main, id: 1, model: XM430-W350, reference: 180 deg, direction: -1}}}}",
        )
    file = tmp_path / "robot.yaml"
    file.write_text(text.replace("LIMITS", "limits: {position: [-90 deg, 90 deg]}"))
    robots = []

    def replace_servo(robot: VirtualRobot) -> None:
        servo = robot.buses[0].servo(1)
        servo.poke("velocity_limit", before)
        silence(robot, [1], 300, 900)
        robot.buses[0].at(600_000_000, lambda: servo.poke("velocity_limit", after))
        robots.append(robot)

    speed = 45 * find_table("XM430-W350", 2.0).rad_s_per_tick
    story = {number: [send("c", "velocities", speed)] for number in range(200, 204)}
    log = tell(file, story, tmp_path / "run.mcap", seconds=2.5, before=replace_servo)
    (robot,) = robots
    sent = [
        int.from_bytes(data[104 - begin :][:4], "little", signed=True)
        for _, _, begin, data in all_writes(tuple(robot.ledger.entries), robot.plan.buses[0])
        if begin <= 104 < begin + len(data)
    ]
    assert max(map(abs, sent)) == min(45, after)
    told = [event.text for event in replayed(log).events if event.code == EventCode.SERVO_LIMITS]
    texts = [f"goals of velocity are held to Velocity Limit (44) = {raw}, " for raw in (before, after)]
    texts = ["servo registers no longer limit goals" if "1023" in one else one for one in texts]
    assert len(told) == (1 if before == 1023 else 2)
    assert all(text in event for text, event in zip(reversed(texts), reversed(told), strict=False))


def test_a_velocity_limit_with_which_no_goal_is_taken_is_named_with_what_helps(tmp_path):
    file = tmp_path / "robot.yaml"
    limits = "limits: {position: [-10 deg, 10 deg], velocity: 1.5 rad/s}"
    file.write_text(
        ROBOT.format(model="PM42-010-S260", protocol=2.0, kind="position", reference=0, limits=limits)
    )
    robot = simulated_robot(file)
    robot.buses[0].servo(1).poke("velocity_limit", 0)
    with pytest.raises(StartUpError, match=r"raise its Velocity Limit \(44\) from 0 to 1 or more\n"):
        robot.run()


def test_a_register_binds_the_steps_only_where_the_file_limits_the_speed():
    slow = ServoLimit("velocity", 2.0, "Velocity Limit (44) = 83, 114 deg/s")
    # a plan has the top speed of the servo where the file has no limit
    for velocity, step in ((None, None), (8.0, 8.0), (4.0, 2.0), (1.0, 1.0)):
        joint = JointPlan("j0", -1, 1, velocity, top_speed=8.0, servo_limits=(slow,))
        assert joint.step_speed == (step or float("inf"))
        assert joint.highest_speed == min(2.0, velocity or 2.0)


def test_goals_without_a_speed_get_the_one_that_the_servo_will_take():
    rig = GateRig(velocity=4.0, top_speed=8.0, accepts=(EventCode.GATE, EventCode.SERVO_LIMITS))
    rig.gate.take_servo_limits({0: (ServoLimit("velocity", 2.0, "Velocity Limit (44) = 83, 114 deg/s"),)})
    assert rig.apply(position=0.02).velocity == 2.0
    assert rig.apply(position=0.02, velocity=3.0).clamped == Clamp.VELOCITY
    assert rig.texts[0].startswith(
        "j0: goals of velocity are held to Velocity Limit (44) = 83, 114 deg/s, tighter"
    )
    assert rig.texts[-1].endswith("clamped by register Velocity Limit (44) = 83, 114 deg/s")


@pytest.mark.parametrize(
    ("mode", "interface"), [(Mode.EFFORT, "effort"), (Mode.PWM, "pwm"), (Mode.VELOCITY, "velocity")]
)
def test_the_files_limit_is_named_where_it_is_the_tighter_one(mode, interface):
    rig = GateRig(
        mode=mode, effort=0.1, velocity=0.1, top_speed=8.0, accepts=(EventCode.GATE, EventCode.SERVO_LIMITS)
    )
    rig.gate.take_servo_limits({0: (ServoLimit(interface, 1.0, "a register"),)})
    assert rig.texts == []
    rig.apply(**{interface: 5.0})
    assert "a register" not in rig.texts[-1]


def test_a_limit_of_the_manual_is_not_described_as_one_of_the_register():
    joint = JointPlan("j", -1, 1, None, top_effort=3.0, servo_limits=(ServoLimit("effort", 3.0, "x"),))
    assert joint.find_servo_limit("effort") is None
    assert joint.highest_effort == 3.0
    tight = JointPlan(
        "j", -1, 1, None, effort=2.0, top_effort=3.0, servo_limits=(ServoLimit("effort", 1.0, "x"),)
    )
    assert tight.describe_servo_limit(tight.servo_limits[0]).startswith(
        "goals of effort are held to x, tighter"
    )
