from __future__ import annotations

import math

import pytest
from tests.kit import desk
from tests.kit.desk import TORSO

from dxlrun.errors import Mark


def test_a_robot_file_becomes_si_units() -> None:
    robot = desk.robot(TORSO).robot
    assert robot.name == "torso"
    bus = robot.buses["main"]
    assert (bus.protocol, bus.baud_rate) == (1.0, 1_000_000)
    assert (bus.adapter.latency, bus.return_delay_time) == (10**6, 250_000)
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


def test_what_is_left_out_has_its_default() -> None:
    robot = desk.robot(
        "name: x\nbuses: {m: {port: sim, protocol: 1, baud_rate: 57600}}\nloop: {rate: 50}\n"
        "joints: {j: {bus: m, id: 1, model: A, reference: 0 deg, direction: +1}}\n"
    ).robot
    assert (robot.buses["m"].adapter.latency, robot.buses["m"].return_delay_time) == (16_000_000, 500_000)
    scheduler = robot.loop.scheduler
    assert (scheduler.policy, scheduler.priority, scheduler.lock_memory) == ("other", 31, False)
    assert robot.loop.overrun == "skip"
    assert (robot.joints["j"].limits.position, robot.joints["j"].limits.velocity) == (None, None)
    assert robot.controllers == {}
    assert (robot.policies.on_exit, robot.policies.exit_timeout) == ("limp", 2_000_000_000)
    assert robot.recording.directory == "logs"


def test_a_robot_needs_buses_and_joints() -> None:
    assert desk.refusals("name: x\nloop: {rate: 1}\nbuses: {}\njoints: {}\n") == [
        "robot.yaml:3:8: buses has too few entries; write at least 1",
        "robot.yaml:4:9: joints has too few entries; write at least 1",
    ]


def test_the_text_and_the_places_are_kept() -> None:
    description = desk.robot(TORSO)
    assert description.text == TORSO
    file = str(description.path)
    assert description.marks.key("joints", "elbow") == Mark(file, 12, 3)
    assert description.marks.value("controllers", "arm", "joints", 1) == Mark(file, 15, 64)
    assert description.marks.value("joints", "elbow", "limits", "position") == Mark(file, 12, 3)


def test_entry_and_section_that_are_not_mappings_are_reported_together() -> None:
    head = TORSO[: TORSO.index("controllers:")]
    found = desk.refusals(head.replace("loop:\n", "loop: 50\nlop:\n") + "controllers: {a: 5}\n")
    assert [one.split(": ", 1)[1].partition(";")[0] for one in found] == [
        "loop is 50, but must be a mapping",
        "the file has an unknown key 'lop'",
        "controllers.a is 5, but must be a mapping",
    ]
