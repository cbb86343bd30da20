"""The judge of runs with faults: whole runs satisfy it, and fail without one byte or one cause."""

from __future__ import annotations

import pytest
from tests.kit import storms
from tests.kit.judges import log_has_every_byte
from tests.kit.line_faults import OTHER_HOST, other_host

from dxlrun.channels.event_records import EventCode, Severity
from dxlrun.log.log_reader import read_log
from dxlrun.testing import simulated_robot
from dxlwire.wire import protocol2


@pytest.fixture
def robot(tmp_path):
    """Three servos, with a log `run.mcap`."""
    path = storms.servos(tmp_path, {"main": (2.0, 3)})
    return simulated_robot(path, duration_s=2.0, log=tmp_path / "run.mcap")


def test_a_byte_that_the_log_does_not_have_fails(robot, tmp_path):
    trial = storms.Trial.of(robot, ["silence servo=2 at=500ms for=200ms"])
    robot.run()
    log, entries = read_log(tmp_path / "run.mcap"), robot.ledger.entries
    trial.judge(log)
    for direction in ("in", "out"):
        at = next(i for i, entry in enumerate(entries) if i > 40 and entry.direction == direction)
        wrong = entries[at]._replace(data=entries[at].data[:-1] + b"\x55")
        for instead in ([wrong], []):
            with pytest.raises(AssertionError):
                log_has_every_byte(log, [*entries[:at], *instead, *entries[at + 1 :]])


def test_another_host_on_the_line_leaves_an_event_that_has_its_cause_in_the_ledger(robot, tmp_path):
    """It sends goals to the second servo, between the exchanges and into them."""
    packet = protocol2.write_range(2, 116, (2048).to_bytes(4, "little"))
    for number in range(10):
        other_host(robot.buses[0], packet, 1_000_000_000 + number * 31_000_000)
    robot.run()
    log = read_log(tmp_path / "run.mcap")
    noted = [event for event in log.events if event.code == EventCode.UNREQUESTED]
    assert [(event.source, event.severity) for event in noted] == [("main", Severity.WARNING)]
    storms.faults_and_events_answer_each_other(robot.ledger.entries, log)
    entries = [entry for entry in robot.ledger.entries if not entry.note.startswith(OTHER_HOST)]
    with pytest.raises(AssertionError, match="unrequested"):
        storms.faults_and_events_answer_each_other(entries, log)
