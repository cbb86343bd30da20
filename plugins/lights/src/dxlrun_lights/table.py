"""Table of the lights in the output of `dxlrun check`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from dxlrun.tooling.features import Row, TableStage
from dxlrun.tooling.output import Column, Table
from dxlrun.tooling.plans import Plan
from dxlrun_lights.plan import decode_lights


def light_rows(plan: Plan) -> Iterator[Row]:
    """Yield name, joint, bus and ID of each light of a plan."""
    for name, light in decode_lights(plan.feature_plans["lights"]).items():
        yield {"name": name, "joint": light.joint, "bus": light.bus, "id": light.servo_id}


def light_table(rows: Sequence[Row]) -> Table:
    """Return the table that shows the rows of `light_rows`."""
    columns = [
        (Column("light", "name"), "name"),
        (Column("joint", "name"), "joint"),
        (Column("bus", "name"), "bus"),
        (Column("ID"), "id"),
    ]
    return Table.listing("Lights", columns, rows)


STAGE = TableStage(rows=light_rows, table=light_table)
