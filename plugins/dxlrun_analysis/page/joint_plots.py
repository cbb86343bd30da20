"""Plots of the joints: position, velocity and error of each; temperature, voltage and load of all."""

from __future__ import annotations

from collections.abc import Sequence

from dxlrun_analysis.joints.goal_tracking import JointTracking
from dxlrun_analysis.page.canvas import BLUE, ERROR, INK, ORANGE, PURPLE, Canvas, Plot, PlotLine, many_lines
from dxlrun_analysis.page.run_curves import Curves, joint_curve

_LEAST, _LEAST_SPEED, _LEAST_ERROR, _LEAST_EFFORT = 5.0, 25.0, 1.0, 0.1
"""Least span of the vertical axis of a joint's plots: position in deg or mm, speed in deg/s or mm/s,
error, effort."""
_ALL = (
    ("temperature", "Temperature of the servos", "temperature, deg C", "deg C", 4.0),
    ("voltage", "Voltage at the servos", "voltage, V", "V", 1.0),
    ("effort", "Load of the servos", "effort, A, Nm or share of maximum", "", 0.1),
)


def joint_plots(canvas: Canvas, cycles: Curves, row: int, joint: JointTracking) -> list[Plot]:
    """Return the plots of the joint in row `row` that have content: position, error, velocity, effort."""
    unit, scale = joint.unit.shown, joint.unit.factor
    position = canvas.timed(f"joint-{row}", joint.name, f"position, {unit}", 210)
    canvas.curves(position, cycles, _lines(joint.name, "position"), unit, _LEAST, scale)
    canvas.marks(
        position,
        cycles,
        [
            PlotLine(joint_curve("silent", joint.name), "no reply", ERROR),
            PlotLine(joint_curve("clamped", joint.name), "clamped", PURPLE),
        ],
    )
    position.text = _followed(joint)
    error = [PlotLine(joint_curve("error", joint.name), "position minus previous goal", PURPLE)]
    speed, effort = (_lines(joint.name, quantity) for quantity in ("velocity", "effort"))
    plots = [position]
    for quantity, label, lines, least, times in (
        ("error", unit, error, _LEAST_ERROR, scale),
        ("velocity", f"{unit}/s", speed, _LEAST_SPEED, scale),
        ("effort", f"A, {joint.unit.torque} or share of maximum", effort, _LEAST_EFFORT, 1.0),
    ):
        # The measured loads of all joints have a common plot.
        if any(line.curve in cycles for line in (lines[1:] if quantity == "effort" else lines)):
            plot = canvas.timed(f"joint-{row}-{quantity}", "", f"{quantity}, {label}", 150)
            canvas.curves(plot, cycles, lines, label, least, times)
            plot.label = f"{joint.name}: {quantity}, {label}"
            plots.append(plot)
    return plots


def _lines(joint: str, quantity: str) -> list[PlotLine]:
    """Return the lines of one quantity of a joint: read (broad), sent (thinner), desired (dashed). They
    stay visible where they coincide."""
    return [
        PlotLine(joint_curve(quantity, joint), "read", BLUE, width=4.0),
        PlotLine(joint_curve(f"goal_{quantity}", joint), "sent", ORANGE, width=1.8),
        PlotLine(joint_curve(f"command_{quantity}", joint), "desired", INK, "dashed", width=1.2),
    ]


def _followed(joint: JointTracking) -> str:
    """Return a joint's tracking error, lag, settling time and error at rest as a caption."""
    if joint.rms_rad is None or joint.worst_rad is None:
        return "No goal was sent, or no position was read."
    unit, scale = joint.unit.shown, joint.unit.factor
    parts = [
        f"Error rms {joint.rms_rad * scale:.2f} {unit}, worst {joint.worst_rad * scale:.2f} {unit} "
        "(position minus reachable trajectory)"
    ]
    if joint.lag_ms is not None:
        parts.append(f"lag {joint.lag_ms:.0f} ms")
    if joint.settling_ms is not None:
        parts.append(f"settled after at most {joint.settling_ms:.0f} ms")
    if joint.rest_rad is not None:
        parts.append(f"error at rest at most {joint.rest_rad * scale:.2f} {unit}")
    return f"{', '.join(parts)}."


def state_plots(canvas: Canvas, cycles: Curves, joints: Sequence[str]) -> list[Plot]:
    """Return plots of temperature, voltage and load of all joints, as far as they were read."""
    plots = []
    for field, title, label, unit, least in _ALL:
        lines = many_lines(cycles, ((joint_curve(field, joint), joint) for joint in joints))
        if lines:
            plot = canvas.timed(f"all-{field}", title, label, 200)
            canvas.curves(plot, cycles, lines, unit, least)
            plots.append(plot)
    return plots
