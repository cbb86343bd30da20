"""`dxlrun demo`: one command after an installation, without a clone."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import dxlrun.cli
from dxlrun.cli import run as run_room
from dxlrun.cli import verb_registry
from dxlrun.cli.inputs import examples_directory
from dxlrun.remote import sockets

Dxlrun = Callable[..., Any]


def test_demo_plays_its_motion_in_an_empty_directory(
    dxlrun: Dxlrun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    ran = dxlrun("demo", "--virtual")
    assert (ran.code, "bioloid_torso: done: ran for 35.0 s; 3 of 3 goals reached" in ran.out) == (0, True)
    assert "warning" not in ran.err
    assert len([*(tmp_path / "logs").glob("bioloid_torso_*.mcap")]) == 1


def test_files_of_the_demo_are_among_the_examples_of_the_wheel() -> None:
    """tests/test_suite.py builds the wheel and compares its examples with the folder of robots."""
    assert all((examples_directory() / name).is_file() for name in run_room.DEMO)


class Served:
    """Stands for the process that serves the page."""

    def __init__(self, command: list[str]) -> None:
        self.command = command
        self.ended: list[str] = []

    def terminate(self) -> None:
        self.ended.append("terminate")

    def wait(self) -> int:
        self.ended.append("wait")
        return 0


@pytest.mark.parametrize("options", [{}, {"page": False}])
def test_page_is_served_during_the_run_where_it_is_installed(
    monkeypatch: pytest.MonkeyPatch, options: dict[str, bool]
) -> None:
    started: list[Served] = []

    def start(command: list[str]) -> Served:
        started.append(Served(command))
        return started[-1]

    def run(*_: object, **__: object) -> int:
        assert [served.ended for served in started] == [[]] * len(started)
        return 7

    monkeypatch.setattr(subprocess, "Popen", start)
    monkeypatch.setattr(run_room, "_run_plan", run)
    monkeypatch.setattr(verb_registry, "packaged", lambda: {"view": object()})
    monkeypatch.setattr(sockets, "running", lambda: ("other",))
    assert run_room.demo(**options) == 7
    assert [served.command[-1] for served in started] == ["other"] * (not options)
    assert [served.ended for served in started] == [["terminate", "wait"]] * (not options)


def test_demo_without_the_page_names_the_package(
    dxlrun: Dxlrun, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(run_room, "_run_plan", lambda *_, **__: 0)
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
    monkeypatch.setattr(
        run_room, "await_robot", lambda others: "bioloid_torso" if others == ["other"] else ""
    )
    monkeypatch.setattr(dxlrun.cli, "main", shown.append)
    monkeypatch.setattr(sys, "argv", ["-c", "other"])
    with pytest.raises(SystemExit):
        exec(run_room._SHOW_PAGE, {})  # noqa: S102  of this repository
    assert shown == [["view", "bioloid_torso"]]
