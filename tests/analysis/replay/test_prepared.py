"""Commands are prepared again: a `prepare` that makes something else of the same request is found out."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from msgspec import structs
from numpy.typing import NDArray
from tests.kit.anew import plan
from tests.kit.stories import differing

from dxlrun.channels.commands import CommandMessage, encode_command
from dxlrun.channels.tagged import decode
from dxlrun.control.controllers.plugin_loading import load_plugins
from dxlrun.description.motion import read_motion
from dxlrun.log.log_reader import read_log
from dxlrun.remote.motion_requests import RunSnapshot, schedule_motion
from dxlrun.remote.preparation import Preparation
from dxlrun.testing import VirtualRobot
from dxlrun_analysis.replay import replay_log
from dxlrun_controllers.motions.joint_trajectory_controller import JointTrajectoryController

Prepare = Callable[..., NDArray[np.float64]]


def doubled(monkeypatch: pytest.MonkeyPatch, cls: type[Any], of: Callable[[Any], Any] | None = None) -> None:
    """Let `prepare` of a controller make its array twice as large, or whatever `of` makes of it."""
    before: Prepare = cls.prepare
    change = of or (lambda array: array * 2)
    monkeypatch.setattr(cls, "prepare", staticmethod(lambda *of_it: change(before(*of_it))))


def asked(robot: VirtualRobot) -> None:
    """Hand over a command of a client every fifth cycle, and play the motion again at the end."""
    plans = {one.name: one for one in robot.plan.loop.controllers}
    preparation = Preparation({joint.name: joint for joint in robot.plan.loop.joints}, load_plugins())
    waiting, record = robot.inbox.waiting, robot.record

    def take(original: Any = robot.inbox.drain_commands) -> Any:
        if record.cycle % 5 == 3 and record.cycle < 30:
            body = msgspec.json.encode({"points": [{"time": 0.1, "positions": [0.01 * record.cycle]}]})
            made = preparation.command(plans["head"], "trajectory", body)
            waiting.append(CommandMessage(0, "head", "trajectory", made.data, "anna", request=made.request))
        if record.cycle == 40:
            compiled = {"head": preparation.compiled(structs.replace(plans["head"], active=True))}
            motion = read_motion(Path(robot.plan.source_file).with_name("look.yaml"))
            played = schedule_motion(motion, RunSnapshot(compiled, preparation.joints, record), 1.0)
            waiting.append(CommandMessage(0, "", "play", played.data, "anna", request=played.request))
        return original()

    robot.inbox.drain_commands = take  # type: ignore[method-assign]


def test_the_same_prepare_makes_the_same_arrays_and_another_one_is_found(
    run: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of clients and motions too."""
    log = run(asked)
    report = replay_log(log)
    assert report.same
    assert (report.prepared, report.different_prepared, report.unprepared) == (8, 0, 0)

    doubled(monkeypatch, JointTrajectoryController, lambda array: np.append(array, 1.0))
    report, first = differing(log)
    assert (report.prepared, report.different_prepared) == (8, 8)
    count = len(read_log(log).commands[0].numbers)
    assert (first.cycle, first.recorded, first.replayed) == (3, f"{count} numbers", f"{count + 1} numbers")


def test_a_doubled_array_of_the_plan_is_named(pair_log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert replay_log(pair_log).prepared == 1
    doubled(monkeypatch, JointTrajectoryController)
    report, first = differing(pair_log)
    assert (report.prepared, report.different_prepared) == (1, 1)
    assert (first.cycle, first.controller) == (10, "head")
    assert first.time_s == pytest.approx(0.2)
    assert first.what.startswith("prepared array of command trajectory, element ")
    assert float(first.replayed) == 2 * float(first.recorded)


def test_a_change_that_moves_nothing_is_found_too(pair_log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # the last bit of one number far in the array: no goal need show it
    def nudge(array: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.append(array[:-1], np.nextafter(array[-1:], np.inf))

    doubled(monkeypatch, JointTrajectoryController, nudge)
    report, _ = differing(pair_log)
    assert report.different_prepared == 1
    if not report.different:
        assert "1 of 1 prepared command differs" in report.sentence


def test_a_prepare_that_refuses_now_is_a_difference(pair_log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(array: NDArray[np.float64]) -> NDArray[np.float64]:
        raise ValueError("no such motion any more")

    doubled(monkeypatch, JointTrajectoryController, refuse)
    report, first = differing(pair_log)
    assert report.different_prepared == 1
    assert first.replayed == "no array (ValueError: no such motion any more)"
    assert not report.different  # the recorded array is handed on


def test_a_request_that_the_log_does_not_have_is_reported(
    pair_log: Path, changed: Callable[..., Path]
) -> None:
    forget = plan(lambda content: [command.pop("request") for command in content["loop"]["commands"]])
    report = replay_log(changed(pair_log, forget))
    assert (report.same, report.prepared, report.unprepared) == (True, 0, 1)


def test_a_request_is_left_out_where_there_is_no_room() -> None:
    command = CommandMessage(7, "head", "positions", bytes(800), "anna", 5, b'{"positions":[1.0]}')
    assert decode(encode_command(command)) == command
    whole = len(encode_command(command))
    assert decode(encode_command(command, whole - 1)) == structs.replace(command, request=b"")
