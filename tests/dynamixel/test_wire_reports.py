"""Reports of the wire become events of a run."""

import pytest

from dxlrun.dynamixel.wire_reports import WireReports
from dxlwire.exchange.reports import Reason


class Events:
    """Keeps what is emitted."""

    def __init__(self) -> None:
        self.found: list[tuple[object, ...]] = []

    def emit(self, *event: object) -> None:
        self.found.append(event)


@pytest.mark.parametrize("reason", Reason)
def test_each_reason_of_the_wire_is_an_event(reason: Reason) -> None:
    events = Events()
    WireReports(events).report(reason, "main", "a sentence")
    ((_, _, source, text),) = events.found
    assert (source, text) == ("main", "a sentence")
