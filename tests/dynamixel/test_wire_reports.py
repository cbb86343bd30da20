"""Reports of the wire become events of a run."""

import pytest
from tests.kit.rigs import Events

from dxlrun.dynamixel.wire_reports import WireReports
from dxlwire.exchange.reports import Reason


@pytest.mark.parametrize("reason", Reason)
def test_each_reason_of_the_wire_is_an_event(reason: Reason) -> None:
    events = Events()
    WireReports(events).report(reason, "main", "a sentence")
    ((_, _, source, text),) = events.list
    assert (source, text) == ("main", "a sentence")
