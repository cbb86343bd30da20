"""The gateway under load and when parts of it fail. No time decides."""

import signal
import time

import pytest
from tests.remote.conftest import Arm, Desk

from dxlrun.channels.event_records import EventBody, EventCode, Severity
from dxlrun.control.controllers.plugin_loading import Offer, PlugIns
from dxlrun.remote import link, preparation

DONE = {"done": True, "cycle": 0}
GO = "/controllers/left/commands/go"
SET_POINT = "/controllers/left/set-points/go"


@pytest.mark.parametrize(("text", "count"), [("x", 3000), ("x" * 7000, 300)])
def test_a_storm_of_events_is_kept_in_bounded_memory(desk, text, count):
    for number in range(count):
        desk.events.emit_event("pan", EventBody(EventCode.GATE, Severity.WARNING, f"{number} {text}"))
        desk.link.collect_messages()
    kept = [event.text for _, event in desk.link.events]
    assert len(kept) <= link.KEPT_EVENTS
    assert sum(map(len, kept)) <= link.KEPT_TEXT
    assert len(kept) == link.KEPT_EVENTS or sum(map(len, kept)) > link.KEPT_TEXT - 8000
    assert kept[-1].startswith(f"{count - 1} ")
    assert all(one.endswith(text) for one in kept)


def test_a_controller_whose_stream_ended_is_held_until_its_next_command(desk):
    def held():
        desk.link.collect_messages()
        return desk.ask("GET", "/robot")[1]["controllers"][0]["held"]

    for code, expected in (
        (EventCode.STALE_COMMAND, True),
        (EventCode.CONTROLLER_SAYS, True),
        (EventCode.COMMAND, False),
        (EventCode.STALE_COMMAND, True),
        (EventCode.CONTROLLER_DEACTIVATED, False),
    ):
        desk.events.emit_event("left", EventBody(code, Severity.INFO, ""))
        assert held() is expected


def test_a_plug_in_that_never_returns_is_interrupted_and_the_next_client_is_served(desk, monkeypatch):
    monkeypatch.setattr(preparation, "BUDGET_S", 0.05)
    status, content = desk.ask("POST", "/controllers/left/commands/brood", {"count": 1})
    assert (status, content["refused"]) == (
        422,
        "left needed more than 0.05 s to prepare the command; send less at once",
    )
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)
    assert desk.ask("POST", "/stop") == (200, DONE)
    assert [command.kind for command in desk.taken] == ["stop"]


class SlowOffers(dict):
    """Offers of a package that takes long to import."""

    def get(self, name, default=None):
        """Return an offer after the import."""
        time.sleep(0.1)
        return super().get(name, default)


def test_import_of_a_controller_that_is_loaded_is_not_interrupted(monkeypatch):
    monkeypatch.setattr(preparation, "BUDGET_S", 0.05)
    desk = Desk(plugins=PlugIns(SlowOffers(arm=Offer("arm", Arm, "tests 1")), {}))
    status, content = desk.ask("POST", "/controllers", {"name": "more", "type": "arm", "joints": ["pan"]})
    assert status == 200, content


def test_a_failure_of_the_gateway_itself_fails_one_request_only(desk, monkeypatch, capsys):
    monkeypatch.setattr(desk.link, "newest", lambda: 1 / 0)
    status, content = desk.ask("GET", "/states")
    assert status == 500
    assert "ZeroDivisionError" in content["refused"]
    assert "Traceback" in capsys.readouterr().err
    assert desk.ask("POST", "/pause") == (200, DONE)
