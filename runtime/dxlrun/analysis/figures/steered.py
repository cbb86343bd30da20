"""Marks on the time axis of a figure: when the loop was paused, and when it was steered otherwise."""

from __future__ import annotations

from dataclasses import dataclass

from matplotlib.axes import Axes

from dxlrun.analysis.figures.drawing import MUTED, PURPLE
from dxlrun.analysis.steering import Pause, Steering
from dxlrun.log.reader import Log

_FEW = 60
"""More lines would bury the curves."""
_MARKED = ("switch", "rate", "load", "unload", "policy")


@dataclass(frozen=True, slots=True)
class SteeringMarks:
    """When a run was steered, s since the loop's first deadline."""

    times: tuple[float, ...]
    """Of switches, changes of the rate, loaded and unloaded controllers, and of a policy's beginning."""
    pauses: tuple[Pause, ...]

    @classmethod
    def of(cls, log: Log) -> SteeringMarks:
        """Return the marks of a log; of very many changes none."""
        steering = Steering()
        steering.take(log)
        acts, pauses = steering.finish()
        times = tuple(act.time_s for act in acts if act.kind in _MARKED and not act.refusal)
        return cls(times if len(times) <= _FEW else (), pauses)

    def draw(self, axes: Axes) -> None:
        """Shade the pauses, and draw a dotted line where something was changed."""
        for pause in self.pauses:
            axes.axvspan(pause.begin_s, pause.end_s, color=MUTED, alpha=0.15, linewidth=0)
        for time in self.times:
            axes.axvline(time, color=PURPLE, linewidth=0.8, linestyle=":")

    @property
    def said(self) -> str:
        """The sentence that says what the marks are; empty where there are none."""
        parts = ["Shaded: the loop was paused."] if self.pauses else []
        parts += ["Dotted lines: it was steered otherwise."] if self.times else []
        return " ".join(parts)
