"""The files and programs of from-ros2-control.md and from-lerobot-rustypot-sdk.md work as shown."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.kit.pages import page_text

import dxlrun as face
from dxlrun import RemoteRobot
from dxlrun.testing import plan_of
from dxlrun.tooling.runs import VirtualLink
from dxlsim.simulation_plan import BusConfig, ServoConfig
from dxlwire.control_table import find_table

ROS2_CONTROL, LIBRARIES = page_text("from-ros2-control.md"), page_text("from-lerobot-rustypot-sdk.md")
Dxlrun = Callable[..., Any]
ROOT = Path(__file__).parents[2]
GOAL = find_table("XL330-M288").items["goal_position"].address


def commands(page: str) -> list[list[str]]:
    return [shlex.split(line)[1:] for line in re.findall(r"^    (dxlrun .+)$", page, re.MULTILINE)]


def blocks(page: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", page, re.MULTILINE | re.DOTALL)


def test_arm_of_ros2_control_is_checked_and_plays_its_motion(
    dxlrun: Dxlrun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    parameters, robot, motion = blocks(ROS2_CONTROL, "yaml")
    (tmp_path / "arm.yaml").write_text(robot)
    (tmp_path / "wave.yaml").write_text(motion)
    (tmp_path / "controllers.yaml").write_text(parameters)
    check, play, run = commands(ROS2_CONTROL)
    assert dxlrun(*check).code == 0
    assert (played := dxlrun(*play)).code == 0, played.out + played.err
    assert run == ["arm.yaml", "port:=/dev/ttyUSB0"]  # play is the same without a port
    refused = dxlrun("check", "controllers.yaml")
    assert refused.code == 2
    assert "a parameter file of ROS 2 (ros2_control)" in refused.err


def test_programs_of_the_sdk_and_rustypot_move_both_servos(simulated_line: Callable[..., Any]) -> None:
    pytest.importorskip("dynamixel_sdk", exc_type=ModuleNotFoundError)
    pytest.importorskip("rustypot", exc_type=ModuleNotFoundError)
    servos = tuple(ServoConfig(each, "XL330-M288", 2.0) for each in (1, 2))
    port, finish = simulated_line(BusConfig("main", 57_600, servos, 2.0))
    sdk, rustypot, _ = (text.replace("/dev/ttyUSB0", port) for text in blocks(LIBRARIES, "python"))
    exec(sdk, {})  # noqa: S102  of this repository
    names: dict[str, Any] = {}
    exec(rustypot, names)  # noqa: S102  of this repository
    assert len(names["positions"]) == 2
    sent = b"".join(entry.data for entry in finish() if entry.direction == "in")
    address = GOAL.to_bytes(2, "little")
    writes = re.findall(rb"\x03" + address + rb"(....)", sent, re.DOTALL)
    (synced,) = re.findall(rb"\x83" + address + rb"\x04\x00\x01(....)\x02(....)", sent, re.DOTALL)
    assert [int.from_bytes(goal, "little") for goal in writes] == [2048 + 114] * 2
    assert [int.from_bytes(goal, "little") for goal in synced] == [2048 + 113] * 2  # rustypot truncates


def test_client_moves_the_arm_that_a_scan_has_drafted(
    dxlrun: Dxlrun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, simulated_line: Callable[..., Any]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "robots").symlink_to(ROOT / "robots")
    servos = tuple(ServoConfig(each, "XL330-M288", 2.0) for each in (1, 2))
    port, finish = simulated_line(BusConfig("main", 57_600, servos, 2.0))
    simulate, scan, check, run, koch = commands(LIBRARIES)
    assert simulate[:3] == ["sim", "--servo", "XL330-M288:1-2"]
    given = [port if word == "/dev/ttyUSB0" else word for word in scan]
    assert dxlrun(*given, "--baud", "57600", "--ids", "1-2", "--protocol", "2.0").code == 0
    finish()
    assert dxlrun(*check).code == 0
    assert run == ["arm.yaml"]
    text = (tmp_path / "arm.yaml").read_text().replace(port, "sim")
    (tmp_path / "arm.yaml").write_text(text)
    link = VirtualLink(plan_of(tmp_path / "arm.yaml"))
    monkeypatch.setattr(face, "connect", lambda name: nullcontext(RemoteRobot(name, link)))
    exec(blocks(LIBRARIES, "python")[2], {})  # noqa: S102  of this repository
    for _ in range(200):
        link.run_cycle()
    cycles, _ = link.new()
    assert np.degrees(cycles["position"][-1]) == pytest.approx([10.0, 10.0], abs=1.0)
    assert dxlrun(*koch).code == 0
