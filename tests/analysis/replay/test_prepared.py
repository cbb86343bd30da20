"""Commands are prepared again: a `prepare` that makes something else of the same request is found out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from msgspec import structs
from numpy.typing import NDArray

from dxlrun.channels.commands import Command, decode_command, encode_command
from dxlrun.control.controllers.plugins import load_plugins
from dxlrun.description import read_motion
from dxlrun.log.reader import read_log
from dxlrun.remote.motions import Running, play
from dxlrun.remote.preparation import Preparation
from dxlrun.testing import VirtualRobot
from dxlrun_analysis.replay import Setting, replay_log
from dxlrun_controllers.motions.joint_trajectory_controller import JointTrajectoryController

Change = Callable[..., Path]
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

    def take(original: Any = robot.inbox.take) -> Any:
        if record.cycle % 5 == 3 and record.cycle < 30:
            body = msgspec.json.encode({"points": [{"time": 0.1, "positions": [0.01 * record.cycle]}]})
            made = preparation.command(plans["head"], "trajectory", body)
            waiting.append(Command(0, "head", "trajectory", made.data, "anna", request=made.request))
        if record.cycle == 40:
            compiled = {"head": preparation.compiled(structs.replace(plans["head"], active=True))}
            motion = read_motion(Path(robot.plan.source_file).with_name("look.yaml"))
            played = play(motion, Running(compiled, preparation.joints, record), 1.0)
            waiting.append(Command(0, "", "play", played.data, "anna", request=played.request))
        return original()

    robot.inbox.take = take  # type: ignore[method-assign]


def test_the_same_prepare_makes_the_same_arrays(run: Callable[..., Path]) -> None:
    report = replay_log(run(asked))
    assert report.same
    assert (report.prepared, report.different_prepared, report.unprepared) == (8, 0, 0)


def test_a_doubled_array_of_the_plan_is_named(pair_log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert replay_log(pair_log).prepared == 1
    doubled(monkeypatch, JointTrajectoryController)
    report = replay_log(pair_log)
    assert not report.same
    assert (report.prepared, report.different_prepared) == (1, 1)
    assert report.first is not None
    assert (report.first.cycle, report.first.controller) == (10, "head")
    assert report.first.time_s == pytest.approx(0.2)
    assert report.first.what.startswith("array that prepare made of trajectory, element ")
    assert float(report.first.replayed) == 2 * float(report.first.recorded)


def test_a_change_that_moves_nothing_is_found_too(pair_log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # the last bit of one number far in the array: no goal need show it
    def nudge(array: NDArray[np.float64]) -> NDArray[np.float64]:
        array = array.copy()
        array[-1:] = np.nextafter(array[-1:], np.inf)
        return array

    doubled(monkeypatch, JointTrajectoryController, nudge)
    report = replay_log(pair_log)
    assert report.different_prepared == 1
    if not report.different:
        assert "1 of 1 prepared command differs" in report.sentence


def test_commands_of_clients_and_motions_are_prepared_again(
    run: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    log = run(asked)
    doubled(monkeypatch, JointTrajectoryController, lambda array: np.append(array, 1.0))
    report = replay_log(log)
    assert (report.prepared, report.different_prepared) == (8, 8)
    assert report.first is not None
    assert report.first.cycle == 3
    assert (report.first.recorded, report.first.replayed) == (
        f"{len(read_log(log).commands[0].numbers)} numbers",
        f"{len(read_log(log).commands[0].numbers) + 1} numbers",
    )


def test_a_prepare_that_refuses_now_is_a_difference(pair_log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(array: NDArray[np.float64]) -> NDArray[np.float64]:
        raise ValueError("no such motion any more")

    doubled(monkeypatch, JointTrajectoryController, refuse)
    report = replay_log(pair_log)
    assert report.different_prepared == 1
    assert report.first is not None
    assert report.first.replayed == "no array (ValueError: no such motion any more)"
    assert not report.different  # the recorded array is handed on


def test_other_parameters_prepare_other_arrays(pair_log: Path) -> None:
    report = replay_log(pair_log, [Setting.parse("head.command_interface=position")])
    assert report.prepared == 1  # whether they differ is the controller's own matter


def test_a_request_that_the_log_does_not_have_is_reported(pair_log: Path, changed: Change) -> None:
    def forget(content: Any) -> None:
        plan = msgspec.json.decode(content.attachments["plan.json"])
        for command in plan["loop"]["commands"]:
            del command["request"]
        content.attachments["plan.json"] = msgspec.json.encode(plan)

    report = replay_log(changed(pair_log, forget))
    assert report.same
    assert report.prepared == 0
    assert report.unprepared == 1


def test_a_request_is_left_out_where_there_is_no_room() -> None:
    command = Command(7, "head", "positions", bytes(800), "anna", 5, b'{"positions":[1.0]}')
    assert decode_command(encode_command(command)) == command
    whole = len(encode_command(command))
    assert decode_command(encode_command(command, whole - 1)) == replace(command, request=b"")
