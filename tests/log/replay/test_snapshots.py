"""A replay that begins with snapshots in the middle of a run does what the whole one does, bit for bit.

CI tries two robots for a second; `DXLRUN_SNAPSHOT_S=20 pytest tests/log/replay/test_snapshots.py` tries all.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec import structs

from dxlrun.channels.events import EventCode, Severity
from dxlrun.channels.snapshots import TOPIC
from dxlrun.control import loop, snapshots
from dxlrun.control.state.loop_state import controller_state
from dxlrun.errors import LogError
from dxlrun.log import part_writer
from dxlrun.log.reader import Log, open_log, read_log
from dxlrun.messages.cdr import Codec
from dxlrun.testing import VirtualRobot, plan_of, simulated_robot
from dxlrun_analysis.replay import ReplayReport, replay_log
from dxlrun_analysis.replay.recorded import RecordedPart, recorded
from dxlrun_analysis.replay.replay import replay_parts
from dxlrun_analysis.replay.tape import overview

from .test_same import motions_for
from .test_steered import GUESTS, ask, rate, send, switch

Change = Callable[..., Path]
ROBOTS = Path(__file__).parents[3] / "robots"
MS = 1_000_000
SECONDS = float(os.environ.get("DXLRUN_SNAPSHOT_S", "1"))
SAMPLE = ["leader_follower", "single_joint_learning"]
"""Of CI: chains and kept states; the small robot of the other tests has motions and streams."""
ROBOT_NAMES = sorted(path.stem for path in ROBOTS.glob("*.yaml")) if SECONDS > 1 else SAMPLE


@pytest.fixture(autouse=True)
def _often(monkeypatch: pytest.MonkeyPatch) -> None:
    """Take snapshots every 0.25 s instead of every 10 s."""
    for module in (loop, snapshots):
        monkeypatch.setattr(module, "INTERVAL_NS", 250 * MS)
    monkeypatch.setattr(part_writer, "MOST_BACK_NS", 500 * MS)


def from_each(path: Path) -> list[ReplayReport]:
    """Replay a log from each of its snapshots to its end."""
    reader = open_log(path)
    seen = overview(reader)
    inputs = recorded(seen)
    (whole,) = inputs.parts
    found = []
    for one in seen.rounds[:-1]:  # the run's end may have cut the last ones short
        first = int(np.searchsorted(inputs.cycles["cycle"], one.cycle)) + 1
        if first < whole.ends:
            part = RecordedPart(first, whole.end, whole.ends, one)
            found.append(replay_parts(reader, seen, replace(inputs, parts=(part,))))
    return found


def assert_equal_from_each(path: Path, least: int) -> None:
    cycles = read_log(path).cycles
    assert replay_log(path).same
    reports = from_each(path)
    assert len(reports) >= least
    for report in reports:
        (part,) = report.parts
        assert report.first is None
        assert report.same
        assert report.remarks == ()
        assert part.first == part.snapshot + 1
        assert report.compared == np.count_nonzero(cycles["cycle"] >= part.first)


@pytest.mark.campaign
@pytest.mark.parametrize("name", ROBOT_NAMES)
def test_a_robot_from_each_snapshot(name: str, tmp_path: Path) -> None:
    log = tmp_path / "run.mcap"
    robot = ROBOTS / f"{name}.yaml"
    seconds = SECONDS
    simulated_robot(robot, play=motions_for(robot), duration_s=seconds, log=log).run()
    assert_equal_from_each(log, 1)


STORIES: dict[str, dict[int, Any]] = {
    "another rate and a pause": {5: [rate(100)], 30: [ask("pause")], 48: [ask("resume")], 60: [rate(25)]},
    "a controller that is loaded": {5: GUESTS, 40: [send("guest", "posvel", 0.3, 1.0)]},
    "a switch": {20: [switch([], ["head"])], 40: [switch(["head"])]},
    "a halt": {14: [ask("halt")], 40: [switch(["head"])]},
}


@pytest.mark.parametrize("story", STORIES)
def test_a_steered_run_from_each_snapshot(run: Callable[..., Path], story: str) -> None:
    def steer(robot: VirtualRobot) -> None:
        take = robot.inbox.take

        def taken() -> Any:
            robot.inbox.waiting.extend(STORIES[story].get(robot.record.cycle, ()))
            return take()

        robot.inbox.take = taken  # type: ignore[method-assign]

    assert_equal_from_each(run(steer, duration_s=2.0), 2)


def without(first: int, last: int) -> Callable[[Any], None]:
    """Lose the cycles between two numbers, and what was published in them."""

    def change(content: Any) -> None:
        number = content.cycles["cycle"]
        lost = content.cycles[(number >= first) & (number <= last)]
        begin, end = int(lost["woken_ns"][0]), int(lost["written_ns"][-1])
        content.cycles = content.cycles[(number < first) | (number > last)]
        for name, messages in content.messages.items():
            content.messages[name] = [one for one in messages if not begin <= one[0] <= end]

    return change


def test_behind_a_hole_it_goes_on_with_the_next_snapshots(run: Callable[..., Path], changed: Change) -> None:
    report = replay_log(changed(run(duration_s=2.0), without(20, 40)))
    assert report.same
    first, second = report.parts
    assert (first.first, first.last, first.snapshot) == (0, 19, -1)
    assert (second.first, second.last, second.snapshot) == (53, 99, 52)
    assert report.sentence == "pair: cycles 0 to 19 and 53 to 99 (67 of 79) replayed, 0 differences"
    assert report.stopped == (
        "the log misses cycles between 20 and 40; what the controllers knew after that is lost until the "
        "snapshot of cycle 52"
    )


def test_without_its_beginning_it_starts_at_the_first_snapshots(
    run: Callable[..., Path], changed: Change
) -> None:
    def behead(content: Any) -> None:
        without(0, 24)(content)
        content.activation = None

    report = replay_log(changed(run(duration_s=2.0), behead))
    assert report.same
    assert [(part.first, part.last, part.snapshot) for part in report.parts] == [(27, 99, 26)]
    assert report.stopped.startswith("the log begins with cycle 25; ")


def test_without_beginning_and_snapshots_it_is_refused(run: Callable[..., Path], changed: Change) -> None:
    def behead(content: Any) -> None:
        without(0, 24)(content)
        del content.messages[TOPIC]

    with pytest.raises(LogError, match="there is no snapshot of them, so nothing can be compared"):
        replay_log(changed(run(duration_s=2.0), behead))


def test_a_difference_behind_the_snapshots_is_found(run: Callable[..., Path], changed: Change) -> None:
    def flip(content: Any) -> None:
        without(20, 40)(content)
        row = np.flatnonzero(content.cycles["cycle"] == 80)[0]
        content.cycles["command_position"][row].view(np.uint64)[1] ^= np.uint64(1)

    report = replay_log(changed(run(duration_s=2.0), flip))
    assert (report.different, report.first and report.first.cycle) == (1, 80)


def states(log: Log) -> dict[str, list[str]]:
    """Return of each controller why its snapshots have no state."""
    topic = log.topics[TOPIC]
    codec = Codec(topic.type)
    found: dict[str, list[str]] = {}
    for data in topic.data:
        values = codec.unpack(data)
        if values["controller"] and values["pieces"] == 1:
            state = controller_state(np.asarray(values["data"], np.uint8).tobytes())
            found.setdefault(str(values["controller"]), []).append(state.problem)
    return found


def test_a_controller_that_cannot_be_written_down_is_stood_in_for(
    run: Callable[..., Path], changed: Change, monkeypatch: pytest.MonkeyPatch
) -> None:
    import all_inputs  # the plug-in of these tests

    configure = all_inputs.AllInputs.on_configure

    def with_generator(self: Any, context: Any) -> None:
        configure(self, context)
        self.endless = iter(lambda: 0, 1)

    monkeypatch.setattr(all_inputs.AllInputs, "on_configure", with_generator)
    log = run(duration_s=2.0)
    assert set(states(read_log(log))["all_inputs"]) == {"holds a builtins.callable_iterator"}
    report = replay_log(changed(log, without(20, 40)))
    assert report.same
    (remark,) = report.remarks
    assert remark.startswith(
        "all_inputs is not replayed from cycle 52 on: its state is not in the log (holds a builtins"
    )


def test_a_controller_writes_its_state_itself(
    run: Callable[..., Path], changed: Change, monkeypatch: pytest.MonkeyPatch
) -> None:
    import all_inputs

    cls = all_inputs.AllInputs
    monkeypatch.setattr(
        cls, "snapshot", lambda self: np.append(self.sum, self.number).tobytes(), raising=False
    )

    def restore(self: Any, state: bytes) -> None:
        values = np.frombuffer(state)
        self.sum, self.number = values[:-1], int(values[-1])

    monkeypatch.setattr(cls, "restore", restore, raising=False)
    log = run(duration_s=2.0)
    report = replay_log(changed(log, without(20, 40)))
    assert report.same
    assert report.remarks == ()
    # one that forgets a part of its state is found out
    monkeypatch.setattr(cls, "restore", lambda self, state: restore(self, bytes(len(state))))
    report = replay_log(changed(log, without(20, 40)))
    assert not report.same
    assert report.first is not None
    assert report.first.controller == "all_inputs"


@pytest.mark.parametrize(("at", "before"), [(12, 20), (20, 100), (60, 300), (68, 100), (75, 20), (97, 300)])
def test_what_a_trigger_keeps_is_replayed_from_before_the_fault(
    robot_file: Path, tmp_path: Path, at: int, before: int
) -> None:
    """Whatever lies between the fault and the last snapshots, before it and behind what is written."""
    plan = plan_of(robot_file, play=[robot_file.with_name("look.yaml")], duration_s=2.5)
    recording = structs.replace(plan.recording, trigger="fault", before_ns=before * MS, after_ns=100 * MS)
    robot = VirtualRobot(structs.replace(plan, recording=recording), log=tmp_path / "run")
    take = robot.inbox.take

    def taken() -> Any:
        if robot.record.cycle == at:
            robot.sinks.events.emit(EventCode.CONTROLLER_SAYS, Severity.ERROR, "head", "its servo is silent")
        return take()

    robot.inbox.take = taken  # type: ignore[method-assign]
    robot.run()

    period = 20
    report = replay_log(tmp_path / "run")
    assert report.same
    assert report.remarks == ()
    compared = {number for part in report.parts for number in range(part.first, part.last + 1)}
    assert set(range(at - before // period, at + 100 // period)) <= compared
    log = read_log(tmp_path / "run")
    assert len(log.cycles) < 60  # the rest is left out
    assert sum(one.cycles for one in log.left_out) + len(log.cycles) == 125


def raising(*_: object) -> bytes:
    raise RuntimeError("no")


WRONG: dict[str, tuple[Any, Any, str]] = {
    "a snapshot raises": (raising, lambda *_: None, "raised in snapshot: RuntimeError: no"),
    "a snapshot ends the process": (
        lambda _: sys.exit(3),
        lambda *_: None,
        "raised in snapshot: SystemExit: 3",
    ),
    "10 MB": (
        lambda _: bytes(10_000_000),
        lambda *_: None,
        "returned in snapshot what is not at most 1048576",
    ),
    "a text": (lambda _: "state", lambda *_: None, "returned in snapshot what is not at most 1048576 bytes"),
    "restore raises": (lambda _: b"state", raising, "raised in restore: RuntimeError: no"),
}


@pytest.mark.parametrize("what", WRONG)
def test_a_controller_whose_snapshots_are_wrong_runs_on_and_is_stood_in_for(
    run: Callable[..., Path], changed: Change, monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    import all_inputs

    take, restore, said = WRONG[what]
    monkeypatch.setattr(all_inputs.AllInputs, "snapshot", take, raising=False)
    monkeypatch.setattr(all_inputs.AllInputs, "restore", restore, raising=False)
    log = run(duration_s=1.5)
    assert read_log(log).cycles["active"].all()
    report = replay_log(changed(log, without(20, 30)))
    assert report.same
    (remark,) = report.remarks
    assert remark.startswith("all_inputs is not replayed from cycle ")
    assert said in remark


def test_one_whose_snapshots_took_too_long_twice_has_none_any_more(
    run: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(snapshots, "MOST_SHARE", -1.0)  # on virtual time none takes any
    first, second, *others = states(read_log(run(duration_s=2.0)))["all_inputs"]
    assert (first, second) == ("", "")
    assert set(others) == {"its snapshots took more than -100% of a period"}
