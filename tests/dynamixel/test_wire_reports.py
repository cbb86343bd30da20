"""Reports of the wire become events of a run."""

import pytest

from dxlrun.channels.event_records import EventBody
from dxlrun.dynamixel.wire_reports import WireReports
from dxlwire.exchange.reports import Reason


class Events:
    """Keeps what is emitted."""

    def __init__(self) -> None:
        self.found: list[tuple[str, str]] = []

    def emit_event(self, source: str, event: EventBody, data: bytes = b"") -> None:
        self.found.append((source, event.text))


@pytest.mark.parametrize("reason", Reason)
def test_each_reason_of_the_wire_is_an_event(reason: Reason) -> None:
    events = Events()
    WireReports(events).report(reason, "main", "a sentence")
    assert events.found == [("main", "a sentence")]
