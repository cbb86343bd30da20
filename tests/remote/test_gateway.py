"""The gateway by ASGI: what reaches the loop of what clients ask, and what they are told. No time decides."""

import asyncio
import json
import struct
from pathlib import Path

import msgspec
import numpy as np
import pytest

from dxlrun.control.loop_plan import ControllerPlan
from dxlrun.remote import asking, connection, gateway, link
from dxlrun.remote.gateway import MOST_OPERATIONS, MOST_SET_POINTS
from dxlrun.remote.preparation import Prepared, Refusal
from dxlrun.remote.sockets import MOST_BYTES
from dxlrun.run.channels.commands import MOST_PER_CYCLE
from dxlrun.run.channels.events import EventCode, Severity
from dxlrun.run.channels.heartbeat import Phase

DONE = {"done": True}
IN_LIMITS = {"done": True, "clamped": 0}
GO = "/controllers/left/commands/go"
SET_POINT = "/controllers/left/set-points/go"


def chunk(data, more=True):
    return {"type": "http.request", "body": data, "more_body": more}


def test_a_command_reaches_the_loop_prepared_and_with_the_name_of_who_asked(desk):
    name = [("x-dxlrun-client", "anna")]
    headers = [(key, value.encode()) for key, value in name]
    assert desk.ask("POST", GO, {"positions": [0.25]}, headers=headers) == (200, DONE)
    (taken,) = desk.taken
    assert (taken.controller, taken.kind, taken.origin, taken.lease_ns) == ("left", "go", "anna", 0)
    assert taken.data == struct.pack("<d", 0.25)


@pytest.mark.parametrize(
    ("given", "origin"),
    [
        (None, "process 1"),
        (b"", "process 1"),
        (b" \t ", "process 1"),
        (b"\x1b[31m\r\nevil\x00", "[31mevil"),
        ("Jürgen 机器".encode(), "Jürgen 机器"),
        (b"\xff\xfe", "��"),
        (b"a" * 5000, "a" * 64),
    ],
)
def test_what_reaches_the_log_of_a_clients_name_is_short_and_printable(desk, given, origin):
    headers = [] if given is None else [("x-dxlrun-client", given)]
    assert desk.ask("POST", "/pause", headers=headers) == (200, DONE)
    assert desk.taken[0].origin == origin


def test_what_the_loop_refuses_is_told(desk):
    assert desk.ask("POST", "/pause", refusal="it is paused already") == (
        409,
        {"refused": "it is paused already"},
    )
    assert desk.ask("GET", "/robot")[1]["paused"] is False


LOAD = {"name": "more", "type": "arm", "joints": ["pan"]}
WRONG = [
    ("GET", "/nothing", None, 404, "GET /nothing is nothing"),
    ("POST", "/robot", None, 405, "POST /robot is nothing"),
    ("GET", "/robot/", None, 404, "nothing"),
    ("POST", "/controllers/lefty/commands/go", {}, 404, "did you mean left?"),
    ("POST", "/controllers/left/commands/goo", {}, 404, "did you mean go?"),
    ("POST", "/controllers/%2e%2e/commands/go", {}, 404, "known: left, right, spare"),
    ("POST", GO, b"", 422, "go of left is no JSON"),
    ("POST", GO, b"[" * 100_000, 422, "go of left is no JSON (recursion limit"),
    ("POST", GO, b'{"positions": [NaN]}', 422, "must be a finite number"),
    ("POST", GO, b'{"positions": [1e999]}', 422, "must be a finite number"),
    ("POST", GO, {"positions": [True]}, 422, "positions"),
    ("POST", GO, {"positions": ["0.5"]}, 422, "positions"),
    ("POST", GO, {"positions": [2]}, 422, "go of left: pan is sent to 114.592 deg, outside its limits -57.3"),
    ("POST", GO, {"positions": [-1e300]}, 422, "pan is sent to -5.72958e+301 deg, outside its limits"),
    ("POST", SET_POINT, {"positions": [True]}, 422, "positions"),
    ("POST", GO, {"positions": [0], "speed": 1}, 422, "go of left has an unknown key 'speed'"),
    ("POST", GO, {"positions": [1, 2]}, 422, "go of left: 1 positions, please"),
    ("POST", GO, {"positions": ["x"] * 50_000}, 422, "; and 49995 more"),
    ("POST", "/controllers/left/commands/break", {"count": 1}, 422, "KeyError: 'a mistake of its author'"),
    ("POST", "/controllers/left/commands/leave", {"count": 1}, 422, "SystemExit: 3"),
    ("POST", "/controllers/left/commands/many", {"count": 40_000}, 413, "320000 bytes are too many"),
    ("POST", "/controllers/left/set-points/many", {"count": 300}, 413, "send it as a command"),
    ("POST", "/controllers/spare/set-points/go", {"positions": [0]}, 409, "not active; switch to it first"),
    ("POST", SET_POINT + "?lease=0", {"positions": [0]}, 422, "a lease is 0.01 to 60 s, not 0"),
    ("POST", SET_POINT + "?lease=61", {"positions": [0]}, 422, "a lease is 0.01 to 60 s, not 61"),
    ("POST", SET_POINT + "?lease=inf", {"positions": [0]}, 422, "lease=inf is no number"),
    ("POST", SET_POINT + "?lease=long", {"positions": [0]}, 422, "lease=long is no number"),
    ("GET", "/events?after=x", None, 422, "after=x is no number"),
    ("POST", "/switch", b"{", 422, 'write for example {"activate": ["head"]'),
    ("POST", "/switch", b"[" * 100_000, 422, "write for example"),
    ("POST", "/switch", {"activate": ["nobody"]}, 404, "there is no controller nobody"),
    ("POST", "/switch", {"activate": ["left"] * 2}, 422, "named twice"),
    ("POST", "/switch", {"activate": "left"}, 422, "Expected `array`"),
    ("POST", "/switch", {"start": ["left"]}, 422, "unknown field `start`"),
    ("POST", "/rate", {"rate": "fast"}, 422, "Expected `float`"),
    ("POST", "/rate", {"rate": True}, 422, "Expected `float`"),
    ("POST", "/rate", b'{"rate": 1' + b"0" * 400 + b"}", 422, "write for example"),
    ("POST", "/rate", {}, 422, "missing required field `rate`"),
    ("DELETE", "/controllers/lefty", None, 404, "did you mean left?"),
    ("POST", "/controllers", LOAD | {"name": "../x"}, 422, "is no name"),
    ("POST", "/controllers", LOAD | {"name": 5}, 422, "must be text"),
    ("POST", "/controllers", LOAD | {"name": "a" * 65}, 422, "at most 64"),
    ("POST", "/controllers", LOAD | {"name": "left"}, 409, "there is a controller left already"),
    ("POST", "/controllers", LOAD | {"type": "leg"}, 422, "no plug-in offers the controller type leg"),
    ("POST", "/controllers", LOAD | {"joints": ["pam"]}, 422, "did you mean pan?"),
    ("POST", "/controllers", LOAD | {"joints": ["pan", "pan"]}, 422, "names a joint twice"),
    ("POST", "/controllers", LOAD | {"joints": 3}, 422, "more.joints is 3"),
    ("POST", "/controllers", LOAD | {"rate": "x"}, 422, "must be a number"),
    ("POST", "/controllers", LOAD | {"active": True}, 422, "load it, then switch to it"),
    ("POST", "/controllers", LOAD | {"fallback": "nobody"}, 422, "there is no fallback nobody"),
    ("POST", "/controllers", b"[]", 422, "Expected `object`"),
]  # fmt: skip


@pytest.mark.parametrize("wrong", WRONG, ids=[" ".join(wrong[:2]) for wrong in WRONG])
def test_a_wrong_wish_is_refused_with_one_sentence_and_never_reaches_the_loop(desk, wrong):
    method, path, body, status, sentence = wrong
    told, content = desk.ask(method, path, b"" if body is None else body)
    assert told == status
    assert sentence in content["refused"]
    assert "\n" not in content["refused"]
    assert len(content["refused"]) < 2001
    assert desk.taken == []


def test_a_body_that_is_announced_too_long_is_refused_before_it_is_read(desk):
    for announced in (b"10000000", b"1048577", b"9" * 5000):
        heard = []
        headers = [("content-length", announced)]
        status, _ = desk.ask("POST", GO, chunks=[], headers=headers, heard=heard)
        assert (status, heard) == (413, [])
        assert desk.headers[b"connection"] == b"close"
    assert desk.taken == []


def test_of_a_body_without_end_a_mebibyte_is_read_and_no_more(desk):
    heard = []
    endless = (chunk(bytes(65_536)) for _ in range(1000))
    status, _ = desk.ask("POST", GO, chunks=endless, heard=heard)
    assert status == 413
    assert len(heard) == MOST_BYTES // 65_536 + 1
    assert desk.taken == []


def test_a_body_that_never_ends_and_never_goes_on_is_given_up(desk, monkeypatch):
    monkeypatch.setattr(asking, "BODY_S", 0.01)
    status, content = desk.ask("POST", GO, chunks=[chunk(b'{"posi')])
    assert (status, content["refused"]) == (408, "the request did not arrive within 0.01 s")
    assert desk.taken == []


def test_a_client_that_dies_in_the_middle_of_a_command_has_asked_nothing(desk):
    chunks = [chunk(b'{"positions": [0.5]}'), {"type": "http.disconnect"}]
    assert desk.ask("POST", GO, chunks=chunks)[0] == 400
    assert desk.taken == []


def test_a_set_point_beyond_the_limits_is_passed_to_the_gate_and_the_answer_counts_it(desk):
    for position, clamped in ((1.5, 1), (1.0, 0), (-1e9, 1)):
        status, content = desk.ask("POST", SET_POINT, {"positions": [position]})
        assert (status, content) == (202, {"done": True, "clamped": clamped})
    desk.take()
    assert struct.unpack("<d", desk.taken[-1].data) == (-1e9,)


def test_of_many_values_beyond_the_limits_some_are_named_and_all_counted():
    prepared = Prepared(b"", tuple(f"j{row} is beyond" for row in range(7)))
    with pytest.raises(Refusal, match=r"^go: j0 is beyond; .*; j4 is beyond; and 2 more$"):
        prepared.require_within_limits("go")


def test_a_flood_of_set_points_gives_the_loop_one_a_cycle_and_takes_nothing_from_others(desk):
    body = json.dumps({"positions": [0.5]}).encode()

    async def flood(count, client):
        return [(await desk.request("POST", SET_POINT, body, client=client))[0] for _ in range(count)]

    told = asyncio.run(flood(1000, ("process 1", 0)))
    assert told == [202] * int(MOST_SET_POINTS / 10) + [429] * (1000 - int(MOST_SET_POINTS / 10))
    assert asyncio.run(flood(1, ("process 2", 0))) == [202]
    assert len(desk.take()) == 1
    assert desk.take() == []
    desk.now += 0.01
    assert asyncio.run(flood(100, ("process 1", 0))).count(202) == MOST_SET_POINTS * 0.01


def test_a_flood_from_ever_new_processes_is_remembered_for_some_of_them_only(desk):
    async def flood():
        for process in range(1000):
            await desk.request("POST", SET_POINT, {"positions": [0]}, client=(f"process {process}", 0))

    asyncio.run(flood())
    assert len(desk.gateway._set_points._left) == asking.MOST_PEERS
    assert len(desk.take()) == 1


def test_what_waits_for_a_silent_loop_is_bounded_and_stop_is_taken_all_the_same(desk, monkeypatch):
    monkeypatch.setattr(link, "ANSWER_S", 0.05)

    async def crowd():
        clients = [(f"process {number}", 0) for number in range(100)]
        wishes = [desk.request("POST", GO, {"positions": [0]}, client=client) for client in clients]
        stop = desk.request("POST", "/stop")
        return [status for status, _ in await asyncio.gather(*wishes, stop)]

    told = asyncio.run(crowd())
    assert told == [503] * link.MOST_WAITING + [429] * (100 - link.MOST_WAITING) + [503]
    cycles = []
    while taken := desk.take():
        cycles.append([command.kind for command in taken])
    assert max(len(kinds) for kinds in cycles) == MOST_PER_CYCLE
    assert [kind for kinds in cycles for kind in kinds] == ["go"] * link.MOST_WAITING + ["stop"]


def test_many_long_commands_leave_room_for_stop_too(desk, monkeypatch):
    monkeypatch.setattr(link, "ANSWER_S", 0.05)

    async def crowd():
        path = "/controllers/left/commands/many"
        wishes = [desk.request("POST", path, {"count": 30_000}) for _ in range(6)]
        return [status for status, _ in await asyncio.gather(*wishes, desk.request("POST", "/stop"))]

    assert asyncio.run(crowd()) == [503, 503, 429, 429, 429, 429, 503]
    assert [[command.kind for command in desk.take()] for _ in range(3)] == [["many"], ["many"], ["stop"]]


def test_what_was_answered_leaves_its_room_to_the_next_ones(desk):
    """Each long command takes nearly half of what may wait."""
    for number in range(8):
        desk.now += 10.0  # so that the allowance of its process is not what refuses it
        assert desk.ask("POST", "/controllers/left/commands/many", {"count": 30_000})[0] == 200, number


def test_one_process_may_ask_for_so_many_operations_a_second_but_stop_is_not_counted(desk):
    told = [desk.ask("POST", "/pause")[0] for _ in range(30)]
    assert told == [200] * int(MOST_OPERATIONS / 10) + [429] * (30 - int(MOST_OPERATIONS / 10))
    assert desk.ask("POST", "/stop") == (200, DONE)


def test_long_bodies_count_as_many_short_ones_of_the_process_that_sends_them(desk):
    long = {"positions": [0] * 100_000}
    told = [desk.ask("POST", GO, long)[0] for _ in range(5)]
    assert told == [422, 422, 429, 429, 429]
    desk.now += 0.05
    assert desk.ask("POST", "/pause")[0] == 429
    assert desk.ask("POST", "/pause", client=("process 2", 0))[0] == 200
    assert desk.ask("POST", "/stop")[0] == 200
    desk.now += 0.2
    assert desk.ask("POST", "/pause")[0] == 200


def test_an_answer_that_comes_too_late_is_still_what_the_gateway_knows(desk, monkeypatch):
    monkeypatch.setattr(link, "ANSWER_S", 0.01)
    status, content = asyncio.run(desk.request("POST", "/pause"))
    assert status == 503
    assert "did not answer" in content["refused"]
    assert asyncio.run(desk.request("GET", "/robot"))[1]["paused"] is False
    desk.take()
    desk.link.collect()
    assert desk.ask("GET", "/robot")[1]["paused"] is True


@pytest.mark.parametrize("phase", [Phase.SETUP, Phase.STOPPING, Phase.DONE])
def test_a_run_at_its_end_takes_nothing_and_says_so_at_once(desk, phase):
    desk.heartbeat.enter(phase)
    for path, body in (("/pause", b""), (SET_POINT, {"positions": [0]})):
        assert desk.ask("POST", path, body) == (503, {"refused": "the run is at its end"})
    assert desk.taken == []


def test_rate_pause_and_resume_are_known_when_they_were_done(desk):
    assert desk.ask("POST", "/rate", {"rate": 100}) == (200, DONE)
    assert desk.ask("POST", "/pause") == (200, DONE)
    told = desk.ask("GET", "/robot")[1]
    assert (told["rate"], told["paused"]) == (100.0, True)
    assert desk.ask("POST", "/resume") == (200, DONE)
    assert desk.ask("GET", "/robot")[1]["paused"] is False
    sent = [(one.controller, one.kind, one.data) for one in desk.taken]
    assert sent == [("", "rate", b'{"rate":100.0}'), ("", "pause", b""), ("", "resume", b"")]


def test_a_controller_takes_set_points_as_soon_as_its_switch_was_answered(desk):
    wish = {"activate": ["spare"], "deactivate": ["left"]}
    assert desk.ask("POST", "/switch", wish) == (200, DONE)
    path = "/controllers/spare/set-points/go?lease=0.5"
    assert desk.ask("POST", path, {"positions": [0.5]}) == (202, IN_LIMITS)  # the cycle has not ended yet
    assert desk.ask("POST", SET_POINT, {"positions": [0.5]})[0] == 409
    streamed = [(one.controller, one.lease_ns) for one in desk.taken if one.lease_ns]
    assert streamed == [("spare", 500_000_000)]
    desk.record.active = 0b110
    desk.finish_cycle()
    assert [one["active"] for one in desk.ask("GET", "/robot")[1]["controllers"]] == [False, True, True]
    desk.record.active = 0b010  # and later only the records count
    desk.finish_cycle()
    assert [one["active"] for one in desk.ask("GET", "/robot")[1]["controllers"]] == [False, True, False]


@pytest.mark.parametrize("excuse", ["", "spare is not activated: pan stays in position mode"])
def test_a_switch_that_waits_for_modes_is_answered_when_they_are_there_or_were_given_up(desk, excuse):
    async def switch():
        asked = asyncio.ensure_future(desk.request("POST", "/switch", {"activate": ["spare"]}))
        desk.events.emit(EventCode.MODE, Severity.INFO, "spare", "waits until its joints are in their modes")
        while not desk.taken:
            desk.take()
            await asyncio.sleep(0)
        for _ in range(20):
            desk.link.collect()
            await asyncio.sleep(0)
        waited = not asked.done()
        code = EventCode.COMMAND_REFUSED if excuse else EventCode.CONTROLLER_ACTIVATED
        desk.events.emit(code, Severity.INFO, "spare", excuse or "active")
        desk.link.collect()
        return waited, await asked

    answer = (409, {"refused": excuse}) if excuse else (200, DONE)
    assert asyncio.run(switch()) == (True, answer)


def test_a_controller_that_is_unloaded_while_a_set_point_arrives_gets_none_of_it(desk):
    """Its place may be another one's by then."""

    def chunks():
        yield {"type": "http.request", "body": b'{"positions": ', "more_body": True}
        desk.link.controllers.pop("left")
        yield {"type": "http.request", "body": b"[0]}"}

    status, told = asyncio.run(desk.request("POST", SET_POINT, chunks=chunks()))
    assert (status, told) == (404, {"refused": "left was unloaded meanwhile"})
    assert list(desk.mailbox.take()) == []


def test_a_switch_whose_modes_never_come_is_given_up(desk, monkeypatch):
    monkeypatch.setattr(link, "ENTER_S", 0.01)
    desk.link.controllers["spare"].entering = True
    wish = {"activate": ["spare"], "deactivate": ["left"]}
    desk.link.switched = lambda activate, deactivate: None  # the loop says no more of it
    assert desk.ask("POST", "/switch", wish) == (409, {"refused": "spare is not active after 0.01 s"})


def test_a_controller_is_loaded_into_the_place_that_the_loop_gives_it(desk):
    for name in ("more", "most"):
        assert desk.ask("POST", "/controllers", LOAD | {"name": name, "rate": 25}) == (200, DONE)
    plan = msgspec.json.decode(desk.taken[0].data, type=ControllerPlan)
    assert (plan.name, plan.rate, plan.joints, plan.active) == ("more", 25.0, ("pan",), False)
    assert desk.ask("DELETE", "/controllers/more") == (200, DONE)
    assert desk.ask("DELETE", "/controllers/right") == (200, DONE)
    assert desk.ask("POST", "/controllers", LOAD | {"name": "again"}) == (200, DONE)
    desk.record.active = 0b001000
    desk.finish_cycle()
    told = {one["name"]: one["active"] for one in desk.ask("GET", "/robot")[1]["controllers"]}
    assert told == {"left": False, "spare": False, "most": False, "again": True}


def test_the_robot_is_told_with_what_its_controllers_take(desk):
    status, told = desk.ask("GET", "/robot")
    assert status == 200
    left = told["controllers"].pop(0)
    assert left.pop("takes")["go"]["properties"]["positions"]["type"] == "array"
    assert left == {
        "name": "left",
        "type": "arm",
        "active": True,
        "held": False,
        "rate": 50.0,
        "joints": ["pan"],
        "command": ["position"],
    }
    del told["controllers"]
    assert told == {
        "robot": "pair",
        "rate": 50.0,
        "paused": False,
        "cycles": 1,
        "skipped": 0,
        "joints": ["pan", "tilt"],
        "log": "/logs/pair.mcap",
    }


def test_states_are_those_of_the_newest_cycle_and_what_is_not_there_is_null(desk):
    desk.record.states.position[:] = (0.5, np.nan)
    desk.record.states.valid[:] = (True, False)
    desk.record.states.age_ns[:] = (0, 40_000_000)
    desk.record.states.mode[:] = (3, 0)
    desk.record.states.temperature[0] = 41.0
    desk.record.states.hardware_error[1] = 0x20
    desk.finish_cycle()
    status, told = desk.ask("GET", "/states")
    assert (status, told["cycle"], told["time"]) == (200, 1, 1.02)
    pan, tilt = told["joints"]["pan"], told["joints"]["tilt"]
    assert (pan["position"], pan["valid"], pan["age"]) == (0.5, True, 0.0)
    assert (tilt["position"], tilt["valid"], tilt["age"]) == (None, False, 0.04)
    assert (pan["mode"], pan["temperature"], pan["hardware_error"]) == ("effort", 41.0, 0)
    assert (tilt["mode"], tilt["temperature"], tilt["hardware_error"]) == ("unknown", None, 0x20)


def test_events_of_both_processes_are_whole_and_are_told_once_to_who_asks_after_the_last(desk):
    long = "ä" * 400
    desk.events.emit(EventCode.SETUP, Severity.INFO, "loop", long)
    desk.guardian_events.emit(EventCode.GUARDIAN, Severity.INFO, "guardian", long)
    desk.link.collect()
    told = desk.ask("GET", "/events")[1]
    assert [(one["source"], one["text"]) for one in told["events"]] == [("loop", long), ("guardian", long)]
    desk.events.emit(EventCode.SETUP, Severity.INFO, "loop", "more")
    desk.link.collect()
    told = desk.ask("GET", f"/events?after={told['last']}")[1]
    assert [one["text"] for one in told["events"]] == ["more"]
    assert desk.ask("GET", f"/events?after={told['last']}")[1] == {"events": [], "last": told["last"]}


def test_the_page_gives_the_limits_that_are_kept():
    page = (Path(__file__).parents[2] / "docs" / "steering.md").read_text()
    rates = f"{gateway.MOST_LOOKS:.0f} GETs, {gateway.MOST_SET_POINTS:.0f} set-points or"
    assert f"{rates} {gateway.MOST_OPERATIONS:.0f} other requests a second" in page
    assert f"{asking.CHARGED_BYTES >> 10} KiB of a body count as one more" in page
    assert f"within {link.ANSWER_S:g} s and two of its periods, {2 * link.ANSWER_S:g} s at most" in page
    assert f"of the last {link.KEPT_EVENTS} events (fewer when their texts have more than" in page
    assert f"more than {link.KEPT_TEXT >> 20} MiB together" in page
    assert f"A process may keep {connection.MOST_OF_PROCESS} connections, all together" in page
    assert f"all together {connection.MOST_CONNECTIONS}." in page
