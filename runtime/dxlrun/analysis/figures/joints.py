"""One figure a joint: position as desired, sent and read, velocity, and the cycles to read with care."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from dxlrun.analysis.figures.drawing import (
    BLUE,
    ERROR,
    GREEN,
    INK,
    MUTED,
    ORANGE,
    PURPLE,
    WARNING,
    Caption,
    Columns,
    Drawing,
    JointMarks,
    SteeringMarks,
    draw,
    run_time_s,
    time_axis,
)
from dxlrun.analysis.joints.tracking import JointTracking, reachable
from dxlrun.log.reader import Log
from dxlrun.run.channels.cycle import Floats

_LEAST_RAD, _LEAST_RAD_S = 0.1, 0.5
_APART_RAD = 1e-6
_FEW = 60
"""So few samples are drawn with a dot each, so few skipped cycles with a line through the figure."""
_DESIRED: dict[str, object] = {"color": GREEN, "linewidth": 2.8, "alpha": 0.55}
_SENT: dict[str, object] = {"color": ORANGE, "linewidth": 1.3, "linestyle": (0, (4, 2))}
_REACHABLE: dict[str, object] = {"color": PURPLE, "linewidth": 0.9, "linestyle": (0, (1, 1.5))}
_READ: dict[str, object] = {"color": BLUE, "linewidth": 1.1}


def joint_drawings(log: Log, joints: tuple[JointTracking, ...]) -> tuple[Drawing, ...]:
    """Return a figure for each joint, in the order of the log; `log` has at least one cycle."""
    times, columns, steering = run_time_s(log), Columns(len(log.cycles)), SteeringMarks.of(log)
    return tuple(
        _JointPlot(log, row, joint, times, columns, JointMarks.of(log, row), steering).drawing()
        for row, joint in enumerate(joints)
    )


def _spread(axes: Axes, least: float) -> None:
    """Let the axis span at least so much: a joint at rest is a calm line, not the ticks of its servo."""
    low, high = axes.get_ylim()
    missing = (least - (high - low)) / 2
    if missing > 0:
        axes.set_ylim(low - missing, high + missing)


def _followed(joint: JointTracking) -> str:
    """Return lag, settling and error at rest in words, as far as they are known."""
    parts = []
    if joint.lag_ms is not None:
        parts.append(f", lag {joint.lag_ms:.0f} ms")
    if joint.settling_ms is not None:
        parts.append(f", settled after at most {joint.settling_ms:.0f} ms")
    if joint.rest_rad is not None:
        parts.append(f", at rest off by at most {joint.rest_rad:.4f} rad")
    return "".join(parts)


@dataclass(frozen=True, slots=True)
class _JointPlot:
    """The figure of one joint."""

    log: Log
    row: int
    joint: JointTracking
    times: Floats
    columns: Columns
    marks: JointMarks
    steering: SteeringMarks

    def drawing(self) -> Drawing:
        """Return the figure with title and caption."""
        joint = self.joint
        error = "No goal was sent, or no position was read."
        if joint.rms_rad is not None and joint.worst_rad is not None:
            error = (
                f"Error rms {joint.rms_rad:.4f} rad, worst {joint.worst_rad:.4f} rad (position minus what "
                f"was reachable){_followed(joint)}."
            )
        counts = ", ".join(f"{name} {np.count_nonzero(flags)}" for name, flags, _ in self._reasons())
        caption = Caption(
            f"joint-{self.row}",
            joint.name,
            "Position in rad (desired by the controller, sent to the servo, read) and velocity in rad/s of "
            f"{joint.name} over the time of the run in s. {error} Cycles: {counts}.",
            " ".join(
                f"{error} Cycles: {counts}. {self.columns.note('the smallest and the largest value')} "
                f"{self.steering.note}".split()
            ),
        )
        return draw(caption, 3.9, self._fill)

    def _reasons(self) -> tuple[tuple[str, NDArray[np.bool_], str], ...]:
        """Return the reasons to read a cycle with care: name, cycles, colour."""
        marks = self.marks
        return (
            ("late", marks.late, ORANGE),
            ("skipped", marks.skipped, ERROR),
            ("no reply", marks.silent, WARNING),
            ("clamped", marks.clamped, PURPLE),
        )

    def _fill(self, figure: Figure) -> None:
        position, velocity, strip = figure.subplots(
            3, 1, sharex=True, gridspec_kw={"height_ratios": [3.0, 1.9, 1.05]}
        )
        self._lines(position, "position")
        _spread(position, _LEAST_RAD)
        position.set_ylabel("position, rad")
        self._lines(velocity, "velocity")
        _spread(velocity, _LEAST_RAD_S)
        velocity.set_ylabel("velocity, rad/s")
        skipped = self.times[self.marks.skipped]
        for axes in (position, velocity):
            for time in skipped if len(skipped) <= _FEW else ():  # more would bury the curves
                axes.axvline(time, color=ERROR, linewidth=0.7, alpha=0.45)
            self.steering.draw(axes)
        self._strip(strip)
        time_axis(strip)

    def _lines(self, axes: Axes, what: str) -> None:
        """Draw the desired, sent and read values; a cycle without a reply interrupts the line."""
        cycles, row = self.log.cycles, self.row
        read = np.where(cycles["valid"][:, row], cycles[what][:, row], np.nan)
        series: tuple[tuple[str, Floats, dict[str, object]], ...] = (
            ("desired (command)", cycles[f"command_{what}"][:, row], _DESIRED),
            ("sent (goal)", cycles[f"goal_{what}"][:, row], _SENT),
            ("read", read, _READ),
        )
        marker = "." if len(self.times) <= _FEW else ""
        drawn = False
        if what == "position" and (way := self._detour()) is not None:
            series = (*series, ("reachable", way, _REACHABLE))
        for name, values, style in series:
            if np.isfinite(values).any():
                held = "steps-post" if self.columns.whole and name != "read" else "default"
                x, y = self.columns.envelope(self.times, np.where(np.isfinite(values), values, np.nan))
                axes.plot(x, y, label=name, drawstyle=held, marker=marker, markersize=4, **style)  # type: ignore[arg-type]  # one dictionary for all keys
                drawn = True
        if drawn:
            axes.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=3, borderaxespad=0.2, labelcolor=MUTED)
        else:
            axes.text(
                0.5, 0.5, "nothing was read or sent", transform=axes.transAxes, ha="center", color=MUTED
            )

    def _detour(self) -> Floats | None:
        """Return the reachable trajectory where it is another one than the goals."""
        way, goal = reachable(self.log, self.row), self.log.cycles["goal_position"][:, self.row]
        return way if (np.abs(way[1:] - goal[:-1]) > _APART_RAD).any() else None

    def _strip(self, axes: Axes) -> None:
        """Draw a row of ticks for each reason to read a cycle with care."""
        reasons = self._reasons()
        for number, (_, flags, colour) in enumerate(reasons):
            at = self.times[self.columns.marked(flags)]
            axes.vlines(at, number - 0.38, number + 0.38, color=colour, linewidth=1.0)
        axes.set_yticks(range(len(reasons)), [name for name, _, _ in reasons])
        axes.tick_params(axis="y", labelsize=7, length=0, labelcolor=INK)
        axes.set_ylim(len(reasons) - 0.5, -0.5)
        axes.grid(visible=False, axis="x")
