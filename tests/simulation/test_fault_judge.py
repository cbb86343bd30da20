"""The judges of runs with faults can fail: without one byte, one cause or one event."""

import json
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from tests.kit import judges, storms
from tests.kit.cases import read_lines
from tests.kit.judges import log_has_every_byte
from tests.kit.line_faults import OTHER_HOST, other_host

from dxlrun.channels.event_records import Event, EventCode, Severity
from dxlrun.log.log_reader import read_log
from dxlrun.testing import simulated_robot
from dxlsim.bus.ledger import LedgerEntry
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


SERVOS = {"main": {3: "elbow", 5: "wrist"}, "legs": {3: "knee"}}
PLAN = {
    "buses": [
        {"name": bus, "servos": [{"joint": joint, "servo_id": each} for each, joint in servos.items()]}
        for bus, servos in SERVOS.items()
    ]
}
MS = 1_000_000
LOOP = (
    Event(100 * MS, EventCode.LOOP_STARTED, Severity.INFO, "loop", ""),
    Event(90_000 * MS, EventCode.LOOP_STOPPED, Severity.INFO, "loop", ""),
)
LINES = [line.text for line in read_lines(Path(__file__).with_name("ledger_judge.txt")) if line.text]
SPLIT = LINES.index("uncaused")


def entry_of(text: str) -> LedgerEntry:
    time, _, what = text.strip().partition(" ")
    bus, _, fault = what.partition(" ") if what.startswith("bus=") else ("bus=main", "", what)
    if fault == "late reply":
        return LedgerEntry(int(time) * MS, "main", "out", b"\xff", "", 5 * MS)
    note = fault.removeprefix("note ") if fault.startswith("note ") else f"fault: {fault}"
    return LedgerEntry(int(time) * MS, bus.removeprefix("bus="), "note", b"", note)


def event_of(text: str) -> Event:
    time, code, source, *said = text.split(maxsplit=3)
    severity = Severity.INFO if "".join(said).startswith("INFO") else Severity.WARNING
    return Event(int(time) * MS, EventCode[code.upper()], severity, source, " ".join(said) or "said")


def read(line: str) -> tuple[list[LedgerEntry], Any, list[str]]:
    """Return the ledger, the log of a run at 50 Hz, and what is expected."""
    happened, _, rest = line.partition("|")
    events, _, expected = rest.partition("=>")
    log = SimpleNamespace(
        events=(*LOOP, *(event_of(text) for text in events.split(",") if text.strip())),
        period_ns=20 * MS,
        metadata={},
        attachments={"plan.json": json.dumps(PLAN).encode()},
    )
    entries = [entry_of(text) for text in re.split(r", (?=\d)", happened) if text.strip()]
    return entries, log, expected.split()


@pytest.mark.parametrize("line", LINES[1:SPLIT])
def test_which_joints_and_buses_had_no_event_of_a_fault(line: str):
    entries, log, expected = read(line)
    fault = entries[0].note.removeprefix("fault: ")
    assert list(dict(judges.unnoticed(log, entries)).get(fault, ())) == expected


@pytest.mark.parametrize("line", LINES[SPLIT + 1 :])
def test_which_events_have_no_cause(line: str):
    entries, log, expected = read(line)
    assert [word for one in judges.uncaused(log, entries) for word in (one.name, one.source)] == expected
