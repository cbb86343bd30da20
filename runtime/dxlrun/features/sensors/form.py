"""Form of the section `sensors`; the plug-in that offers a type checks the keys of that type."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from dxlrun.description import units
from dxlrun.description.form import Name, PlugInEntry, key
from dxlrun.description.units import Duration
from dxlrun.features.feature import Section


class SensorEntry(PlugInEntry):
    """One sensor. Keys other than type, rate, timeout and on_lost are its own parameters."""

    type: str = key("Type that a plug-in offers.", "serial_imu", min_length=1)
    rate: Annotated[float, Field(ge=0.001, le=100_000), units.rate] | None = key(
        "Samples per second, Hz; the loop's rate when absent.", "100", None
    )
    timeout: Annotated[Duration, Field(gt=0)] | None = key(
        "Age at which its values are no longer valid; 5 periods when absent, 50 ms at least.", "50 ms", None
    )
    on_lost: Literal["continue", "stop"] = key(
        "When it brings nothing for that time; stop: the run ends by the policy on_fault.", "stop", "continue"
    )


STAGE: Section[dict[str, SensorEntry]] = Section(
    "sensors",
    dict[Name, SensorEntry],
    key("Sensors by name, each with a process of its own.", "{imu: {type: serial_imu, ...}}", {}),
    before="poses",
)
