"""Procedure of `dxlrun characterize`: motions of each measurement, and their evaluation."""

from __future__ import annotations

import math
from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, Literal, get_args

import msgspec
import numpy as np

from dxlrun import Floats, Refused
from dxlrun_lab.characterize import dead_band, gaps, rates, response, speeds
from dxlrun_lab.characterize.joint_figure import JointFigure, not_measured
from dxlrun_lab.characterize.trace import Trace
from dxlrun_lab.guided.choice import require_own_servos
from dxlrun_lab.guided.experiment import ExperimentJoint, Procedure, Situation
from dxlrun_lab.guided.segment import Segment, SegmentRecording
from dxlwire import find_table

Measurement = Literal["rate", "response", "speed", "dead_band", "gap"]
MEASUREMENTS: Final[tuple[Measurement, ...]] = get_args(Measurement)
TOLERANCE: Final = math.radians(1.0)

_EASED_S: Final = 1.2
"""Rest at the start of a controller's first segment, s. The gate limits speeds for one second after a
controller was loaded."""
_REST_S: Final = 0.3
_FASTEST_SAMPLING: Final = 480.0
_SAMPLING: Final = 240.0
_SLOW_SAMPLING: Final = 60.0
"""Loop rates for the measurement of speeds, gaps and dead band, Hz, in this order. They are lower if the
joint's highest rate is lower."""
_OF_HIGHEST: Final = 0.8
_STEP: Final = math.radians(8.0)
_STEP_HOLD_S: Final = 0.5
_STEP_SEGMENTS: Final = 12
_FEW_RATES: Final = 4
_SLOWEST_STEPS: Final = 0.75
_STEP_RATES: Final = (30.0, 100.0)
_MOVES: Final = 6
_OVERSHOOTS: Final = 2.0
"""Assumed ratio of the overshoot of a long move to that of a short move"""
_LONGEST_HOLD_S: Final = 20.0
_BAND_REACH: Final = math.radians(3.0)
_BAND_PLACES: Final = (0.31, 0.5, 0.72)
_LONGEST_GAP_S: Final = 0.5
_GAP_SPEED: Final = 0.7
"""Peak speed of the motion with gaps, as a fraction of the joint's highest speed"""
_BURST_CYCLES, _RATE_S, _MOST_RATE_CYCLES = 6, 2.0, 1000
Part = Generator[Segment, SegmentRecording, None]


@dataclass(slots=True)
class JointCharacteristics:
    """Result of one joint: figures, and the data of their plots as far as they were measured"""

    joint: ExperimentJoint
    figures: list[JointFigure] = field(default_factory=list)
    rates: list[rates.RateResult] = field(default_factory=list)
    steps: list[response.StepResponse] = field(default_factory=list)
    moves: list[response.StepResponse] = field(default_factory=list)
    gaps: dict[str, list[gaps.GapResult]] = field(default_factory=dict)
    """Tried gaps between commands, by command interface"""
    band: Trace | None = None
    """Last recording of the dead band measurement, with the slow approaches"""

    def value(self, name: str) -> float | None:
        """Return the value of the figure with this name, or None if it was not measured."""
        return next((one.value for one in self.figures if one.name == name), None)


class CharacterizationResult(msgspec.Struct, frozen=True):
    """Result of `dxlrun characterize`: figures of all joints, also after an early end"""

    robot: str
    joints: tuple[JointCharacteristics, ...]
    why: str
    """Reason for an early end, one sentence; empty on success"""
    tolerance: float
    """Largest deviation from the path during a gap, rad"""


class CharacterizationExperiment:
    """Experiment (see guided.experiment.Experiment) that measures one joint at a time; all others hold.

    `tolerance` is the largest deviation from a path during a gap between commands, rad.
    """

    def __init__(
        self, measurements: Sequence[Measurement] = MEASUREMENTS, tolerance: float = TOLERANCE
    ) -> None:
        self._measurements = [one for one in MEASUREMENTS if one in measurements]
        self._tolerance = tolerance
        self._found: dict[str, JointCharacteristics] = {}
        self._eased: set[str] = set()

    def describe_motions(self, situation: Situation) -> Sequence[str]:
        """Describe measurements, speed and range of each joint, one sentence each.

        Raises InputError for a joint that is linear or has several servos.
        """
        require_own_servos(situation.plan, situation.names, "characterize", gears=True)
        return [
            f"{joint.name}: {', '.join(self._measurements)}; up to "
            f"{math.degrees(joint.plan.highest_speed):.0f} deg/s, "
            f"from {math.degrees(joint.inner[0]):.0f} to {math.degrees(joint.inner[1]):.0f} deg"
            for joint in situation.joints
        ]

    def procedure(self, situation: Situation) -> Procedure:
        """Yield the segments of all measurements of each joint, and evaluate their recordings.

        A measurement that the run refuses has that reason in its figures.
        """
        parts = {
            "rate": self._rate,
            "response": self._response,
            "speed": self._speed,
            "dead_band": self._dead_band,
            "gap": self._gap,
        }
        for joint in situation.joints:
            found = self._found[joint.name] = JointCharacteristics(joint)
            for measurement in self._measurements:
                try:
                    yield from parts[measurement](situation, joint, found)
                except Refused as refusal:
                    found.figures += [
                        not_measured(name, unit, f"the run refused the measurement: {refusal}")
                        for name, unit in _FIGURES[measurement]
                        if found.value(name) is None
                    ]

    def evaluate_recordings(
        self, situation: Situation, recorded: Sequence[SegmentRecording], why: str
    ) -> CharacterizationResult:
        """Return the results of all joints. Each figure that was not measured has the reason `why`."""
        reason = f"the experiment ended early: {why}" if why else "nothing was recorded"
        for joint in situation.joints:
            found = self._found.setdefault(joint.name, JointCharacteristics(joint))
            known = {one.name for one in found.figures}
            if found.rates and rates.NAME not in known:
                figure = rates.highest_rate(found.rates, situation.plan, joint.plan.label)
                found.figures.append(
                    msgspec.structs.replace(figure, limit=f"above it, {why}") if figure.value else figure
                )
                known.add(rates.NAME)
            if found.steps and response.ONSET not in known:
                found.figures += response.response(found.steps)
                known |= {response.ONSET, response.RISE}
            found.figures += [
                not_measured(name, unit, reason)
                for measurement in self._measurements
                for name, unit in _FIGURES[measurement]
                if name not in known
            ]
        return CharacterizationResult(situation.plan.robot, tuple(self._found.values()), why, self._tolerance)

    # Rates of the loop

    def _sampling(self, situation: Situation, found: JointCharacteristics, wanted: float) -> float:
        """Return a measurement's loop rate, Hz: `wanted`, or less if the joint's highest rate is low."""
        kept = found.value(rates.NAME) or rates.highest_by_bus(situation.plan)
        lowest = 1e9 / situation.plan.loop.slowest_period_ns if situation.plan.loop.slowest_period_ns else 0.0
        return rates.fitting(max(min(wanted, _OF_HIGHEST * kept), lowest), rates.rate_step(situation.plan))

    def _lead(self, interface: str = "position") -> float:
        """Return the rest at the start of a segment, s: longer for the first segment of a command interface,
        because the gate then limits speeds."""
        if interface in self._eased:
            return _REST_S
        self._eased.add(interface)
        return _EASED_S

    # Measurements

    def _rate(self, situation: Situation, joint: ExperimentJoint, found: JointCharacteristics) -> Part:
        """Measure the highest rate: toggle the goal by one tick in each cycle, at increasing loop rates."""
        column, label = situation.names.index(joint.name), joint.plan.label
        step, tick = rates.rate_step(situation.plan), joint.servo.position_per_tick
        highest = min(rates.highest_by_bus(situation.plan), rates.MOST_HZ)
        while (rate := rates.following(found.rates, situation.rate, highest, step)) is not None:
            burst = max(_BURST_CYCLES, round(rates.BURST_S * rate))
            whole = max(burst, min(_MOST_RATE_CYCLES, round(_RATE_S * rate)))
            parts: list[SegmentRecording] = []
            tried = rates.refused(rate, "")
            try:
                for cycles in (burst, whole):
                    rows = joint.middle + tick * (np.arange(cycles) % 2).astype(np.float64)
                    title = f"{joint.name}: {rate:.4g} Hz"
                    parts.append((yield Segment(title, 1 / rate, {joint.name: rows}, loop_rate=rate)))
                    tried = rates.judge_rate(rate, parts, column)
                    if tried.fault:
                        break
            except Refused as refusal:
                tried = rates.refused(rate, str(refusal))
            found.rates = sorted([*found.rates, tried], key=lambda one: one.rate)
        found.figures.append(rates.highest_rate(found.rates, situation.plan, label))

    def _response(self, situation: Situation, joint: ExperimentJoint, found: JointCharacteristics) -> Part:
        """Measure response times by small steps up and down at several loop rates, one packet per step."""
        low, high = joint.inner
        speed = joint.plan.highest_speed
        size = min(_STEP, (high - low) / 2)
        loop_rates = self._step_rates(situation, found, speed / size)
        size = min(size, 0.98 * speed / max(loop_rates))
        levels = joint.middle + size * np.array([-1, 0, 1, 0, -1, 0])
        for number in range(_STEP_SEGMENTS):
            rate = loop_rates[number % len(loop_rates)]
            lead, hold = self._lead(), math.ceil(_STEP_HOLD_S * rate)
            first = math.ceil(max(lead, _STEP_HOLD_S) * rate)
            rows = np.concatenate(
                [np.full(first, levels[0]), *(np.full(hold, level) for level in levels[1:])]
            )
            segment = Segment(
                f"{joint.name}: 5 steps of {math.degrees(size):.2g} deg at {rate:.4g} Hz",
                1 / rate,
                {joint.name: rows},
                loop_rate=rate,
            )
            found.steps += response.steps_of(self._trace(situation, joint, (yield segment)))
        found.figures += response.response(found.steps)

    def _step_rates(self, situation: Situation, found: JointCharacteristics, wanted: float) -> list[float]:
        """Return the loop rates of the steps, Hz, as many as controllers with rates of their own allow."""
        lowest, highest = _STEP_RATES
        fastest = self._sampling(situation, found, min(max(wanted, lowest), highest))
        step = rates.rate_step(situation.plan)
        between = np.linspace(_SLOWEST_STEPS, 1.0, _STEP_SEGMENTS) * fastest
        found_rates = list(dict.fromkeys(rates.fitting(float(one), step) for one in between))
        if len(found_rates) < _FEW_RATES:
            most = self._sampling(situation, found, 1.5 * highest)
            multiples = (float(number * step) for number in range(1, math.ceil(most / step) + 1))
            found_rates = [one for one in multiples if lowest <= one <= most] or found_rates
        return found_rates

    def _speed(self, situation: Situation, joint: ExperimentJoint, found: JointCharacteristics) -> Part:
        """Measure speed and acceleration by moves from end to end of the range at full speed."""
        low, high = joint.inner
        rate = self._sampling(situation, found, _FASTEST_SAMPLING)
        speed = joint.plan.highest_speed
        hold = 2 * (high - low) / speed + 0.8
        # An X series servo only has a profile with a speed above 0 (e-Manual, Profile Velocity (112): 0 is a
        # step).
        profiled = bool(joint.servo.declared.get("profile_acceleration"))
        interface: Literal["position", "posvel"] = "posvel" if profiled else "position"
        moves: list[response.StepResponse] = []
        count, sixth = 2, (high - low) / 6
        ends = joint.middle - sixth, joint.middle + sixth
        farthest = 0.0
        while hold <= _LONGEST_HOLD_S and len(moves) < _MOVES:
            levels = [ends[0], *([ends[1], ends[0]] * (count // 2))]
            first = math.ceil(self._lead(interface) / hold)
            rows = np.array([ends[0]] * first + levels[1:], dtype=np.float64)
            title = f"{joint.name}: {count} moves of {math.degrees(ends[1] - ends[0]):.3g} deg"
            speeds_of = {joint.name: np.full(len(rows), speed)} if interface == "posvel" else {}
            segment = Segment(title, hold, {joint.name: rows}, interface, speeds_of, loop_rate=rate)
            new = response.steps_of(self._trace(situation, joint, (yield segment)))
            there = [move for move in new if move.reached > _THERE * move.height]
            if not there:
                before, farthest = farthest, max((float(np.max(move.way)) for move in new), default=0.0)
                if farthest < _BEGUN * (ends[1] - ends[0]) or 2 * hold > _LONGEST_HOLD_S:
                    moves += new
                    break
                if farthest > before + _THERE_TICKS * joint.servo.position_per_tick:
                    hold *= 2  # still moving
                    continue
                there = new  # it rests short of its goal
            if len(moves) == 0 and ends[1] - ends[0] < (high - low) / 2:
                # Keep a distance to the ends of the range, according to the overshoot of a short move.
                beyond = max(float(np.max(move.way)) - move.height for move in there)
                over = _OVERSHOOTS * max(joint.servo.position_per_tick, beyond)
                if high - low - 2 * over > (high - low) / 2:
                    ends, farthest = (low + over, high - over), 0.0
                    continue
            moves += new
            count = _MOVES - len(moves)
        found.moves = moves
        found.figures += speeds.speeds(moves, joint.upper - joint.lower, speed)

    def _dead_band(self, situation: Situation, joint: ExperimentJoint, found: JointCharacteristics) -> Part:
        """Measure the dead band: approach three places slowly from both sides, from a distance that grows."""
        low, high = joint.inner
        rate = self._sampling(situation, found, _SLOW_SAMPLING)
        reach, most = _BAND_REACH, (high - low) / 2
        while True:
            reach = min(reach, most)
            inner_low, inner_high = low + reach, high - reach
            places = [inner_low + part * (inner_high - inner_low) for part in _BAND_PLACES]
            rows, _ = dead_band.table(dead_band.stops(places, reach), 1 / rate)
            title = f"{joint.name}: stops from both sides, within {math.degrees(reach):.2g} deg"
            recorded = yield Segment(title, 1 / rate, {joint.name: rows}, loop_rate=rate)
            trace = self._trace(situation, joint, recorded)
            rests = dead_band.approaches(trace)
            turned = [one for one in rests if math.isfinite(one.reversal)]
            found.band = trace
            if len(turned) >= len(places) or reach >= most:
                break
            reach *= 3
        found.figures += dead_band.dead_band(
            rests, joint.servo.position_per_tick, _margins(situation, joint), joint.servo.position_per_tick
        )

    def _gap(self, situation: Situation, joint: ExperimentJoint, found: JointCharacteristics) -> Part:
        """Measure the longest gap: send a smooth motion with growing gaps, by position and by posvel."""
        low, high = joint.inner
        rate = self._sampling(situation, found, _SAMPLING)
        size = min((high - low) / 2 / gaps.LARGEST, _GAP_SPEED * joint.plan.highest_speed / gaps.FASTEST)
        interfaces: tuple[Literal["position", "posvel"], ...] = ("position", "posvel")
        for interface in interfaces:
            recorded = yield self._motion(joint, interface, 1 / rate, rate, size)
            reference = self._since_motion(situation, joint, recorded, 1 / rate)
            tried: list[gaps.GapResult] = []
            least = 1 / rate
            while gap := gaps.following(tried, least, _LONGEST_GAP_S, least, self._tolerance):
                recorded = yield self._motion(joint, interface, gap, rate, size)
                trace = self._since_motion(situation, joint, recorded, gap)
                tried.append(gaps.judge_gap(gap, trace, reference, size))
            found.gaps[interface] = sorted(tried, key=lambda one: one.gap_s)
            found.figures.append(
                gaps.longest_gap(
                    found.gaps[interface],
                    interface,
                    self._tolerance,
                    1 / rate,
                    size * gaps.FASTEST,
                    tick=joint.servo.position_per_tick,
                )
            )

    def _motion(
        self,
        joint: ExperimentJoint,
        interface: Literal["position", "posvel"],
        gap: float,
        rate: float,
        size: float,
    ) -> Segment:
        """Return the segment that sends the smooth motion with `gap` seconds between commands. The motion
        starts after `_lead_of` gaps; `size` is that of `gaps.motion`, `rate` the loop rate, Hz."""
        lead = _lead_of(gap)
        time = np.arange(lead + math.ceil((gaps.MOTION_S + gaps.FADE_S) / gap)) * gap - lead * gap
        position, _ = gaps.motion(np.maximum(time, 0.0), size)
        rows = {joint.name: joint.middle + position}
        title = f"{joint.name}: a motion with commands every {gap * 1e3:.1f} ms, {interface}"
        speeds_of: Mapping[str, Floats] = {}
        if interface == "posvel":
            # Mean speed from the previous sample to this one.
            speeds_of = {joint.name: np.abs(np.diff(position, prepend=position[:1])) / gap}
        return Segment(title, gap, rows, interface, speeds_of, settle_s=_REST_S, loop_rate=rate)

    def _since_motion(
        self, situation: Situation, joint: ExperimentJoint, recorded: SegmentRecording, gap: float
    ) -> Trace:
        trace = self._trace(situation, joint, recorded)
        start = _lead_of(gap) * gap
        part = trace.time - start
        moving = (part >= 0) & (part <= gaps.MOTION_S + gaps.FADE_S)
        return Trace(
            part[moving],
            trace.position[moving] - joint.middle,
            trace.sent[moving] - start,
            trace.goal[moving] - joint.middle,
            trace.tick,
        )

    def _trace(self, situation: Situation, joint: ExperimentJoint, recorded: SegmentRecording) -> Trace:
        return Trace.from_recording(recorded, joint, situation.plan.buses)


_THERE: Final = 0.9
_THERE_TICKS: Final = 2
"""Progress in twice the time below which a joint counts as at rest, ticks"""
_BEGUN: Final = 0.1
"""Fractions of the way after which a joint counts as arrived (`_THERE`) and as started (`_BEGUN`)"""

_FIGURES: Final[Mapping[Measurement, Sequence[tuple[str, str]]]] = {
    "rate": ((rates.NAME, "Hz"),),
    "response": ((response.ONSET, "s"), (response.RISE, "s")),
    "speed": ((speeds.TOP, "rad/s"), (speeds.ACCELERATION, "rad/s^2"), (speeds.BRAKING, "rad/s^2")),
    "dead_band": ((dead_band.NAME, "rad"), (dead_band.REVERSAL, "rad")),
    "gap": (("longest gap, position", "s"), ("longest gap, posvel", "s")),
}


def _lead_of(gap: float) -> int:
    """Return the number of gaps (s each) for which the joint rests before a motion starts."""
    return math.ceil(_EASED_S / gap)


def _margins(situation: Situation, joint: ExperimentJoint) -> Mapping[str, int]:
    """Return the servo's compliance margins by register name, ticks: declared, or else factory default. A
    model without these registers has none."""
    protocol = next(bus.protocol for bus in situation.plan.buses if joint.servo in bus.servos)
    table = find_table(joint.servo.model, protocol)
    shipped = {name: table.items[name].initial or 0 for name in dead_band.MARGINS if name in table.items}
    return {name: joint.servo.declared.get(name, value) for name, value in shipped.items()}
