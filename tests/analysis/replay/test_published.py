"""Messages of topics in a replay: all the same, or the first difference named, down to one bit of a field."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import dxlrun_lab.commands.replay
from dxlrun.log.reader import read_log
from dxlrun.output.terminal import show
from dxlrun_analysis.replay import replay_log
from dxlrun_analysis.replay.changes import Setting

Change = Callable[..., Path]
TOPIC = "/all_inputs/state"


def flip(content: Any, index: int, at: int, bit: int = 0) -> None:
    t_ns, data = content.messages[TOPIC][index]
    changed = bytearray(data)
    changed[at] ^= 1 << bit
    content.messages[TOPIC][index] = (t_ns, bytes(changed))


def test_messages_from_activation_to_deactivation_are_the_same(pair_log: Path) -> None:
    assert len(read_log(pair_log).topics[TOPIC].data) == 52
    report = replay_log(pair_log)
    assert report.same
    assert report.messages >= 52
    assert report.sentence == "pair: 50 cycles replayed, 0 differences"


@pytest.mark.parametrize(
    ("index", "at", "place"),
    [
        (0, 4, (-1, "header.stamp.sec")),
        (1, 20, (0, "number")),
        (30, -8, (29, "sum[1]")),
        (51, -16, (49, "sum[0]")),
    ],
)
def test_one_bit_of_one_message_is_named(
    pair_log: Path, changed: Change, index: int, at: int, place: tuple[int, str]
) -> None:
    report = replay_log(changed(pair_log, lambda content: flip(content, index, at)))
    assert not report.same
    assert (report.different, report.different_messages) == (0, 1)
    assert report.first is not None
    cycle, field = place
    assert (report.first.cycle, report.first.what) == (cycle, f"message of {TOPIC}: {field}")
    assert report.first.recorded != report.first.replayed
    assert report.sentence == f"pair: 50 cycles replayed, 1 of {report.messages} messages differs"


def test_the_first_of_two_and_the_command_of_its_cycle_count(pair_log: Path, changed: Change) -> None:
    def change(content: Any) -> None:
        flip(content, 21, -8)
        flip(content, 11, -8)
        content.cycles["command_position"][10][1] += 1.0

    report = replay_log(changed(pair_log, change))
    assert report.first is not None
    assert (report.first.cycle, report.first.what) == (10, "command of the position")
    assert report.different_messages == 2


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda messages: messages.pop(7), (6, "no message", "a message")),
        (lambda messages: messages.insert(7, messages[7]), (6, "a message", "no message")),
        (lambda messages: messages.append(messages[-1]), (49, "a message", "no message")),
    ],
    ids=["one less", "one more", "one more at the end"],
)
def test_a_message_in_one_of_the_two_only_is_a_difference(
    pair_log: Path, changed: Change, change: Callable[[Any], None], expected: tuple[int, str, str]
) -> None:
    report = replay_log(changed(pair_log, lambda content: change(content.messages[TOPIC])))
    assert report.different_messages == 1
    assert report.first is not None
    assert (report.first.cycle, report.first.recorded, report.first.replayed) == expected


def test_messages_that_the_recorder_lost_are_a_remark(pair_log: Path, run: Callable[..., Path]) -> None:
    def before(robot: Any) -> None:
        ring = robot.sinks.messages
        message, dropped = ring.message, []

        class Lossy:
            announce = staticmethod(ring.announce)

            @staticmethod
            def message(topic: int, t_ns: int, data: bytes) -> None:
                dropped.append(t_ns)
                if 5 <= len(dropped) < 9:
                    if len(dropped) == 8:
                        robot._writer.gap("loop/messages", 4)
                    return
                message(topic, t_ns, data)

        for managed in robot.robot.manager._managed:
            for publisher in managed._topics._publishers.values():
                publisher._sink = Lossy()

    report = replay_log(run(before))
    assert report.same
    assert "the log misses 4 messages of topics" in report.remarks


def test_a_log_without_the_topic_is_replayed_without_it(pair_log: Path, changed: Change) -> None:
    report = replay_log(changed(pair_log, lambda content: content.messages.clear()))
    assert report.same
    assert report.messages == 0


def test_another_parameter_shows_in_commands_and_messages(pair_log: Path) -> None:
    report = replay_log(pair_log, [Setting.parse("all_inputs.gain=0.5")])
    assert report.different
    assert report.different_messages  # its own goals are an input of the next cycle
    assert "replayed cycles differ" in report.sentence


def test_what_is_shown_of_a_message_is_one_sentence(
    pair_log: Path, changed: Change, capsys: pytest.CaptureFixture[str]
) -> None:
    report = replay_log(changed(pair_log, lambda content: flip(content, 30, -1, 7)))
    show(*dxlrun_lab.commands.replay._replayed(report))
    first = capsys.readouterr().out.splitlines()[1]
    value = struct.unpack("<d", read_log(pair_log).topics[TOPIC].data[30][-8:])[0]
    assert first == (
        f"first: cycle 29, 0.580 s, message of {TOPIC}: sum[1]: recorded {-value!r}, replayed {value!r}"
    )
