"""The judge of runs with faults can fail: at an answer of another servo or kind, at none, at no cause."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import pytest
from msgspec import structs
from tests.kit import storms
from tests.kit.judges import log_has_every_byte
from tests.kit.line_faults import OTHER_HOST, other_host

from dxlrun.channels.event_records import Event, EventCode, Severity
from dxlrun.log.log_reader import Log, read_log
from dxlrun.testing import simulated_robot
from dxlsim.bus.ledger import LedgerEntry
from dxlwire.wire import protocol2

THREE = {"main": (2.0, 3)}
FAULT = "silence servo=2 at=500ms for=200ms"


class Run(NamedTuple):
    log: Log
    entries: list[LedgerEntry]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A run in which the second of three servos is silent for a while."""
    directory = tmp_path_factory.mktemp("judged")
    log = directory / "run.mcap"
    robot = simulated_robot(storms.servos(directory, THREE), duration_s=3.0, log=log)
    trial = storms.Trial.of(robot, [FAULT])
    robot.run()
    read = read_log(log)
    trial.judge(read)
    return Run(read, list(robot.ledger.entries))


def of_another_servo(event: Event) -> Event | None:
    return structs.replace(event, source="j1") if event.source == "j2" else event


def of_a_wrong_kind(event: Event) -> Event | None:
    silent = event.code in {EventCode.READ_LOST, EventCode.SERVO_LOST}
    return structs.replace(event, code=EventCode.OVERRUN) if silent else event


def missing(event: Event) -> Event | None:
    return None if event.source == "j2" else event


@pytest.mark.parametrize("changed", [of_another_servo, of_a_wrong_kind, missing])
def test_a_fault_without_its_answer_fails(run, changed):
    events = tuple(event for event in map(changed, run.log.events) if event is not None)
    log = replace(run.log, events=events)

    with pytest.raises(AssertionError, match="silence servo=2"):
        storms.faults_and_events_answer_each_other(run.entries, log)


def test_an_event_without_a_fault_fails(run):
    entries = [entry for entry in run.entries if not entry.note.startswith("fault: ")]

    with pytest.raises(AssertionError, match="read_lost"):
        storms.faults_and_events_answer_each_other(entries, run.log)


@pytest.mark.parametrize("change", ["in", "out"])
def test_a_byte_that_the_log_does_not_have_fails(run, change):
    at = next(i for i, entry in enumerate(run.entries) if i > 40 and entry.direction == change)
    entries = list(run.entries)
    entries[at] = entries[at]._replace(data=entries[at].data[:-1] + b"\x55")
    log_has_every_byte(run.log, run.entries)
    with pytest.raises(AssertionError):
        log_has_every_byte(run.log, entries)
    with pytest.raises(AssertionError):
        log_has_every_byte(run.log, run.entries[:at] + run.entries[at + 1 :])


@pytest.mark.parametrize("code", [EventCode.SERVO_REBOOTED, EventCode.SERVO_LIMP])
def test_a_second_servo_of_an_id_is_a_cause_for_what_is_read_of_that_id_alone(run, code):
    twin = LedgerEntry(1_000_000_000, "main", "note", b"", note="fault: duplicate_id servo=2 at=1s")
    entries = [*run.entries, twin]
    seen = [Event(2_500_000_000, code, Severity.ERROR, joint, "") for joint in ("j2", "j3")]
    storms.faults_and_events_answer_each_other(entries, replace(run.log, events=(*run.log.events, seen[0])))
    with pytest.raises(AssertionError, match=seen[1].name):
        storms.faults_and_events_answer_each_other(entries, replace(run.log, events=(*run.log.events, *seen)))
    with pytest.raises(AssertionError, match=seen[0].name):
        storms.faults_and_events_answer_each_other(
            run.entries, replace(run.log, events=(*run.log.events, seen[0]))
        )


@pytest.fixture(scope="module")
def shared_line(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A run in which another host sends goals to the second servo, between the exchanges and into them."""
    directory = tmp_path_factory.mktemp("shared")
    log = directory / "run.mcap"
    robot = simulated_robot(storms.servos(directory, THREE), duration_s=2.0, log=log)
    for number in range(10):
        packet = protocol2.write_range(2, 116, (2048).to_bytes(4, "little"))
        other_host(robot.buses[0], packet, 1_000_000_000 + number * 31_000_000)
    robot.run()
    return Run(read_log(log), list(robot.ledger.entries))


def test_another_host_on_the_line_leaves_an_event_that_has_its_cause_in_the_ledger(shared_line):
    noted = [event for event in shared_line.log.events if event.code == EventCode.UNREQUESTED]
    assert [(event.source, event.severity) for event in noted] == [("main", Severity.WARNING)]
    storms.faults_and_events_answer_each_other(shared_line.entries, shared_line.log)


def test_packets_of_another_host_that_is_not_there_fail(shared_line):
    entries = [entry for entry in shared_line.entries if not entry.note.startswith(OTHER_HOST)]
    with pytest.raises(AssertionError, match="unrequested"):
        storms.faults_and_events_answer_each_other(entries, shared_line.log)
