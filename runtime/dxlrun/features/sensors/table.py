"""Table of the sensors, as `dxlrun check` prints it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

from dxlrun.compile.check_report import Row, TableStage
from dxlrun.features.sensors.plan import SensorPlan, decode_sensors
from dxlrun.output.quantity import names_with_units
from dxlrun.output.text_table import Column, Table, Value
from dxlrun.plan.robot_plan import Plan


def sensor_rows(plan: Plan) -> Iterator[Row]:
    """Yield the columns of each sensor in a plan as a mapping, in file order."""
    return map(_sensor, decode_sensors(plan.feature_plans.get("sensors", b"")))


def sensor_table(sensors: Sequence[Row]) -> Table:
    """Return the printable table `Sensors` of these rows."""
    columns: list[tuple[Column, str | Callable[[Row], Value]]] = [
        (Column("sensor", "name"), "name"),
        (Column("type", "name"), "type"),
        (Column("from", "name"), "distribution"),
        (Column("rate", form="{:g} Hz"), "rate"),
        (Column("timeout", form="{:g} ms"), lambda row: row["timeout"] * 1e3),
        (
            Column("when lost", "text"),
            lambda row: "the run ends" if row["on_lost"] == "stop" else "the run continues",
        ),
        (Column("states", "text"), lambda row: names_with_units(row["states"], row["units"])),
        *[(Column("senses link", "text"), lambda row: ", ".join(row["links"]))]
        * any(row["links"] for row in sensors),
    ]
    return Table.listing("Sensors", columns, sensors)


STAGE = TableStage(rows=sensor_rows, table=sensor_table)


def _sensor(sensor: SensorPlan) -> Row:
    return {
        "name": sensor.name,
        "type": sensor.type,
        "distribution": sensor.distribution,
        "rate": 1e9 / sensor.period_ns,
        "timeout": sensor.timeout_ns * 1e-9,
        "on_lost": sensor.on_lost,
        "states": sensor.states,
        "units": sensor.units,
        "links": sensor.links,
    }
