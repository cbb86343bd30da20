"""Experiments: one that plays what it is given, and the commands of the pages."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from dxlrun.errors import Refused
from dxlrun_lab.guided.choice import situation_of
from dxlrun_lab.guided.experiment import (
    Abort,
    ExperimentJoint,
    ExperimentOutcome,
    Procedure,
    Situation,
    perform_experiment,
)
from dxlrun_lab.guided.rig import Rig
from dxlrun_lab.guided.segment import Segment, SegmentRecording

ROOT = Path(__file__).parents[2]
ROBOTS = ROOT / "robots"
Segments = Callable[[ExperimentJoint], Iterator[Segment]]


class Plays:
    """An experiment that plays what it is given; keeps what the procedure got back."""

    def __init__(self, segments: Segments) -> None:
        self.segments = segments
        self.got: list[SegmentRecording] = []
        self.refused: list[str] = []

    def describe_motions(self, situation: Situation) -> Sequence[str]:
        return ()

    def procedure(self, situation: Situation) -> Procedure:
        for segment in self.segments(situation.joints[0]):
            try:
                self.got.append((yield segment))
            except Refused as refusal:
                self.refused.append(str(refusal))

    def evaluate_recordings(
        self, situation: Situation, recorded: Sequence[SegmentRecording], why: str
    ) -> int:
        return len(recorded)


def sine(joint: ExperimentJoint, rate: float = 320, seconds: float = 1.0, **more: object) -> Segment:
    wave = joint.middle + 0.2 * np.sin(2 * np.pi * np.arange(round(rate * seconds)) / rate)
    return Segment("sine", 1 / rate, {joint.name: wave}, **more)


def state_of(rig: Rig) -> object:
    """Return what an experiment must leave as it was."""
    return rig.controllers(), rig.rate, rig.paused


def perform(
    rig: Rig, joint: str, segments: Segments, abort: Abort = lambda: None
) -> tuple[Plays, ExperimentOutcome]:
    """Perform an experiment, and check that the run is as it was before."""
    before, plays = state_of(rig), Plays(segments)
    done = perform_experiment(rig, plays, situation_of(rig, [joint], {}), abort)
    assert done.not_restored == ()
    assert state_of(rig) == before
    return plays, done
