"""Compiles the section `recording`: size or duration of a log's parts, and the limit for old logs."""

from __future__ import annotations

from dxlrun.compile.contribution import Compilation, CompileStage, Contribution
from dxlrun.features.recording import form
from dxlrun.plan.recording_plan import RecordingPlan

_LEAST_BYTES, _LEAST_NS = 1_000_000, 1_000_000_000
"""Smallest size and duration of a part of a log: each part contains the robot file and the plan again."""


def compile_recording(compilation: Compilation) -> Contribution:
    """Return the log settings for the plan; add an error for tiny parts, or `keep` without `split`."""
    file, marks = compilation.file, compilation.file.marks
    written = form.STAGE.section_of(file.robot)
    amount = {} if written.split is None else dict([written.split])
    if amount.get("bytes", _LEAST_BYTES) < _LEAST_BYTES or amount.get("ns", _LEAST_NS) < _LEAST_NS:
        file.error(
            marks.value("recording", "split"),
            "the files of a log would be too small: each contains the robot file and the plan",
            "write at least 1 MB or 1 s",
        )
    kept = {} if written.keep is None else dict([written.keep])
    if "ns" in kept and written.split is None:
        file.error(
            marks.key("recording", "keep"),
            "a duration under keep needs split",
            "add `split: 1 min`, or write a size under keep",
        )
    limits = amount.get("bytes"), amount.get("ns"), kept.get("ns"), kept.get("bytes")
    return Contribution(recording=RecordingPlan(written.directory, *limits))


STAGE = CompileStage(compile_recording)
