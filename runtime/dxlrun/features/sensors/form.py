"""Form of the section `sensors` of a robot file; the keys of each type are checked by its plug-in."""

from typing import Annotated, Literal

from pydantic import Field

from dxlrun.description import units
from dxlrun.description.base_form import Name, PlugInEntry, key
from dxlrun.description.units import Duration
from dxlrun.features.feature import Section


class SensorEntry(PlugInEntry):
    """Form of one sensor. Keys other than type, rate, timeout and on_lost are parameters of its type."""

    type: str = key("Sensor type of a plug-in.", "serial_imu", min_length=1)
    rate: Annotated[float, Field(ge=0.001, le=100_000), units.rate] | None = key(
        "Sampling rate, Hz; the loop rate by default.", "100", None
    )
    timeout: Annotated[Duration, Field(gt=0)] | None = key(
        "Age of a sample beyond which its values are invalid; by default 5 periods, at least 50 ms.",
        "50 ms",
        None,
    )
    on_lost: Literal["continue", "stop"] = key(
        "Reaction to samples older than `timeout`: continue, or end the run by on_fault (stop).",
        "stop",
        "continue",
    )


STAGE: Section[dict[str, SensorEntry]] = Section(
    "sensors",
    dict[Name, SensorEntry],
    key("Sensors by name, each in its own process.", "{imu: {type: serial_imu, ...}}", {}),
    before="poses",
)
