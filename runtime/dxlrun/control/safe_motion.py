"""Safe motion: execute the steps of an exit policy (poses, less torque) cycle by cycle, through the gate.

All times are those of the cycles, so a replay gives the same result.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dxlrun.channels.cycle import LIMP, CycleRecord, Floats
from dxlrun.control.context import ControlContext
from dxlrun.plan.loop_plan import JointPlan
from dxlrun.plan.policy_plan import SETTLE_NS, Policy, PolicyStepPlan
from dxlwire.joint_unit import LINEAR, ROTARY, JointUnit
from dxlwire.modes import Mode

ARRIVED: Mapping[JointUnit, float] = {ROTARY: 0.05, LINEAR: 0.002}
"""Distance within which a joint counts as arrived at a pose, rad or m: ten ticks of an AX-12. Friction stops
it some ticks short of its goal."""
MODES_NS = 500_000_000
"""Longest wait for mode changes before the steps, within the policy's time limit. They take some twenty
transactions a servo. [i]"""
STAND_NS = 100_000_000
"""Shortest time for which a pose, or a goal of 0 rad/s for joints that keep their torque, is sent. A write
may be lost, and a servo that missed a reply gets its goal a cycle later."""


@dataclass(slots=True)
class SafeMotion:
    """Execution of an exit policy. It is `over` after the last step or the policy's time limit.

    Joints that would not hold still, and joints that a pose moves, change their modes first. Joints in
    velocity mode stop in the first cycle, or as fast as their acceleration limit permits.

    Step with a pose: goals move toward it at the step's speed, within acceleration limits. The step ends
    STAND_NS after the goals have arrived if the joints have arrived too, otherwise SETTLE_NS after the goals.

    Step with less torque: the torque limit decreases in `levels` steps within the step's time. It goes from
    the servos' own limit down to the share `fraction`.
    """

    policy: Policy
    context: ControlContext
    stand_ns: int = 0
    """Shortest time before the first step, in which registers of the servos are restored."""
    record: CycleRecord = field(init=False)
    joints: tuple[JointPlan, ...] = field(init=False)
    over: bool = field(default=False, init=False)
    unfinished: str = field(default="", init=False)
    """Step that ended early, or pose that was not reached, with the reason; empty if all steps were
    completed.
    """
    _index: int = field(default=0, init=False)
    _began_ns: int = field(default=-1, init=False)
    _step_ns: int = field(default=0, init=False)
    _there_ns: int = field(default=-1, init=False)
    _level: int = field(default=0, init=False)
    _modes: NDArray[np.uint8] = field(init=False)
    """Mode that each joint must enter before the first step; UNKNOWN: it keeps its mode."""
    _wait_ns: int = field(default=0, init=False)
    """Longest wait for mode changes and for joints to stop, before the first step."""
    _stand_ns: int = field(init=False)
    """Time that joints get to stop before the first step."""
    _reach: Floats = field(init=False)
    """Longest lead of a position command over its goal, as a multiple of the step's travel in a cycle."""
    _speeds: list[Floats] = field(init=False)
    """Speed of each joint toward its pose, for each step of the policy, rad/s or m/s."""
    _arrived: Floats = field(init=False)
    """Distance within which each joint counts as arrived at its pose, rad or m."""

    def __post_init__(self) -> None:
        self.record, self.joints = self.context.record, self.context.plan.joints
        limit_ns = self.context.plan.policies.limit_ns
        now = self.record.states.mode.tolist()
        self._modes = np.array(
            [self._needed(row, Mode(mode)) for row, mode in enumerate(now)], dtype=np.uint8
        )
        stops_s = [0.0 if j.acceleration is None else j.highest_speed / j.acceleration for j in self.joints]
        holds = self.policy.last == "hold"
        self._stand_ns = STAND_NS + round(min(max(stops_s) * 1e9, limit_ns) if holds else 0)
        standing_ns = self._stand_ns if holds and (Mode.VELOCITY in now or max(stops_s) > 0) else 0
        if self.stand_ns:
            self._stand_ns = standing_ns = max(self._stand_ns, min(self.stand_ns, limit_ns))
        self._wait_ns = max(MODES_NS if self._modes.any() else 0, standing_ns)
        # A joint with an acceleration limit must know its final target to brake in time.
        self._reach = np.array([1.0 if joint.acceleration is None else np.inf for joint in self.joints])
        self._speeds = [
            np.array([step.speed_of(joint.unit) for joint in self.joints]) for step in self.policy.steps
        ]
        self._arrived = np.array([ARRIVED[joint.unit] for joint in self.joints])
        self.over = not self.policy.steps and not self._wait_ns

    def request_modes(self) -> None:
        """Request the modes that the steps need, in the first cycle only.

        Called before the states are read.
        """
        if self._began_ns < 0 and self._modes.any():
            self.context.hardware.set_modes(self._modes)

    def command(self) -> None:
        """Write this cycle's commands for the current step into the record; all NaN after the last step."""
        record = self.record
        now_ns = record.woken_ns
        record.commands.clear()
        if self._began_ns < 0:
            self._began_ns = self._step_ns = now_ns
        if now_ns - self._began_ns >= self.context.plan.policies.limit_ns:
            self.give_up("its time limit has passed")
        if self._changing(now_ns):
            return
        while not self.over and self._ended(self.policy.steps[self._index], now_ns):
            self._index += 1
            self._step_ns, self._there_ns, self._level = now_ns, -1, 0
            self.over = self._index == len(self.policy.steps)

    def give_up(self, why: str) -> None:
        """End the policy before its steps are complete, and name step and reason in `unfinished`."""
        if not self.over:
            self.over = True
            step = self.policy.steps[self._index].text if self.policy.steps else "the change of modes"
            self.unfinished = f"{step} ends early: {why}"

    def _needed(self, row: int, mode: Mode) -> Mode:
        """Return the mode that a joint in `mode` must enter before the steps; UNKNOWN: it keeps its mode."""
        if self.policy.last == "limp" and not self.policy.steps:
            return Mode.UNKNOWN
        if any(step.targets and step.targets[row] is not None for step in self.policy.steps):
            return Mode.UNKNOWN if mode == Mode.POSITION else Mode.POSITION
        return Mode.UNKNOWN if mode in {Mode.POSITION, Mode.VELOCITY} else self.joints[row].rest_mode

    def _changing(self, now_ns: int) -> bool:
        """Return whether the steps must still wait for mode changes.

        They begin after the timeout in any case.
        """
        if not self._wait_ns:
            return False
        away = (self._modes != Mode.UNKNOWN) & (self._modes != self.record.states.mode)
        if now_ns - self._began_ns < (self._wait_ns if away.any() else self._stand_ns):
            return True
        self._wait_ns = 0
        self._step_ns = now_ns
        self.over = self.over or not self.policy.steps
        return self.over

    def _ended(self, step: PolicyStepPlan, now_ns: int) -> bool:
        return self._reached(step, now_ns) if step.targets else self._weakened(step, now_ns)

    def _reached(self, step: PolicyStepPlan, now_ns: int) -> bool:
        record = self.record
        goal, commands = record.goals.position, record.commands
        target: Floats = np.array([np.nan if one is None else one for one in step.targets])
        # The goal of a limp joint follows its measured position, so it never arrives at the pose.
        posed = np.isfinite(target)
        named = posed & ~np.isin(record.states.torque, LIMP)
        if not np.any(named & (np.abs(target - goal) > 1e-9)):
            self._there_ns = now_ns if self._there_ns < 0 else self._there_ns
            states = record.states
            away = named & ~(states.valid & (np.abs(target - states.position) <= self._arrived))
            lasted_ns = now_ns - self._there_ns
            over = lasted_ns >= SETTLE_NS or (lasted_ns >= STAND_NS and not away.any())
            if over:
                self._judge(step, np.flatnonzero(posed).tolist(), target, away)
            return over
        speed = self._speeds[self._index]
        reach = self._reach * (speed * max(record.period_ns, 1) * 1e-9)
        np.copyto(commands.position, goal + np.clip(target - goal, -reach, reach), where=named)
        commands.velocity[named] = speed[named]
        return False

    def _judge(self, step: PolicyStepPlan, posed: list[int], target: Floats, away: NDArray[np.bool_]) -> None:
        """Store in `unfinished` which joint did not reach its pose, and why. The worst joint is named."""
        states = self.record.states
        found = states.unable(posed) or states.doubtful(np.flatnonzero(away).tolist())
        if found is None and away.any():
            row = int(np.where(away, np.abs(target - states.position), 0.0).argmax())
            off = abs(target.item(row) - states.position.item(row))
            found = row, f"is {off:.3g} {self.joints[row].unit.si} off"
        if found is not None:
            row, why = found
            self.unfinished = (
                self.unfinished or f"{step.text} is not reached: joint {self.joints[row].name} {why}"
            )

    def _weakened(self, step: PolicyStepPlan, now_ns: int) -> bool:
        passed_ns = now_ns - self._step_ns
        level = min(step.levels, 1 + passed_ns * step.levels // max(step.longest_ns, 1))
        if level != self._level:
            self._level = level
            self.context.hardware.limit_torque(1.0 - (1.0 - step.fraction) * level / step.levels)
        return passed_ns >= step.longest_ns
