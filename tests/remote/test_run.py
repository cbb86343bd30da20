"""Whole runs: one that is steered from Python until it is told to stop, and one whose gateway dies."""

import json
import os
import signal
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from tests.kit.awaited import until
from tests.kit.live_run import ROBOT, LiveRuns

import dxlrun

SOLO = "  solo: {type: joint_group_position_controller, joints: [pan], active: false}\n"
STATES = '  states: {type: "${type}"}\n'


class Run:
    """A run with a client, in a directory of its own, and what it left behind."""

    def __init__(self, runs: LiveRuns, directory: Path) -> None:
        self.running = runs.start(directory=directory, gateway=True)
        until(lambda: "pair" in dxlrun.running(), "the gateway", check=self.running.lives)
        self.robot = dxlrun.connect(client="anna")

    def finish(self):
        self.code, self.out, self.err = self.running.finish()
        self.log = self.running.log()


@pytest.fixture(scope="module")
def runs(tmp_path_factory) -> Iterator[LiveRuns]:
    with pytest.MonkeyPatch.context() as patch:
        directory = tmp_path_factory.mktemp("run")
        patch.setenv("XDG_RUNTIME_DIR", str(directory))
        runs = LiveRuns(directory)
        (directory / "pair.yaml").write_text(ROBOT.replace(STATES, "") + SOLO)
        yield runs
        runs.end()


@pytest.fixture(scope="module")
def place(runs) -> Path:
    """The directory of sockets."""
    return Path(os.environ["XDG_RUNTIME_DIR"]) / "dxlrun"


@pytest.fixture(scope="module")
def steered(tmp_path_factory, runs, place):
    """A run that was steered with everything there is, and stopped by its client."""
    run = Run(runs, tmp_path_factory.mktemp("steered"))
    robot = run.robot
    robot.send("hold", "positions", {"positions": np.array([0.1, 0.1])})
    with pytest.raises(dxlrun.Refused, match="pan"):
        robot.switch("solo")
    robot.switch(activate=["solo"], deactivate=["hold"])
    with robot.stream("solo", "positions", lease=0.1) as stream:
        assert stream.send({"positions": [1e9]}) == 1
        for step in range(5):
            assert stream.send({"positions": [0.01 * step]}) == 0
        assert stream.clamped == 1
    until(lambda: robot.info()["controllers"][1]["held"], "the end of the stream's lease")
    robot.rate(100.0)
    robot.pause()
    robot.load("more", {"type": "joint_group_position_controller", "joints": ["tilt"], "rate": 50})
    robot.resume()
    robot.switch(activate=["more"])
    robot.send("more", "positions", {"positions": [0.2]})
    run.info, run.states, run.events = robot.info(), robot.states(), robot.events()
    robot.stop()
    run.stopped = run.running.log()  # at once: `stop` returns when the log is closed
    run.finish()
    yield run
    run.robot.close()


def test_a_steered_run_ends_well_when_its_client_stops_it(steered, place):
    assert (steered.code, steered.err) == (0, ""), steered.out + steered.err
    assert steered.stopped.complete
    assert list(place.iterdir()) == []
    with pytest.raises(dxlrun.DxlrunError, match=r"pair no longer answers: .*No such file"):
        steered.robot.info()


def test_the_log_has_every_command_and_its_client(steered):
    commands = steered.log.commands
    asked = [(one.controller, one.kind) for one in commands if not one.lease_ns]
    assert asked == [
        ("hold", "positions"),
        ("", "switch"),
        ("", "switch"),
        ("", "rate"),
        ("", "pause"),
        ("", "load"),
        ("", "resume"),
        ("", "switch"),
        ("more", "positions"),
        ("", "stop"),
    ]
    assert {one.origin for one in commands} == {"anna"}
    streamed = [one for one in commands if one.lease_ns]
    assert 1 <= len(streamed) <= 6
    assert {(one.controller, one.lease_ns) for one in streamed} == {("solo", 100_000_000)}
    assert np.frombuffer(streamed[-1].data) == pytest.approx([0.04])  # the newest of them always arrives


def test_clients_can_read_what_became_of_their_commands(steered):
    info = steered.info
    told = {one["name"]: (one["active"], one["rate"]) for one in info["controllers"]}
    assert told == {"hold": (False, 100.0), "solo": (True, 100.0), "more": (True, 50.0)}
    assert (info["rate"], info["paused"], info["joints"]) == (100.0, False, ["pan", "tilt"])
    assert steered.states.joints == ("pan", "tilt")
    names = [event["name"] for event in steered.events["events"]]
    assert "stale_command" in names
    assert names.count("steered") == 6
    json.dumps(steered.events)


def test_without_its_gateway_the_run_continues_with_a_remark(tmp_path, runs, place):
    run = Run(runs, tmp_path)
    before = run.robot.info()["cycles"]
    os.kill(run.running.child("remote"), signal.SIGKILL)
    until(lambda: not list(place.iterdir()), "the removal of the dead socket")
    with pytest.raises(dxlrun.DxlrunError, match="pair no longer answers"):
        run.robot.pause()
    until(lambda: len(run.running.log().cycles) > before + 25, "more cycles")
    run.running.signal(signal.SIGINT)
    run.finish()
    assert run.code == 130, run.out + run.err
    assert "the gateway ended: the run continues, but cannot be steered" in " ".join(run.err.split())
    assert run.log.complete
