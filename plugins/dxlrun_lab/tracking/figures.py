"""Figures of the tracking experiment, one per set-up with equal axes, as Figures 31 to 34 of the thesis.

The upper part shows the whole motion: desired, sent and measured position, and the lateness of each cycle.
The lower part shows position and velocity in the first five seconds (Figure 31) and around the latest cycle
(Figures 32 to 34).
"""

from __future__ import annotations

from collections.abc import Sequence
from xml.etree.ElementTree import Element

import msgspec
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter

from dxlrun import Floats
from dxlrun.tooling.output import counted, microseconds
from dxlrun_lab.figures.drawing import (
    BLUE,
    DASHED,
    ERROR,
    GREEN,
    MUTED,
    ORANGE,
    draw_figure,
    reduced,
)
from dxlrun_lab.tracking.desired_motion import DesiredMotion
from dxlrun_lab.tracking.motion_evaluation import LATE_NS, MotionCurves, SetupResult

_BEGIN_S = 5.0
_AROUND_S = 0.25
"""Time shown before and after the latest cycle, s"""
_LEAST_US = 1.0
_DESIRED: dict[str, object] = {"color": GREEN, "linewidth": 2.8, "alpha": 0.55}
_SENT: dict[str, object] = {"color": ORANGE, "linewidth": 1.2}
_READ: dict[str, object] = {"color": BLUE, "linewidth": 1.1}


class _Axes(msgspec.Struct, frozen=True):
    end_s: float
    position: tuple[float, float]
    velocity: tuple[float, float]
    late_us: float

    @classmethod
    def from_measured(cls, measured: Sequence[SetupResult], motion: DesiredMotion) -> _Axes:
        """Return ranges of the axes into which the curves of all set-ups fit."""
        curves = [one.curves for one in measured]
        return cls(
            max(float(one.woken_s[-1]) for one in curves),
            _span(
                [
                    np.array(motion.positions),
                    *(one.sent for one in curves),
                    *(one.read for one in curves),
                ]
            ),
            _span([np.array(motion.velocities), *(one.velocity for one in curves)]),
            max(2 * LATE_NS / 1e3, 2 * max(float(one.late_us.max()) for one in curves)),
        )


def _span(arrays: Sequence[Floats]) -> tuple[float, float]:
    low = min(float(np.nanmin(one, initial=0.0)) for one in arrays)
    high = max(float(np.nanmax(one, initial=0.0)) for one in arrays)
    margin = 0.06 * (high - low) or 1.0
    return low - margin, high + margin


def drawings(measured: Sequence[SetupResult], motion: DesiredMotion) -> tuple[Element, ...]:
    """Draw a figure for each of one or more set-ups, with equal axes. Needs matplotlib."""
    axes = _Axes.from_measured(measured, motion)
    return tuple(_SetupPlot(one, motion, axes).drawing() for one in measured)


class _SetupPlot(msgspec.Struct, frozen=True):
    """Figure of one set-up"""

    measured: SetupResult
    motion: DesiredMotion
    axes: _Axes

    def drawing(self) -> Element:
        """Draw the figure with title and caption."""
        tracked, curves = self.measured.tracked, self.measured.curves
        latest = (
            f"the worst {microseconds(float(curves.late_us[curves.worst]))} late, at "
            f"{float(curves.woken_s[curves.worst]):.2f} s"
        )
        late = f"{counted(tracked.late_cycles, 'late cycle', 'late cycles')} of {tracked.cycles}, {latest}"
        return draw_figure(
            tracked.setup,
            f"{tracked.title[0].upper()}{tracked.title[1:]}",
            "Position in rad (desired, sent, read), velocity in rad/s and lateness of "
            f"{self.motion.joint} over the time since the start of the motion, s: {late}.",
            f"{late}. Red: from the deadline of a late cycle to its start. Desired is the position of the "
            "motion at this time; sent is the last written goal. The thesis has "
            f"{tracked.thesis}.",
            7.4,
            self._fill,
        )

    def _fill(self, figure: Figure) -> None:
        grid = figure.add_gridspec(4, 2, height_ratios=[1.7, 1.0, 1.6, 1.3])
        whole = figure.add_subplot(grid[0, :])
        late = figure.add_subplot(grid[1, :], sharex=whole)
        self._position(whole, 0.0, self.axes.end_s)
        whole.set_title("whole motion", pad=16)
        whole.set_xlim(-0.01 * self.axes.end_s, 1.01 * self.axes.end_s)
        whole.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=3, borderaxespad=0.2)
        self._lateness(late)
        worst_s = float(self.measured.curves.woken_s[self.measured.curves.worst])
        begin = 0.0, min(_BEGIN_S, self.axes.end_s)
        around = worst_s - _AROUND_S, worst_s + _AROUND_S
        for column, (title, window) in enumerate(
            (("first seconds", begin), ("around the latest cycle", around))
        ):
            position = figure.add_subplot(grid[2, column])
            velocity = figure.add_subplot(grid[3, column], sharex=position)
            self._position(position, *window)
            position.set_title(title)
            self._velocity(velocity, *window)
            position.set_xlim(*window)
            velocity.set_xlabel("time since the motion began, s")
            for axes in (position, velocity):
                self._marks(axes, *window, extent=column == 1)

    def _position(self, axes: Axes, begin_s: float, end_s: float) -> None:
        curves = self.measured.curves
        times = np.linspace(max(begin_s, 0.0), end_s, 1500)
        axes.plot(times, self.motion.at(times)[0], label="desired", **_DESIRED)  # type: ignore[arg-type]  # one dictionary for all keys
        self._series(axes, curves.sent_s, curves.sent, (begin_s, end_s), "sent", _SENT)
        self._series(axes, curves.read_s, curves.read, (begin_s, end_s), "read", _READ)
        axes.set_ylim(*self.axes.position)
        axes.set_ylabel("position, rad")

    def _velocity(self, axes: Axes, begin_s: float, end_s: float) -> None:
        curves = self.measured.curves
        times = np.linspace(max(begin_s, 0.0), end_s, 1500)
        axes.plot(times, self.motion.at(times)[1], **_DESIRED)  # type: ignore[arg-type]  # as above
        self._series(axes, curves.read_s, curves.velocity, (begin_s, end_s), "read", _READ)
        axes.set_ylim(*self.axes.velocity)
        axes.set_ylabel("velocity, rad/s")

    @staticmethod
    def _series(  # noqa: PLR0917  one line of a plot
        axes: Axes, x: Floats, y: Floats, window: tuple[float, float], name: str, style: dict[str, object]
    ) -> None:
        """Draw the samples with x in a window (s). The series named "sent" is drawn as steps."""
        first, stop = np.searchsorted(x, window)
        first, stop = max(0, int(first) - 1), int(stop) + 1
        times, values = reduced(x[first:stop], y[first:stop])
        held = "steps-post" if name == "sent" and len(times) == len(x[first:stop]) else "default"
        axes.plot(times, values, label=name, drawstyle=held, **style)  # type: ignore[arg-type]  # one dictionary for all keys

    def _marks(self, axes: Axes, begin_s: float, end_s: float, *, extent: bool) -> None:
        """Mark late cycles in a window of time, s: from deadline to start, or by a tick without `extent`."""
        curves = self.measured.curves
        chosen = _late(curves) & (curves.woken_s >= begin_s) & (curves.due_s <= end_s)
        if extent:
            for due, woken in zip(curves.due_s[chosen], curves.woken_s[chosen], strict=True):
                axes.axvspan(due, woken, color=ERROR, alpha=0.25, linewidth=0)
        else:
            at = curves.woken_s[chosen]
            axes.vlines(at, 0, 0.06, color=ERROR, linewidth=0.6, transform=axes.get_xaxis_transform())

    def _lateness(self, axes: Axes) -> None:
        curves = self.measured.curves
        times, shown = reduced(curves.woken_s, np.maximum(curves.late_us, _LEAST_US))
        late = shown > LATE_NS / 1e3
        axes.plot(times, shown, ".", color=MUTED, markersize=2)
        axes.plot(times[late], shown[late], ".", color=ERROR, markersize=3)
        axes.set_yscale("log")
        axes.set_ylim(_LEAST_US / 1.5, self.axes.late_us)
        axes.yaxis.set_major_formatter(FuncFormatter(lambda us, _: microseconds(us)))
        axes.yaxis.set_minor_formatter(NullFormatter())
        axes.axhline(LATE_NS / 1e3, color=MUTED, linewidth=0.8, linestyle=DASHED)
        axes.set_ylabel("late by (dashed: 150 us)")
        axes.set_xlabel("time since the motion began, s")


def _late(curves: MotionCurves) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    return curves.late_us > LATE_NS / 1e3
