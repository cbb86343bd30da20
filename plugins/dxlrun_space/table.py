"""Table of the section `tip_poses` in the output of `dxlrun check`."""

from __future__ import annotations

import math
from collections.abc import Sequence

import msgspec

from dxlrun import JointUnit
from dxlrun.tooling.features import Row, TableStage
from dxlrun.tooling.output import Column, Columns, Table
from dxlrun.tooling.plans import Plan
from dxlrun_space.solver import CLOSE_RAD


def pose_rows(plan: Plan) -> list[Row]:
    """Return the row of each pose, which `compile.py` made."""
    return msgspec.json.decode(plan.feature_plans["tip_poses"], type=list[Row])


def pose_table(rows: Sequence[Row]) -> Table:
    """Return the table of the poses: how easily the tip moves there, and the joint next to its limit."""

    def margin(row: Row) -> str:
        return f"{JointUnit(row['margin_unit']).text(row['margin'])} of {row['margin_joint']}"

    def off(row: Row) -> float | None:
        return math.degrees(row["orientation_error"]) if row["orientation_error"] > CLOSE_RAD else None

    columns: Columns[Row] = [
        (Column("pose", "name"), "name"),
        (Column("tip", "name"), "tip"),
        (Column("dexterity", form="{:.2f}"), "dexterity"),
        (Column("left to a limit", "name"), margin),
        (Column("turned off by", form="{:.1f} deg"), off),
    ]
    return Table.listing("Poses of tips (dexterity: 1 in all directions alike, 0 singular)", columns, rows)


STAGE = TableStage(rows=pose_rows, table=pose_table)
