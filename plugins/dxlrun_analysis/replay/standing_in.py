"""Standing in: what a controller commanded in the run, in place of one whose state is not known."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dxlrun.contract.controller import Context, Controller, Goal, Interfaces
from dxlrun.description.form import ParametersModel
from dxlrun.plan.loop_plan import ControllerPlan, LoopPlan


class RecordedController(Controller[ParametersModel]):
    """Commands what the log has for the cycle; takes commands and goals without doing anything."""

    def __init__(
        self, plan: ControllerPlan, loop: LoopPlan, replaced: Controller[Any], row: Callable[[], np.void]
    ) -> None:
        """`row` returns the cycle that is replayed."""
        super().__init__(replaced.parameters)
        self.Goals = replaced.Goals  # type: ignore[misc]  # the manager asks the object
        self.context: Context = replaced.context
        self._row = row
        layout = loop.layout
        self._source = layout.sources.index(plan.name) if plan.provides else -1
        self._provided = layout.source_slice(plan.name)
        commands = [layout.device_commands.index(name) for name in plan.device_commands]
        self._device_commands = np.array(commands, np.intp)
        bits = {one.name: bit for bit, one in enumerate(loop.controllers)}
        self._takeovers = [(name, bits[name]) for name in plan.takeovers if name in bits]
        joints = [joint.name for joint in loop.joints]
        self._places: list[tuple[str, NDArray[np.intp], str]] = []
        for interface in plan.command:
            if plan.into:
                names = [
                    next(
                        name
                        for lower in plan.into
                        if (name := f"{lower}/{joint}/{interface}") in loop.references
                    )
                    for joint in plan.joints
                ]
                place = np.array([loop.references.index(name) for name in names], np.intp)
                self._places.append(("reference", place, interface))
            else:
                place = np.array([joints.index(joint) for joint in plan.joints], np.intp)
                self._places.append((f"command_{interface}", place, interface))

    @classmethod
    def interfaces(cls, parameters: ParametersModel, joints: tuple[str, ...]) -> Interfaces:
        """Return none: it stands in for a controller that has claimed its own."""
        return Interfaces(())

    def on_goal(self, goal: Goal, data: NDArray[np.float64], time_ns: int) -> None:
        """Take a goal, which does not end here."""

    def on_command(self, kind: str, data: NDArray[np.float64], time_ns: int) -> None:
        """Take a command."""

    def on_cancel(self, goal: Goal, time_ns: int) -> None:
        """Take the request."""

    def update(self, time_ns: int, period_ns: int) -> None:
        """Command what was commanded."""
        row = self._row()
        if self._source >= 0:
            values = row["source_state"][self._provided]
            new = row["source_valid"][self._source] or np.isnan(values).any()
            self.context.provided[:] = values if new else np.nan  # all NaN: nothing new
        self.context.device_commands[:] = row["device_command"][self._device_commands]
        active = int(row["active"])
        if entered := [name for name, bit in self._takeovers if active >> bit & 1]:
            self.context.take_over(entered, "as in the run")
        for field, place, interface in self._places:
            getattr(self.context.commands, interface)[:] = row[field][place]
