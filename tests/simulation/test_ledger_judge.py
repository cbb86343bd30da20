"""The judges of a run beside its ledger can fail: which fault has no event, and which event no cause."""

from __future__ import annotations

import json
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from tests.kit import judges
from tests.kit.cases import read_lines

from dxlrun.channels.event_records import Event, EventCode, Severity
from dxlsim.bus.ledger import LedgerEntry

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
