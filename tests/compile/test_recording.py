"""How the robot file splits the log and how long parts are kept, with every mistake at its place."""

from __future__ import annotations

import pytest
from tests.kit.robots import PAIR, compile_text

from dxlrun.features.recording.form import Recording
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


@pytest.mark.parametrize("split", ["100 MB", "1.5 MiB", "10 min"])
def test_a_split_is_written_back_as_what_it_was(split: str) -> None:
    first = Recording.model_validate({"split": split})
    assert Recording.model_validate_json(first.model_dump_json(exclude_none=True)) == first
