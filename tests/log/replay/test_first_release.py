"""A log of the first release: it can still be read, analysed and replayed.

`first_release.mcap` was written by that release: the torso on virtual time for 0.4 s, with pause, resume,
another rate, a set-point for the head, and three commands that were refused.
"""

from __future__ import annotations

from pathlib import Path

from dxlrun.log.reader import read_log
from dxlrun_analysis.client_commands import client_commands
from dxlrun_analysis.replay import replay_log

LOG = Path(__file__).with_name("first_release.mcap")


def test_it_is_read_whole_with_long_texts_joined() -> None:
    log = read_log(LOG)
    assert log.complete
    assert not log.damage
    (torque_on,) = [event for event in log.events if event.name == "torque_on"]
    assert all(joint in torque_on.text for joint in log.joints)
    assert len(log.packets) > 100


def test_its_commands_have_their_refusals() -> None:
    found = [(one.command.kind, one.refusal) for one in client_commands(read_log(LOG))]
    assert found == [
        ("pause", ""),
        ("pause", "the loop is paused already"),
        ("resume", ""),
        ("switch", "there is no controller nobody"),
        ("posvel", ""),
        ("rate", ""),
        ("posvel", "there is no such controller as nothere"),
    ]


def test_its_replay_is_bit_exact_but_for_the_speeds_that_the_gate_sends_now() -> None:
    """Since then the limit of a joint's speed goes out with each goal."""
    report = replay_log(LOG)
    assert {(one.commands, one.references) for one in report.joints} == {(0, 0)}
    first = report.first
    assert first is not None
    assert (first.what, first.recorded[:3]) == ("goal of the velocity, after the last gate", "nan")
    assert report.compared == report.cycles > 20
    assert not report.stopped
