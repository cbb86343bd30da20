"""Messages of topics in a replay: all the same, or the first difference named, down to one bit of a field."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from tests.kit.anew import Change, add, messages
from tests.kit.stories import differing

import dxlrun_lab.commands.replay
from dxlrun.log.log_reader import read_log
from dxlrun.output.terminal import show_parts
from dxlrun_analysis.replay import replay_log

Changed = Callable[..., Path]
TOPIC = "/all_inputs/state"


def flip(index: int, at: int, bit: int = 0) -> Change:
    """Flip a bit of a message."""

    def edit(found: list[tuple[int, bytes]]) -> None:
        t_ns, data = found[index][0], bytearray(found[index][1])
        data[at] ^= 1 << bit
        found[index] = (t_ns, bytes(data))

    return messages(TOPIC, edit)


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
    pair_log: Path, changed: Changed, index: int, at: int, place: tuple[int, str]
) -> None:
    report, first = differing(changed(pair_log, flip(index, at)))
    assert (report.different, report.different_messages) == (0, 1)
    cycle, field = place
    assert (first.cycle, first.what) == (cycle, f"message of {TOPIC}: {field}")
    assert first.recorded != first.replayed
    assert report.sentence == f"pair: 50 cycles replayed, 1 of {report.messages} messages differs"


def test_the_first_of_two_and_the_command_of_its_cycle_count(pair_log: Path, changed: Changed) -> None:
    changes = flip(21, -8), flip(11, -8), add("command_position", (10, 1), 1.0)
    report, first = differing(changed(pair_log, *changes))
    assert (first.cycle, first.what) == (10, "command of the position")
    assert report.different_messages == 2


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda found: found.pop(7), (6, "no message", "a message")),
        (lambda found: found.insert(7, found[7]), (6, "a message", "no message")),
        (lambda found: found.append(found[-1]), (49, "a message", "no message")),
    ],
    ids=["one less", "one more", "one more at the end"],
)
def test_a_message_in_one_of_the_two_only_is_a_difference(
    pair_log: Path, changed: Changed, change: Callable[[Any], None], expected: tuple[int, str, str]
) -> None:
    report, first = differing(changed(pair_log, messages(TOPIC, change)))
    assert report.different_messages == 1
    assert (first.cycle, first.recorded, first.replayed) == expected


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
    assert "the log lacks 4 messages of topics" in report.remarks


def test_a_log_without_the_topic_is_replayed_without_it(pair_log: Path, changed: Changed) -> None:
    report = replay_log(changed(pair_log, lambda log: replace(log, topics={})))
    assert (report.same, report.messages) == (True, 0)


def test_what_is_shown_of_a_message_is_one_sentence(
    pair_log: Path, changed: Changed, capsys: pytest.CaptureFixture[str]
) -> None:
    report, _ = differing(changed(pair_log, flip(30, -1, 7)))
    show_parts(*dxlrun_lab.commands.replay._replayed(report))
    first = capsys.readouterr().out.splitlines()[1]
    value = struct.unpack("<d", read_log(pair_log).topics[TOPIC].data[30][-8:])[0]
    assert first == (
        f"first: cycle 29, 0.580 s, message of {TOPIC}: sum[1]: recorded {-value!r}, replayed {value!r}"
    )
