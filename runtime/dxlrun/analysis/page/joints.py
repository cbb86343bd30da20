"""Plots of the joints: position, velocity and error of each, and how warm and how loaded all of them were."""

from __future__ import annotations

from collections.abc import Sequence

from dxlrun.analysis.joints.tracking import JointTracking
from dxlrun.analysis.page.canvas import BLUE, ERROR, GREEN, ORANGE, PURPLE, Canvas, Line, Plot, many_lines
from dxlrun.analysis.page.curves import Curves, joint_curve

_LEAST_RAD, _LEAST_RAD_S, _LEAST_ERROR_RAD, _LEAST_EFFORT = 0.1, 0.5, 0.02, 0.1
_M_A_RAD = 0.05
"""What is as little in m of a linear joint as 1 rad of one that turns."""
_ALL = (
    ("temperature", "Temperature of the servos", "temperature, deg C", "deg C", 4.0),
    ("voltage", "Voltage at the servos", "voltage, V", "V", 1.0),
    ("effort", "Load of the servos", "effort, Nm or share", "", 0.1),
)


def joint_plots(canvas: Canvas, cycles: Curves, row: int, joint: JointTracking) -> list[Plot]:
    """Return the plots of one joint that have anything in them."""
    unit = joint.unit
    scale = 1.0 if unit == "rad" else _M_A_RAD
    position = canvas.timed(f"joint-{row}", joint.name, f"position, {unit}", 210)
    canvas.curves(position, cycles, _lines(joint.name, "position"), unit, _LEAST_RAD * scale)
    canvas.marks(
        position,
        cycles,
        [
            Line(joint_curve("silent", joint.name), "no reply", ERROR),
            Line(joint_curve("clamped", joint.name), "clamped", PURPLE),
        ],
    )
    position.text = _followed(joint)
    plots = [position]
    if joint_curve("error", joint.name) in cycles:
        error = canvas.timed(f"joint-{row}-error", "", f"error, {unit}", 130)
        line = Line(joint_curve("error", joint.name), "position minus the goal before", PURPLE)
        canvas.curves(error, cycles, [line], unit, _LEAST_ERROR_RAD * scale)
        error.label = f"{joint.name}: error, {unit}"
        plots.append(error)
    for quantity, unit, least in (
        ("velocity", f"{joint.unit}/s", _LEAST_RAD_S * scale),
        ("effort", f"{'Nm' if joint.unit == 'rad' else 'N'} or share", _LEAST_EFFORT),
    ):
        lines = _lines(joint.name, quantity)
        wanted = lines if quantity == "velocity" else lines[:2]  # all loads are in a plot of their own
        if any(line.curve in cycles for line in wanted):
            plot = canvas.timed(f"joint-{row}-{quantity}", "", f"{quantity}, {unit}", 150)
            canvas.curves(plot, cycles, lines, unit, least)
            plot.label = f"{joint.name}: {quantity}, {unit}"
            plots.append(plot)
    return plots


def _lines(joint: str, quantity: str) -> list[Line]:
    return [
        Line(joint_curve(f"command_{quantity}", joint), "desired", GREEN, width=3.0),
        Line(joint_curve(f"goal_{quantity}", joint), "sent", ORANGE, "dashed", width=1.5),
        Line(joint_curve(quantity, joint), "read", BLUE),
    ]


def _followed(joint: JointTracking) -> str:
    """Return error, lag, settling and error at rest in words, as far as they are known."""
    if joint.rms_rad is None or joint.worst_rad is None:
        return "No goal was sent, or no position was read."
    parts = [
        f"Error rms {joint.rms_rad:.4f} {joint.unit}, worst {joint.worst_rad:.4f} {joint.unit} "
        "(position minus what was reachable)"
    ]
    if joint.lag_ms is not None:
        parts.append(f"lag {joint.lag_ms:.0f} ms")
    if joint.settling_ms is not None:
        parts.append(f"settled after at most {joint.settling_ms:.0f} ms")
    if joint.rest_rad is not None:
        parts.append(f"at rest off by at most {joint.rest_rad:.4f} {joint.unit}")
    return f"{', '.join(parts)}."


def state_plots(canvas: Canvas, cycles: Curves, joints: Sequence[str]) -> list[Plot]:
    """Return temperature, voltage and load of all joints, those that were read."""
    plots = []
    for field, title, label, unit, least in _ALL:
        lines = many_lines((joint_curve(field, joint), joint) for joint in joints)
        if any(line.curve in cycles for line in lines):
            plot = canvas.timed(f"all-{field}", title, label, 200)
            canvas.curves(plot, cycles, lines, unit, least, band=len(joints) == 1)
            plot.text = "A click on a name hides its curve."
            plots.append(plot)
    return plots
