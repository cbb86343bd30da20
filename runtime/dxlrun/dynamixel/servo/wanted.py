"""Wanted: what the servos of one bus shall do and be, also after one of them was away."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dxlrun.dynamixel.exchange.gaps import Gaps
from dxlrun.dynamixel.exchange.goal_arrays import GoalArrays
from dxlrun.dynamixel.plan.bus_plan import BusPlan
from dxlrun.dynamixel.registers.mode_changes import ModeChanges
from dxlrun.dynamixel.registers.steered_registers import SteeredRegisters
from dxlrun.run.channels.events import EventSink


@dataclass(frozen=True, slots=True)
class Wanted:
    """Goals, modes and registers of the servos of one bus."""

    goals: GoalArrays
    modes: ModeChanges
    registers: SteeredRegisters

    @classmethod
    def of(cls, plan: BusPlan, gaps: Gaps, mode: NDArray[np.uint8], events: EventSink) -> Wanted:
        """Begin with what the plan says; `mode` is the robot's array of the modes in which the joints are."""
        goals = GoalArrays(plan)
        return cls(goals, ModeChanges(plan, gaps, goals, mode, events), SteeredRegisters(plan, gaps, events))
