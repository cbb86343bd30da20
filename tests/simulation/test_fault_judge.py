"""The judge of runs with faults can fail: at an answer of another servo or kind, at none, at no cause."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import pytest
from msgspec import structs
from tests.kit import storms
from tests.kit.judges import log_has_every_byte
from tests.kit.line_faults import OTHER_HOST, other_host

from dxlrun.channels.event_records import Event, EventCode, Severity
from dxlrun.log.log_reader import Log, read_log
from dxlrun.testing import VirtualRobot, simulated_robot
from dxlsim.bus.ledger import LedgerEntry
from dxlwire.wire import protocol2

judge = storms.faults_and_events_answer_each_other


class Run(NamedTuple):
    """A run of three servos, with something that happened to them."""

    robot: VirtualRobot
    log: Log

    @classmethod
    def of(cls, directory: Path, duration_s: float, prepare: Callable[[VirtualRobot], object]) -> Run:
        path = directory / "run.mcap"
        robot = simulated_robot(storms.servos(directory, {"main": (2.0, 3)}), duration_s=duration_s, log=path)
        prepare(robot)
        robot.run()
        return cls(robot, read_log(path))

    @property
    def entries(self) -> list[LedgerEntry]:
        return list(self.robot.ledger.entries)

    def with_events(self, *events: Event) -> Log:
        return replace(self.log, events=(*self.log.events, *events))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """The second servo is silent for a while, and the whole judge is content."""
    trials: list[storms.Trial] = []
    faults = ["silence servo=2 at=500ms for=200ms"]
    made = Run.of(
        tmp_path_factory.mktemp("judged"), 3.0, lambda robot: trials.append(storms.Trial.of(robot, faults))
    )
    trials[0].judge(made.log)
    return made


@pytest.fixture(scope="module")
def shared_line(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Another host sends goals to the second servo, between the exchanges and into them."""
    packet = protocol2.write_range(2, 116, (2048).to_bytes(4, "little"))

    def prepare(robot: VirtualRobot) -> None:
        for number in range(10):
            other_host(robot.buses[0], packet, 1_000_000_000 + number * 31_000_000)

    return Run.of(tmp_path_factory.mktemp("shared"), 2.0, prepare)


SILENT, OVERRUN = {EventCode.READ_LOST, EventCode.SERVO_LOST}, EventCode.OVERRUN
WRONG: dict[str, Callable[[Event], Event | None]] = {
    "of another servo": lambda one: structs.replace(one, source="j1") if one.source == "j2" else one,
    "of a wrong kind": lambda one: (
        structs.replace(one, code=EventCode.OVERRUN) if one.code in SILENT else one
    ),
    "missing": lambda one: None if one.source == "j2" else one,
}


@pytest.mark.parametrize("changed", WRONG)
def test_a_fault_without_its_answer_fails(run, changed):
    events = tuple(event for event in map(WRONG[changed], run.log.events) if event is not None)
    with pytest.raises(AssertionError, match="silence servo=2"):
        judge(run.entries, replace(run.log, events=events))


def test_an_event_without_a_fault_fails(run):
    entries = [entry for entry in run.entries if not entry.note.startswith("fault: ")]
    with pytest.raises(AssertionError, match="read_lost"):
        judge(entries, run.log)


@pytest.mark.parametrize("direction", ["in", "out"])
def test_a_byte_that_the_log_does_not_have_fails(run, direction):
    entries = run.entries
    at = next(i for i, entry in enumerate(entries) if i > 40 and entry.direction == direction)
    wrong = entries[at]._replace(data=entries[at].data[:-1] + b"\x55")
    log_has_every_byte(run.log, entries)
    for instead in ([wrong], []):
        with pytest.raises(AssertionError):
            log_has_every_byte(run.log, [*entries[:at], *instead, *entries[at + 1 :]])


@pytest.mark.parametrize("code", [EventCode.SERVO_REBOOTED, EventCode.SERVO_LIMP])
def test_a_second_servo_of_an_id_is_a_cause_for_what_is_read_of_that_id_alone(run, code):
    twin = LedgerEntry(1_000_000_000, "main", "note", b"", note="fault: duplicate_id servo=2 at=1s")
    seen = [Event(2_500_000_000, code, Severity.ERROR, joint, "") for joint in ("j2", "j3")]
    judge([*run.entries, twin], run.with_events(seen[0]))
    with pytest.raises(AssertionError, match=seen[1].name):
        judge([*run.entries, twin], run.with_events(*seen))
    with pytest.raises(AssertionError, match=seen[0].name):
        judge(run.entries, run.with_events(seen[0]))


def test_another_host_on_the_line_leaves_an_event_that_has_its_cause_in_the_ledger(shared_line):
    noted = [event for event in shared_line.log.events if event.code == EventCode.UNREQUESTED]
    assert [(event.source, event.severity) for event in noted] == [("main", Severity.WARNING)]
    judge(shared_line.entries, shared_line.log)
    entries = [entry for entry in shared_line.entries if not entry.note.startswith(OTHER_HOST)]
    with pytest.raises(AssertionError, match="unrequested"):
        judge(entries, shared_line.log)
