"""How the robot file splits the log and how long parts are kept, with every mistake at its place."""

from __future__ import annotations

import pytest
from tests.kit.robots import PAIR, compile_text, problems_in

from dxlrun.description.robot import Recording
from dxlrun.plan.recording_plan import RecordingPlan

SECOND = 1_000_000_000


def with_recording(text: str, recording: str) -> str:
    return f"{text}recording: {recording}\n"


@pytest.mark.parametrize(
    ("recording", "plan"),
    [
        ("{}", RecordingPlan()),
        ("{split: 100 MB}", RecordingPlan(split_bytes=100_000_000)),
        ("{split: 64 MiB}", RecordingPlan(split_bytes=64 << 20)),
        ("{split: 10 min}", RecordingPlan(split_ns=600 * SECOND)),
        ("{directory: x, split: 1 s, keep: 10 min}", RecordingPlan("x", None, SECOND, 600 * SECOND)),
    ],
)
def test_what_is_written_reaches_the_plan(recording: str, plan: RecordingPlan) -> None:
    assert compile_text(with_recording(PAIR, recording)).plan.recording == plan


@pytest.mark.parametrize(
    ("recording", "problem"),
    [
        (
            "{split: 100 kB}",
            "20: parts of a log would be too small: each has the robot file and the plan inside; "
            "write 1 MB or 1 s at least",
        ),
        (
            "{split: 0 s}",
            "20: parts of a log would be too small: each has the robot file and the plan inside; "
            "write 1 MB or 1 s at least",
        ),
        (
            "{split: 100}",
            "20: recording.split: 100 has no unit; write a size or a duration with its unit, "
            "such as 100 MB or 10 min",
        ),
        (
            "{split: 3 m}",
            "20: recording.split: '3 m' has the unit m, which is not one of a size or a duration; "
            "write it as 100 MB or 10 min",
        ),
        (
            "{split: -3 MB}",
            "20: recording.split: '-3 MB' is out of range; "
            "write a size or a duration such as 100 MB or 10 min",
        ),
        (
            "{keep: 10 min}",
            "13: keep needs parts: a log in one file is kept whole; "
            "write `split: 1 min` beside it, or take keep out",
        ),
        (
            "{split: 1 MB, keep: -3 s}",
            "32: recording.keep: '-3 s' is no duration from 0 s to 31 years; "
            "write one such as 500 us, 1 ms, 2 s or 1 min",
        ),
    ],
)
def test_what_cannot_be_is_told_with_its_place(recording: str, problem: str) -> None:
    line = PAIR.count("\n") + 1
    found = [str(one).split("robot.yaml:")[1] for one in problems_in(with_recording(PAIR, recording))]
    assert found == [f"{line}:{problem}"]


@pytest.mark.parametrize("split", ["100 MB", "1.5 MiB", "10 min"])
def test_a_split_is_written_back_as_what_it_was(split: str) -> None:
    first = Recording.model_validate({"split": split})
    assert Recording.model_validate_json(first.model_dump_json(exclude_none=True)) == first
