"""Experiment of `dxlrun identify`: moves one joint after the other, and fits a servo model to each motion."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from dxlrun import InputError, Log
from dxlrun_lab.guided.choice import require_own_servos
from dxlrun_lab.guided.experiment import ExperimentJoint, Procedure, Situation
from dxlrun_lab.guided.segment import Guard, Segment, SegmentRecording
from dxlrun_lab.identify.excitation import Room, excitation
from dxlrun_lab.identify.fit import FitCurve, curves, fit_run
from dxlrun_lab.identify.joint_recording import measured
from dxlrun_lab.identify.known_servo import Servo, servo_of, servos_in
from dxlrun_lab.identify.result import IdentifiedServo, KnownLoad, identified

SECONDS = 60.0
"""Duration of the excitation of each joint, s"""
_LEAST_RATE = 50.0
"""Lowest loop rate that resolves a motor's dynamics, Hz"""


class Options(msgspec.Struct, frozen=True):
    """Options of `dxlrun identify`"""

    seconds: float = SECONDS
    """Duration of the excitation of each joint, s"""
    seed: int = 0
    """Seed of the excitation's random numbers"""
    load: KnownLoad = msgspec.field(default_factory=KnownLoad)
    voltage: float | None = None
    """Supply voltage in place of the servo's measurement, V"""


class JointResult(msgspec.Struct, frozen=True):
    """Result of the identification of one joint, or the reason why there is none"""

    joint: str
    identified: IdentifiedServo | None
    """Parameters of its servo; None if they could not be identified"""
    refusal: str = ""
    """Reason for a missing result, one sentence"""
    position: FitCurve | None = None
    """Measured and simulated positions, for the figures"""


class Identification(msgspec.Struct, frozen=True):
    """Experiment (see guided/experiment.py) that moves one joint after the other to identify its servo"""

    options: Options = Options()

    def describe_motions(self, situation: Situation) -> Sequence[str]:
        """Describe the excitation of each joint, one sentence each.

        Raises InputError for a joint that cannot be identified, or if the loop rate is too low.
        """
        if situation.rate < _LEAST_RATE:
            raise InputError(
                f"the loop rate of {situation.rate:g} Hz is too low to identify a motor; raise it to "
                f"{_LEAST_RATE:g} Hz or more"
            )
        require_own_servos(situation.plan, situation.names, "identify", gears=False)
        for joint in situation.joints:
            self._parts(joint, situation)
            servo_of(situation.plan, joint.name).control()
        seconds = self.options.seconds
        return [
            f"{joint.name}: steps, sines up to 5 Hz and slow triangles, {seconds:g} s, through its range"
            for joint in situation.joints
        ]

    def procedure(self, situation: Situation) -> Procedure:
        """Yield the excitation of each joint. All other joints hold."""
        for joint in situation.joints:
            for segment in self._parts(joint, situation):  # noqa: UP028  a list takes no answers
                yield segment

    def evaluate_recordings(
        self, situation: Situation, recorded: Sequence[SegmentRecording], why: str
    ) -> tuple[JointResult, ...]:
        """Fit the servo model to the recordings of each joint; return one result per joint."""
        results = []
        for joint in situation.joints:
            mine = [part for part in recorded if joint.name in part.segment.rows]
            if not mine:
                results.append(JointResult(joint.name, None, f"{joint.name}: nothing was recorded"))
                continue
            cycles = np.concatenate([part.cycles for part in mine])
            row = mine[0].columns[mine[0].joints.index(joint.name)]
            servo = servo_of(situation.plan, joint.name)
            source = f"dxlrun identify, {self.options.seconds:g} s" + (
                ", simulated" if situation.virtual else ""
            )
            results.append(_result(cycles, row, servo, self.options, source))
        return tuple(results)

    def _parts(self, joint: ExperimentJoint, situation: Situation) -> list[Segment]:
        lower, upper = joint.inner
        room = Room(lower, upper, joint.plan.velocity or math.inf, joint.plan.acceleration or math.inf)
        period_s = 1.0 / situation.rate
        parts = excitation(room, self.options.seconds, period_s, start=joint.start, seed=self.options.seed)
        return [
            Segment(f"{joint.name}: {part.title}", period_s, {joint.name: part.goals}, guard=Guard())
            for part in parts
        ]


def from_log(log: Log, joints: Sequence[str], options: Options) -> tuple[JointResult, ...]:
    """Identify joints from the log of an earlier run, by default all of its joints.

    Raises:
        InputError: The log lacks a joint, or a joint cannot be identified.
    """
    source = Path(log.path).name
    return tuple(
        _result(log.cycles, log.joints.index(servo.joint), servo, options, source)
        for servo in servos_in(log, joints or log.joints)
    )


def _result(cycles: NDArray[np.void], row: int, servo: Servo, options: Options, source: str) -> JointResult:
    try:
        run = measured(cycles, row, servo, voltage=options.voltage)
        fits = fit_run(run)
        found = identified(run, fits, options.load, source)
    except InputError as error:
        return JointResult(servo.joint, None, " ".join(error.sentences))
    return JointResult(servo.joint, found, position=curves(run, fits[0].numbers)[0])
