"""`dxlrun demo`: one command after an installation, without a clone."""

import subprocess
import sys
from typing import Any
from unittest.mock import Mock, call

import pytest
from tests.kit.commands import Dxlrun

import dxlrun.cli
from dxlrun.cli import run as run_room
from dxlrun.cli import verb_registry
from dxlrun.cli.inputs import examples_directory
from dxlrun.compile.robot_compiler import CompiledRobot
from dxlrun.remote import sockets


def test_demo_is_the_first_command_of_the_readme(dxlrun: Dxlrun, monkeypatch: pytest.MonkeyPatch) -> None:
    """tests/test_readme.py runs it; tests/test_suite.py builds the wheel and compares its examples."""
    robots: list[tuple[CompiledRobot, dict[str, Any]]] = []
    monkeypatch.setattr(run_room, "_run_compiled", lambda one, *_, **how: robots.append((one, how)) or 0)
    said = dxlrun("demo", "--virtual")
    assert (said.code, said.err) == (0, "")
    ((robot, options),) = robots
    assert options["virtual"]
    plan = robot.plan
    assert (plan.robot, plan.loop.end_ns) == ("bioloid_torso", 35_000_000_000)
    assert {one.controller for one in plan.loop.commands} == {"head", "left_arm", "right_arm"}
    files = [str(examples_directory() / name) for name in run_room.DEMO]
    assert [name.rpartition("/")[2] for name in files] == ["bioloid_torso.yaml", "three_parts.yaml"]


@pytest.mark.parametrize("options", [{}, {"page": False}])
def test_page_is_served_during_the_run_where_it_is_installed(
    monkeypatch: pytest.MonkeyPatch, options: dict[str, bool]
) -> None:
    start = Mock()
    served = start.return_value

    def run(*_: object, **__: object) -> int:
        assert served.method_calls == []
        return 7

    monkeypatch.setattr(subprocess, "Popen", start)
    monkeypatch.setattr(run_room, "_run_compiled", run)
    monkeypatch.setattr(verb_registry, "packaged", lambda: {"view": object()})
    monkeypatch.setattr(sockets, "running", lambda: ("other",))
    assert run_room.demo(**options) == 7
    assert [command[-1] for (command,), _ in start.call_args_list] == ["other"] * (not options)
    assert served.method_calls == [call.terminate(), call.wait()] * (not options)


def test_demo_without_the_page_names_the_package(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(run_room, "_run_compiled", lambda *_, **__: 0)
    monkeypatch.setattr(verb_registry, "packaged", dict)
    assert run_room.demo() == 0
    assert "install dxlrun-view" in capsys.readouterr().out


def test_page_is_that_of_the_robot_that_has_just_started(monkeypatch: pytest.MonkeyPatch) -> None:
    found = [("other",), ("other",), ("bioloid_torso", "other")]
    monkeypatch.setattr(sockets, "running", lambda: found.pop(0))
    monkeypatch.setattr(run_room, "_POLL_S", 0.01)
    assert run_room.await_robot(["other"]) == "bioloid_torso"
    monkeypatch.setattr(sockets, "running", lambda: ("other",))
    monkeypatch.setattr(run_room, "_START_S", 0.03)
    with pytest.raises(SystemExit, match="1"):
        run_room.await_robot(["other"])


def test_process_of_the_page_runs_the_command_view(monkeypatch: pytest.MonkeyPatch) -> None:
    shown: list[list[str]] = []
    robots = {("other",): "bioloid_torso"}
    monkeypatch.setattr(run_room, "await_robot", lambda others: robots.get(tuple(others)))
    monkeypatch.setattr(dxlrun.cli, "main", shown.append)
    monkeypatch.setattr(sys, "argv", ["-c", "other"])
    with pytest.raises(SystemExit):
        exec(run_room._SHOW_PAGE, {})  # noqa: S102  of this repository
    assert shown == [["view", "bioloid_torso"]]
