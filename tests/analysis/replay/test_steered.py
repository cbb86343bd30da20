"""A replay of a steered run has no difference: what clients asked, they ask of the same cycles again."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import msgspec
import numpy as np
import pytest
from msgspec import structs
from tests.kit.changed_logs import Change, command, flip, no_commands, without
from tests.kit.virtual_run import Asked, VirtualRun, ask, differing, rate, replayed, send, switch, torque

from dxlrun.channels.commands import CommandMessage
from dxlrun.channels.event_records import EventCode
from dxlrun.errors import LogError
from dxlrun.plan.loop_plan import ControllerPlan
from dxlrun.testing import read_log
from dxlrun_analysis.conduct.client_commands import client_commands, policy_begun
from dxlrun_analysis.replay import replay_log

pytestmark = pytest.mark.long

MS = 1_000_000
MORE = """\
  standby: {type: all_inputs, joints: [tilt, nod], gain: 1e-3, active: false}
  direct: {type: joint_group_position_controller, joints: [tilt, nod], active: false}
"""
KEEPS = ("", "")
FALLS = ("[tilt, nod]}", "[tilt, nod], give_up_after: 0.35, fallback: standby}")
FAILS = ("[tilt, nod]}", "[tilt, nod], give_up_after: 0.35}")
LOADED = ControllerPlan(
    "guest", "joint_group_posvel_controller", "dxlrun 0", '{"joints":["nod"]}', ("nod",),
    ("position", "velocity"), (), active=False, every=1, rate=25.0,
)  # fmt: skip


GUESTS = [ask("pause"), ask("load", LOADED), switch(["guest"], ["all_inputs"]), ask("resume")]
STORIES: dict[str, Asked] = {
    "rates": {5: [rate(100)], 20: [rate(25), rate(200)], 50: [rate(50), rate(1e9), rate(60)]},
    "a pause in a motion": {15: [ask("pause")], 30: [ask("resume"), ask("resume")]},
    "switches": {
        4: [switch(["standby"])],
        6: [switch(["standby"], ["all_inputs"])],
        20: [switch(["all_inputs"], ["standby"]), switch([], ["head"]), switch(["nobody"])],
        30: [switch(["head"])],
    },
    "a stream that ends": {
        3: [switch(["direct"], ["all_inputs"])],
        **{n: [send("direct", "positions", 0.01 * n, 0.1, lease_ns=50 * MS)] for n in range(4, 15)},
        30: [send("direct", "positions", 0.2, 0.3)],
        35: [
            CommandMessage(0, "direct", "positions", b"thirteen byte", "mallory"),
            ask("what", {"is": "this"}),
        ],
    },
    "a controller that is loaded": {
        5: GUESTS,
        9: [send("guest", "posvel", 0.3, 1.0)],
        25: [ask("unload", {"controller": "guest"}), switch(["all_inputs"], ["guest"]), ask("pause")],
        26: [ask("unload", {"controller": "guest"}), ask("load", LOADED), ask("resume")],
    },
    "a fallback": {5: [rate(100)], 15: [rate(50)]},
    "registers": {
        4: [ask("register", {"joint": "nod", "item": "cw_compliance_slope", "value": 64})],
        9: [ask("register", {"joint": "tilt", "item": "temperature_limit", "value": 60})],
    },
    "torque and a reboot": {
        4: [torque(["tilt"], on=False, release=True), ask("get", {"joint": "nod", "item": "punch"})],
        12: [torque(["tilt"], on=True)],
        20: [ask("reboot", {"joints": ["nod"], "release": True}), torque(["nobody"], on=True)],
        35: [ask("halt")],
    },
    "a stop in a pause": {10: [ask("pause")], 20: [ask("stop")]},
    "rubbish": {4: [CommandMessage(0, "", "switch", b'{"activate": ["\xff"]}', "mallory"), ask("policy")]},
}


@pytest.fixture(scope="module")
def steer(robot_file, tmp_path_factory):
    """Run the robot for a second while clients ask of it; return the log."""
    directory, play = tmp_path_factory.mktemp("steered"), [robot_file.with_name("look.yaml")]

    def run(
        asked: Asked,
        more: str = "",
        before: Callable[[VirtualRun], None] = lambda run: None,
        edit: tuple[str, str] = KEEPS,
        name: str = "run",
    ) -> Path:
        text, file = robot_file.read_text() + MORE + more, directory / "steered.yaml"
        assert edit[0] in text
        file.write_text(text.replace(*edit, 1))
        one = VirtualRun(file, directory / f"{name}.mcap", asked, play=play, duration_s=1.0)
        before(one)
        return one.logged()

    return run


@pytest.fixture(scope="module")
def tell(steer):
    """Return the log of a story, which is run once."""
    return cache(lambda name: steer(STORIES[name], edit=FALLS if name == "a fallback" else KEEPS, name=name))


@pytest.mark.parametrize("story", STORIES)
def test_a_steered_run(tell, story):
    log = replayed(tell(story))
    asked = [command for _, commands in sorted(STORIES[story].items()) for command in commands]
    told = [(one.command.controller, one.command.kind, one.command.lease_ns) for one in client_commands(log)]
    assert told == [(one.controller, one.kind, one.lease_ns) for one in asked]
    refused = [event.text for event in log.events if event.code == EventCode.COMMAND_REFUSED]
    assert [one.refusal for one in client_commands(log) if one.refusal] == [
        text.split(" refused: ", 1)[1] for text in refused
    ]


def test_the_stories_do_what_they_are_there_for(tell):
    log = read_log(tell("rates"))
    assert set(np.diff(log.cycles["scheduled_ns"]).tolist()) == {20 * MS, 10 * MS, 5 * MS}
    log = read_log(tell("a fallback"))
    assert {int(mask) for mask in log.cycles["active"]} == {0b0111, 0b1011}
    log = read_log(tell("a controller that is loaded"))
    assert (log.cycles["active"] >> 5 & 1).any()
    log = read_log(tell("a stream that ends"))
    assert [event.name for event in log.events].count("stale_command") == 1


POSES = "poses: {home: {pan: 0 deg, tilt: 10 deg, nod: 5 deg}}"
ENDS = {
    "the end": (
        "{on_exit: [{pose: home, speed: 60 deg/s}, {reduce_torque: 0.5, steps: 2, over: 100 ms}, hold]}",
        {},
    ),
    "a stop in a pause": ("{on_exit: [{pose: home, speed: 60 deg/s}, limp]}", STORIES["a stop in a pause"]),
    "a fault": ("{on_fault: [{pose: home, speed: 60 deg/s}, limp]}", STORIES["rates"]),
    "a stale command": (
        "{on_stale_command: [{pose: home, speed: 60 deg/s}, hold]}",
        {3: [switch(["direct"], ["all_inputs"]), send("direct", "positions", 0.1, 0.1, lease_ns=50 * MS)]},
    ),
}


@pytest.mark.parametrize("end", ENDS)
def test_a_run_that_ended_by_a_policy(steer, end):
    policies, asked = ENDS[end]
    edit = FAILS if end == "a fault" else KEEPS
    log = replayed(steer(asked, f"{POSES}\npolicies: {{exit_timeout: 4 s, {policies[1:]}\n", edit=edit))
    begun = policy_begun(log)
    assert begun is not None
    assert (log.cycles["active"][log.cycles["cycle"] >= begun.cycle] == 0).all()
    assert (log.cycles["cycle"] >= begun.cycle).sum() >= 5


@pytest.mark.parametrize("overrun", ["skip", "catch_up", "stop"])
@pytest.mark.parametrize("lost", ["hold", "[{pose: home, speed: 60 deg/s}, limp]"])
def test_late_cycles_and_lost_servos_while_it_is_steered(steer, overrun, lost):
    def silent(one: VirtualRun) -> None:
        one.silence((3, 7, 8), 400, 430)
        one.silence((3, 7, 8), 600, 900)

    policies = (
        f"{{exit_timeout: 4 s, on_lost_servo: {lost}, on_fault: [{{pose: home, speed: 60 deg/s}}, limp]}}"
    )
    log = replayed(
        steer(
            {2: [rate(200)], 40: [rate(100)], 60: [ask("pause"), rate(200)], 70: [ask("resume")]},
            f"{POSES}\npolicies: {policies}\n",
            silent,
            ('loop: {rate: "${rate}"}', f'loop: {{rate: "${{rate}}", overrun: {overrun}}}'),
        )
    )
    assert not log.cycles["valid"].all()
    late = log.cycles["written_ns"][:-1] > log.cycles["scheduled_ns"][1:]
    assert late.any() or log.cycles["skipped"].any()
    assert (policy_begun(log) is None) == (overrun != "stop" and lost == "hold")


FLIPPED: dict[str, tuple[str, Change, int]] = {
    "who is switched": ("switches", command("switch", data=switch([], ["all_inputs"]).data), 4),
    "a set-point": ("a stream that ends", command("positions", data=np.array([0.04, 0.5]).tobytes()), 4),
    "a lease": ("a stream that ends", command("positions", 10, lease_ns=0), 17),
    "a pause": ("a pause in a motion", command("pause", kind="resume"), 16),
    "what is loaded": (
        "a controller that is loaded",
        command(
            "load",
            data=msgspec.json.encode(structs.replace(LOADED, rate=50.0, parameters='{"joints":["pan"]}')),
        ),
        9,
    ),
}


@pytest.mark.parametrize("flipped", FLIPPED)
def test_a_flipped_command_is_found(tell, changed, flipped):
    story, change, latest = FLIPPED[flipped]
    _, first = differing(changed(tell(story), change))
    assert first.cycle <= latest, first


@pytest.mark.parametrize(("cycle", "owner"), [(5, "all_inputs"), (10, "standby")])
def test_of_several_controllers_of_a_joint_the_active_one_is_named(tell, changed, cycle, owner):
    _, first = differing(changed(tell("switches"), flip("command_position", cycle, 1)))
    assert (first.cycle, first.joint, first.controller) == (cycle, "tilt", owner)


@pytest.mark.parametrize(
    ("story", "change", "sentence"),
    [
        ("rates", command("rate", data=rate(50).data), "in the replay: the log is damaged, or"),
        ("rates", command("rate", kind="resume"), "contradict"),
        (
            "a pause in a motion",
            command("pause", t_ns=77),
            r"a command \(pause\) and its cycle .* have different",
        ),
        (
            "a pause in a motion",
            command("trajectory", t_ns=77),
            r"\(trajectory\) and its cycle .* have different",
        ),
    ],
)
def test_commands_that_cannot_be_are_damage(tell, changed, story, change, sentence):
    with pytest.raises(LogError, match=sentence):
        replay_log(changed(tell(story), change))


def test_nothing_is_compared_behind_a_lost_command_for_the_loop_or_cycles_around_another_rate(tell, changed):
    lost = changed(tell("a pause in a motion"), no_commands("resume"), gaps=[("loop/commands", 1)])
    report = replay_log(lost)
    assert (report.compared, report.different) == (30, 0)
    assert report.stopped.startswith(
        "the log lacks a command of cycle 30 (1 record of loop/commands lost: overwritten or damaged before "
        "reading)"
    )
    report = replay_log(changed(tell("rates"), without(*range(18, 24))))  # the rate changes in cycle 20
    assert (report.compared, report.different) == (18, 0)
    assert report.stopped.startswith("the log lacks cycles between 18 and 23")


def test_what_is_refused_only_in_the_replay_is_reported(tell, changed):
    change = command("load", data=msgspec.json.encode(structs.replace(LOADED, type="gone")))
    report, first = differing(changed(tell("a controller that is loaded"), change))
    assert report.remarks[0] == (
        "load for the loop in cycle 5 was done in the run and is refused (no plug-in offers the type gone of "
        "controller guest) in the replay"
    )
    assert first.cycle == 5


def test_a_policy_of_which_the_log_has_lost_the_beginning(steer, changed):
    policies = "policies: {exit_timeout: 4 s, on_exit: [{pose: home, speed: 60 deg/s}, limp]}\n"
    log = steer({}, f"{POSES}\n{policies}")
    begun = policy_begun(read_log(log))
    assert begun is not None
    report = replay_log(changed(log, lambda read: replace(read, commands=read.commands[:-1])))
    assert (report.compared, report.different) == (begun.cycle, 0)
    assert report.stopped == f"the log lacks the start of a policy after cycle {begun.cycle - 1}"


def test_a_bus_that_is_gone_before_the_policy(steer):
    def pull(one: VirtualRun) -> None:
        (port,) = one.robot.hardware._lines.ports.ports  # no face of a run pulls adapters
        one.at(500, port.unplug)

    policies = "policies: {exit_timeout: 4 s, on_lost_servo: [{pose: home, speed: 60 deg/s}, limp]}\n"
    log = replayed(steer({5: [rate(100)]}, "poses: {home: {pan: 0 deg}}\n" + policies, pull))
    assert policy_begun(log) is not None
