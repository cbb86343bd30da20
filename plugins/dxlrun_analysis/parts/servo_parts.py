"""Parts of the report about servos, buses and joints: traffic, tracking, temperature and voltage."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from dxlrun.tooling.output import Cell, Column, Columns, Table, Value, flagged, microseconds
from dxlrun_analysis.joints.goal_tracking import JointTracking
from dxlrun_analysis.joints.health import ServoHealth
from dxlrun_analysis.parts.part import Report, ReportPart, listing
from dxlrun_analysis.servos.traffic import BusTraffic, ServoTraffic


def _error(name: str) -> Callable[[JointTracking], Value]:
    """Return a function that formats one error of a joint (the field `name`) for a table: in deg, or with
    unit for a linear joint."""

    def error(joint: JointTracking) -> Value:
        value = getattr(joint, name)
        if value is None or not joint.unit.suffix:
            return value and math.degrees(value)
        return Cell(joint.unit.text(value))

    return error


def _joints(_: Report, joints: Sequence[JointTracking]) -> Table:
    mm = ", linear joints in mm" if any(joint.unit.suffix for joint in joints) else ""
    return Table.listing(f"Joints (errors in deg{mm}: position minus reachable trajectory)", _JOINT, joints)


_SERVO: Columns[ServoTraffic] = (
    (Column("servo", "name"), lambda servo: f"{servo.bus} {servo.servo_id}"),
    (Column("joint", "name"), lambda servo: servo.joint or "-"),
    (Column("instructions", detail=True), "instructions"),
    (Column("asked"), "asked"),
    (Column("lost"), lambda servo: flagged(servo.lost)),
    (Column("replies", detail=True), "replies"),
    (
        Column("errors"),
        lambda servo: flagged(servo.errors, f"{servo.errors} {', '.join(servo.error_names)}".strip()),
    ),
    (Column("reply"), lambda servo: microseconds(servo.reply_median_us)),
    (Column("slowest"), lambda servo: microseconds(servo.reply_max_us)),
)
_BUS: Columns[BusTraffic] = (
    (Column("bus", "name"), "name"),
    (Column("instructions"), "instructions"),
    (Column("broadcasts"), "broadcasts"),
    (Column("replies"), "replies"),
    (Column("noise"), lambda bus: flagged(bus.noise_bytes, f"{bus.noise_bytes} B")),
    (Column("out", form="{} B"), "bytes_out"),
    (Column("in", form="{} B"), "bytes_in"),
)
_JOINT: Columns[JointTracking] = (
    (Column("joint", "name"), "name"),
    (Column("invalid"), lambda joint: flagged(joint.invalid)),
    (Column("oldest", form="{:.1f} ms", detail=True), "oldest_ms"),
    (Column("clamped", detail=True), lambda joint: flagged(joint.clamped)),
    (Column("rms", form="{:.2f}", missing="-"), _error("rms_rad")),
    (Column("worst", form="{:.2f}", missing="-"), _error("worst_rad")),
    (Column("lag", form="{:.0f} ms", missing="-"), "lag_ms"),
    (Column("delay", form="{:.0f} ms", missing="-", detail=True), "delay_ms"),
    (Column("settling", form="{:.0f} ms", missing="-"), "settling_ms"),
    (Column("at rest", form="{:.2f}", missing="-"), _error("rest_rad")),
)

SERVOS = ReportPart("servos", lambda report: report.totals.servos, listing("Servos", _SERVO), section="buses")
BUSES = ReportPart(
    "buses", lambda report: report.totals.buses, listing("Buses", _BUS), section="buses", first=True
)
JOINTS = ReportPart("joints", lambda report: report.totals.tracking, _joints, section="joints")
EXTREMES = ReportPart("extremes", lambda report: report.tally.find_collector(ServoHealth).extremes())
