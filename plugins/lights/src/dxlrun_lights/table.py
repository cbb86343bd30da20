"""Table of the lights, as `dxlrun check` shows it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import msgspec

from dxlrun.tooling.features import Row, TableStage
from dxlrun.tooling.output import Column, Table
from dxlrun.tooling.plans import Plan
from dxlrun_lights.plan import Light


def light_rows(plan: Plan) -> Iterator[Row]:
    """Yield a row for each light."""
    for name, light in msgspec.json.decode(plan.feature_plans["lights"], type=dict[str, Light]).items():
        yield {"name": name, "joint": light.servo}


def light_table(rows: Sequence[Row]) -> Table:
    """Return the table of these lights."""
    return Table.listing(
        "Lights", [(Column("light", "name"), "name"), (Column("joint", "name"), "joint")], rows
    )


STAGE = TableStage(rows=light_rows, table=light_table)
