"""The gateway by ASGI: which requests reach the loop, how they are answered, and what a failure costs."""

import asyncio
import json
import signal
from string import Formatter

import msgspec
import numpy as np
import pytest
from msgspec.structs import replace
from tests.kit.commands import matches
from tests.kit.pages import page_text
from tests.remote.conftest import Arm, Desk

from dxlrun.channels.answers import Acceptance, Code, CommandOutcome, Completion, Refusal
from dxlrun.channels.commands import MOST_PER_CYCLE
from dxlrun.channels.cycle import CycleLayout, CycleRecord
from dxlrun.channels.event_records import EventBody, EventCode, Severity
from dxlrun.compile.joints.limits import LimitViolation
from dxlrun.compile.joints.poses import Poses
from dxlrun.control.controllers.plugin_loading import Offer, PlugIns, load_plugins
from dxlrun.remote import asked, link, preparation, server
from dxlrun.remote.preparation import PreparedCommand, RefusedRequest, in_si
from dxlrun.remote.requests import request_table as requests
from dxlrun.remote.requests.request_table import MOST_OPERATIONS, MOST_SET_POINTS, Role
from dxlrun.remote.sockets import MOST_BYTES

DONE = {"done": True, "cycle": 0}
IN_LIMITS = {"done": True, "clamped": 0, "clamped_joints": []}
ARM = "/controllers/left/commands"
GO = f"{ARM}/go"
SET_POINT = "/controllers/left/set-points/go"
NUMBERS = {"seconds", "velocity", "rate", "controller_rate", "lowest", "highest"}


def chunk(data, more=True):
    return {"type": "http.request", "body": data, "more_body": more}


@pytest.mark.parametrize(
    ("given", "origin"),
    [
        (None, "process 1"),
        (b"anna", "anna"),
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


# Quantities with units


def plain(**command):
    return json.loads(in_si(json.dumps(command).encode(), "go of arm"))


def test_quantities_become_si():
    point = {"time": "500 ms", "positions": ["180 deg", "-1 rad"], "velocities": ["60 deg/s", "30 rpm"]}
    assert plain(points=[point], start_in="1 min") == {
        "points": [
            {
                "time": 0.5,
                "positions": [pytest.approx(3.14159265), -1.0],
                "velocities": [pytest.approx(1.04719755), pytest.approx(3.14159265)],
            }
        ],
        "start_in": 60.0,
    }


def test_what_is_no_quantity_stays_as_it_was_written():
    command = {"label": "30 deg", "count": 3, "loud": True, "empty": None, "positions": [None]}
    assert plain(**command) == command


def test_parameters_of_a_controller_are_parsed_once_and_anew_when_another_is_loaded(desk, monkeypatch):
    parsed = []
    model = desk.gateway._preparation.plugins.controllers["arm"].controller.Parameters
    parse = model.model_validate_json
    monkeypatch.setattr(model, "model_validate_json", lambda text: parsed.append(text) or parse(text))
    for _ in range(3):
        assert desk.ask("POST", GO, {"positions": [0.25]})[0] == 200
    assert len(parsed) == 1
    left = desk.link.controllers["left"]
    left.plan = replace(left.plan, parameters='{"joints": ["pan", "tilt"]}', joints=("pan", "tilt"))
    assert desk.ask("POST", GO, {"positions": [0.25, 0.5]})[0] == 200
    assert len(parsed) == 2


# Bodies


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


def test_a_body_that_stops_in_the_middle_is_given_up(desk, monkeypatch):
    monkeypatch.setattr(asked, "BODY_S", 0.01)
    status, content = desk.ask("POST", GO, chunks=[chunk(b'{"posi')])
    assert (status, content["refused"]) == (408, "the request did not arrive within 0.01 s")
    assert desk.taken == []


def test_a_client_that_dies_in_the_middle_of_a_command_has_asked_nothing(desk):
    chunks = [chunk(b'{"positions": [0.5]}'), {"type": "http.disconnect"}]
    assert desk.ask("POST", GO, chunks=chunks)[0] == 400
    assert desk.taken == []


def test_of_many_values_beyond_the_limits_some_are_named_and_all_counted():
    beyond = tuple(LimitViolation(f"j{row % 6}", f"j{row} is beyond") for row in range(7))
    with pytest.raises(
        RefusedRequest, match=r"^go of arm: j0 is beyond; .*; j4 is beyond; and 2 more$"
    ) as raised:
        PreparedCommand("arm", "go", b"", beyond).require_within_limits()
    refusal = raised.value.refusal
    assert (refusal.code, refusal.fields["joints"]) == (
        Code.BEYOND_LIMITS, ("j0", "j1", "j2", "j3", "j4", "j5"),
    )  # fmt: skip


def test_a_flood_of_set_points_gives_the_loop_one_a_cycle_and_takes_nothing_from_others(desk):
    body = json.dumps({"positions": [0.5]}).encode()

    async def flood(count, client):
        return [(await desk.request("POST", SET_POINT, body, client=client))[0] for _ in range(count)]

    told = asyncio.run(flood(1000, ("process 1", Role.ADMIN)))
    assert told == [202] * int(MOST_SET_POINTS / 10) + [429] * (1000 - int(MOST_SET_POINTS / 10))
    assert asyncio.run(flood(1, ("process 2", Role.ADMIN))) == [202]
    assert len(desk.take()) == 1
    assert desk.take() == []
    desk.now += 0.01
    assert asyncio.run(flood(100, ("process 1", Role.ADMIN))).count(202) == MOST_SET_POINTS * 0.01
    desk.now += 60.0  # what was not used is not kept
    assert asyncio.run(flood(1000, ("process 1", Role.ADMIN))).count(202) == MOST_SET_POINTS / 10


def test_a_flood_from_ever_new_processes_is_remembered_for_some_of_them_only(desk):
    async def flood():
        for process in range(1000):
            await desk.request(
                "POST", SET_POINT, {"positions": [0]}, client=(f"process {process}", Role.ADMIN)
            )

    asyncio.run(flood())
    assert len(desk.gateway._allowances[requests.MOST_SET_POINTS]._left) == asked.MOST_PEERS
    assert len(desk.take()) == 1


def test_what_waits_for_a_silent_loop_is_bounded_and_stop_is_taken_all_the_same(desk, monkeypatch):
    monkeypatch.setattr(link, "ANSWER_S", 0.05)

    async def crowd():
        clients = [(f"process {number}", Role.ADMIN) for number in range(100)]
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


def test_a_command_ends_the_idle_interval_of_the_collector(desk, monkeypatch):
    monkeypatch.setattr(link, "_IDLE_LOOK_S", 3600.0)

    async def story():
        collecting = asyncio.create_task(desk.link.collect_until_cancelled())
        await asyncio.sleep(0)  # it is idle now
        asked = asyncio.create_task(desk.request("POST", GO, {"positions": [0]}))
        while not asked.done():
            desk.take()
            await asyncio.sleep(0.001)
        collecting.cancel()
        return await asked

    assert asyncio.run(story()) == (200, DONE)


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
    assert desk.ask("POST", "/pause", client=("process 2", Role.ADMIN))[0] == 200
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
    desk.link.collect_messages()
    assert desk.ask("GET", "/robot")[1]["paused"] is True


def test_a_switch_is_answered_when_the_record_of_its_cycle_shows_it(desk):
    """So that a set-point that follows finds the controller active."""

    async def switch():
        asked = asyncio.ensure_future(
            desk.request("POST", "/switch", {"activate": ["spare"], "deactivate": ["left"]})
        )
        while not (commands := list(desk.mailbox.drain_commands())):
            await asyncio.sleep(0)
        desk.mailbox.answer_command(commands[0].number, Completion(desk.ended))
        for _ in range(20):
            desk.link.collect_messages()
            await asyncio.sleep(0)
        early = asked.done()
        desk.record.active = 0b110
        desk.finish_cycle()
        return early, await asked

    assert asyncio.run(switch()) == (False, (200, {"done": True, "cycle": 1}))
    path = "/controllers/spare/set-points/go?lease=0.5"
    assert desk.ask("POST", path, {"positions": [0.5]}) == (202, IN_LIMITS)
    assert desk.ask("POST", SET_POINT, {"positions": [0.5]})[0] == 409
    streamed = [(one.controller, one.lease_ns) for one in desk.taken if one.lease_ns]
    assert streamed == [("spare", 500_000_000)]
    assert [one["active"] for one in desk.ask("GET", "/robot")[1]["controllers"]] == [False, True, True]


LATE = Refusal(Code.MODE_NOT_ENTERED, {"controller": ("spare",), "problem": "pan stays in position mode"})


@pytest.mark.parametrize("last", [Completion(0), LATE], ids=["done", "refused"])
def test_a_switch_that_waits_for_modes_is_answered_when_they_are_there_or_were_given_up(
    desk, monkeypatch, last
):
    monkeypatch.setattr(link, "ANSWER_S", 0.05)

    async def switch():
        asked = asyncio.ensure_future(desk.request("POST", "/switch", {"activate": ["spare"]}))
        while not (commands := list(desk.mailbox.drain_commands())):
            await asyncio.sleep(0)
        desk.mailbox.answer_command(commands[0].number, Acceptance(("spare",)))
        desk.link.collect_messages()
        await asyncio.sleep(0.2)
        waited = not asked.done()
        desk.mailbox.answer_command(commands[0].number, last)
        desk.link.collect_messages()
        return waited, await asked

    waited, (status, content) = asyncio.run(switch())
    assert waited
    if last is LATE:
        assert (status, content["code"]) == (409, "mode_not_entered")
        assert content["refused"] == "spare is not activated: pan stays in position mode"
        assert content["fields"] == {"controller": ["spare"], "problem": "pan stays in position mode"}
    else:
        assert (status, content) == (200, DONE)


def test_waiting_answers_keep_the_client_waiting(desk, monkeypatch):
    """A joint after the other is done; the last answer counts."""
    answers = [Acceptance(()), Acceptance(()), Completion(9)]

    async def story():
        asked = asyncio.ensure_future(desk.request("POST", "/torque", {"joints": ["all"], "on": False}))
        commands = []
        while not commands:
            commands = list(desk.mailbox.drain_commands())
            await asyncio.sleep(0)
        for answer in answers:
            assert not asked.done()
            desk.mailbox.answer_command(commands[0].number, answer)
            desk.link.collect_messages()
            await asyncio.sleep(0.001)
        while desk.record.cycle < 9:
            desk.finish_cycle()
        for _ in range(20):
            await asyncio.sleep(0)
        assert not asked.done(), "its next states would be those before"
        desk.finish_cycle()
        return await asked

    monkeypatch.setattr(link, "_LOOK_S", 0.0)
    assert asyncio.run(story()) == (200, {"done": True, "cycle": 9, "joints": ["pan", "tilt"]})


def test_a_controller_that_is_unloaded_while_a_set_point_arrives_gets_none_of_it(desk):
    """Its place may be another one's by then."""

    def chunks():
        yield {"type": "http.request", "body": b'{"positions": ', "more_body": True}
        desk.link.controllers.pop("left")
        yield {"type": "http.request", "body": b"[0]}"}

    status, told = asyncio.run(desk.request("POST", SET_POINT, chunks=chunks()))
    assert (status, told["code"]) == (404, "unknown_controller")
    assert list(desk.mailbox.drain_commands()) == []


def test_a_switch_whose_modes_never_come_is_given_up(desk, monkeypatch):
    monkeypatch.setattr(link, "ENTER_S", 0.01)
    status, content = desk.ask("POST", "/switch", {"activate": ["spare"]}, refusal=Acceptance(("spare",)))
    assert (status, content["code"], content["fields"]) == (503, "no_answer", {"seconds": 0.01})


def test_states_show_the_references_by_their_names(desk):
    names = ("spare/pan/position", "spare/pan/effort")
    layout = CycleLayout(("pan", "tilt"), ("left", "right", "spare"), names)
    desk.record, desk.link._record = CycleRecord(layout), CycleRecord(layout)
    desk.record.reference[:] = (0.25, np.nan)
    desk.finish_cycle()
    found = desk.ask("GET", "/states")[1]
    assert (found["references"], found["reference"]) == ([*names], [0.25, None])


def test_event_of_a_command_has_its_client(desk):
    outcome = msgspec.json.encode(CommandOutcome("rate", "anna"))
    desk.events.emit_event(
        "loop", EventBody(EventCode.STEERED, Severity.INFO, "rate 40 Hz from anna"), outcome
    )
    desk.events.emit_event("loop", EventBody(EventCode.STEERED, Severity.INFO, "of a version without data"))
    desk.events.emit_event("loop", EventBody(EventCode.SETUP, Severity.INFO, "no command"), outcome)
    desk.link.collect_messages()
    assert [one["origin"] for one in desk.ask("GET", "/events")[1]["events"]] == ["anna", "", ""]


@pytest.mark.parametrize("code", Code)
def test_every_refusal_has_a_sentence_of_its_fields(code):
    names = [name for _, name, _, _ in Formatter().parse(code.text) if name]
    values = {name: 0.5 if name in NUMBERS else ("arm", "head") for name in names}
    text = Refusal(code, values | {"hint": "try it"}).text
    assert text.endswith("; try it")
    assert all(("0.5" if name in NUMBERS else "arm, head") in text for name in names if name != "highest")


def test_the_page_gives_the_limits_that_are_kept():
    page = page_text("steering.md")
    rates = f"{requests.MOST_LOOKS:.0f} GETs, {requests.MOST_SET_POINTS:.0f} set-points or"
    assert f"{rates} {requests.MOST_OPERATIONS:.0f} other requests a second" in page
    assert f"{asked.CHARGED_BYTES >> 10} KiB of a body count as one more" in page
    assert f"within {link.ANSWER_S:g} s and two of its periods, {2 * link.ANSWER_S:g} s at most" in page
    assert f"of the last {link.KEPT_EVENTS} events (fewer when their texts have more than" in page
    assert f"more than {link.KEPT_TEXT >> 20} MiB together" in page
    assert f"A process may keep {server.MOST_OF_PROCESS} connections, all together" in page
    assert f"all together {server.MOST_CONNECTIONS}." in page


# Hostile bodies

DEEP = b'{"positions":' + b'{"a":' * 20_000 + b"1" + b"}" * 20_001
NINES = b"9" * 400


@pytest.mark.parametrize("query", ["", "?units=true"])
@pytest.mark.parametrize("kind", ["go", "positions", "position"])
@pytest.mark.parametrize(
    "body",
    [
        DEEP,
        b'{"pan":' + b"[" * 500 + b"]" * 500 + b"}",
        b'{"pan":' + NINES + b"}",
        b'{"pan":-' + NINES + b"}",
        b'{"pan":1e400}',
        b'{"positions":[' + NINES + b"]}",
        b'{"positions":[1e400]}',
    ],
)
def test_what_is_too_deep_or_too_large_for_a_number_is_wrong_input(desk, kind, query, body):
    status, answer = desk.ask("POST", f"{ARM}/{kind}{query}", body)
    assert status in {404, 422}, answer
    assert desk.taken == []


LOAD = {"name": "more", "type": "arm", "joints": ["pan"]}
NOPES = [f"nope{number}" for number in range(40_000)]
HUGE = [
    (GO, b"[" * 100_000, "invalid: go of left is not JSON (recursion limit"),
    (GO, {"positions": ["x"] * 50_000}, "invalid: ...; and 49995 more"),
    ("/switch", b"[" * 100_000, "invalid: ...write for example"),
    ("/rate", b'{"rate": 1' + b"0" * 400 + b"}", "invalid: ...write for example"),
    ("/controllers", LOAD | {"name": "a" * 65}, "invalid: ...at most 64"),
    (f"{ARM}/positions?units=true", DEEP, "invalid: the body is nested too deeply; use fewer levels"),
    *(("/switch", {key: ["left"] * 20_000}, "named_twice: ...left") for key in ("activate", "deactivate")),
    # of thousands of wrong names an answer has some
    ("/switch", {"activate": NOPES}, "unknown_controller: "),
    ("/torque", {"joints": NOPES, "on": False}, "unknown_joint: "),
    (f"{ARM}/positions?units=true", {"positions": NOPES}, "wrong_quantity: "),
    (f"{ARM}/position?units=true", {"positions": NOPES}, "unknown_command: "),
]


@pytest.mark.parametrize(("path", "body", "refused"), HUGE, ids=range(len(HUGE)))
def test_a_huge_request_is_refused_with_one_short_answer(desk, path, body, refused):
    status, answer = desk.ask("POST", path, body)
    assert status == (404 if refused.startswith("unknown") else 422)
    assert matches(f"{refused}...", f"{answer['code']}: {answer['refused']}")
    assert len(json.dumps(answer)) < 10_000
    assert len(answer["refused"]) < 2001
    assert desk.taken == []


# Load, and failures of a part


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


def test_poses_that_take_long_are_interrupted(monkeypatch):
    def pause(*_):
        assert 0 < signal.getitimer(signal.ITIMER_REAL)[0] <= 0.05  # not the limit of the test, or none
        signal.pause()

    monkeypatch.setattr(preparation, "BUDGET_S", 0.05)
    monkeypatch.setattr(Poses, "find_pose", pause)
    motions = {"a": {"steps": [{"time": "1 s", "pose": "rest"}]}}
    entry = {"name": "more", "type": "keyframe_player", "joints": ["pan"], "motions": motions}
    status, content = Desk(offered=load_plugins()).ask("POST", "/controllers", entry)
    assert (status, content["refused"].partition(" s ")[0]) == (422, "more needed more than 0.05")


class WatchedOffers(dict):
    """Offers of a package; looks at the timer that interrupts code which takes long."""

    def get(self, name, default=None):
        """Return an offer after the import."""
        self.timer = signal.getitimer(signal.ITIMER_REAL)
        return super().get(name, default)


def test_import_of_a_controller_that_is_loaded_is_not_interrupted():
    offers = WatchedOffers(arm=Offer("arm", Arm, "tests 1"))
    desk = Desk(offered=PlugIns(offers, {}))
    status, content = desk.ask("POST", "/controllers", {"name": "more", "type": "arm", "joints": ["pan"]})
    assert (status, 0 < offers.timer[0] <= preparation.BUDGET_S) == (200, False), (
        content
    )  # pytest has a timer, too


def test_a_failure_of_the_gateway_itself_fails_one_request_only(desk, monkeypatch, capsys):
    monkeypatch.setattr(desk.link, "newest", lambda: 1 / 0)
    status, content = desk.ask("GET", "/states")
    assert status == 500
    assert "ZeroDivisionError" in content["refused"]
    assert "Traceback" in capsys.readouterr().err
    assert desk.ask("POST", "/pause") == (200, DONE)
