"""Sensor processes: list them for the supervisor, and build the sensor inside its process."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import msgspec

from dxlrun.control.controllers.plugin_loading import PlugIns
from dxlrun.control.sampled_sources import ProcessStage, SampledSource, SourceContext, SourceProcess
from dxlrun.errors import PlugInError
from dxlrun.features.sensors.driver import Sensor, SensorContext
from dxlrun.features.sensors.plan import SensorPlan, decode_sensors


def list_processes(plan: bytes) -> tuple[SourceProcess, ...]:
    """Return one process description for each sensor in a plan, in file order."""
    return tuple(
        SourceProcess(
            source=sensor.name,
            kind="sensor",
            values=len(sensor.states),
            period_ns=sensor.period_ns,
            plan=msgspec.json.encode(sensor),
            has_body=bool(sensor.links),
        )
        for sensor in decode_sensors(plan)
    )


def build_sampled_sensor(plan: bytes, context: SourceContext) -> SampledSource:
    """Build the sensor of this process from its encoded plan; raise PlugInError if that fails."""
    sensor = msgspec.json.decode(plan, type=SensorPlan)
    driver = build_sensor(context.plugins, sensor)

    def open_driver(say: Callable[[str], None]) -> None:
        driver.open(SensorContext(sensor.name, sensor.period_ns, context.now_ns, say, context.body))

    return SampledSource(driver, open_driver, sensor.period_ns, context)


def build_sensor(plugins: PlugIns, plan: SensorPlan) -> Sensor[Any]:
    """Create an instance of the sensor class that a plan names.

    Raises:
        PlugInError: The type is not available, or its class refuses the parameters.
    """
    offer = plugins.drivers_of("sensors").get(plan.type)
    if offer is None:
        raise plugins.unknown_type(f"sensor {plan.name}", plan.type)
    try:
        sensor: Sensor[Any] = offer.driver(offer.driver.Parameters.model_validate_json(plan.parameters))
    except (Exception, SystemExit) as error:  # foreign code: one sentence instead of its traceback
        what = f"{type(error).__name__}: {' '.join(str(error).split())}"
        raise PlugInError(f"sensor {plan.name} cannot be built: {what}") from error
    return sensor


def refuse_virtual_time(plan: bytes) -> str:
    """Return the error for `--virtual` if a plan has real sensors; empty if all are simulated."""
    measuring = [sensor for sensor in decode_sensors(plan) if not sensor.simulated]
    names = ", ".join(f"{sensor.name} ({sensor.type})" for sensor in measuring)
    return names and (
        f"virtual time needs simulated sensors, but {names} is real: "
        "omit --virtual, or remove the sensor and its readers from the robot file"
    )


STAGE = ProcessStage(list_processes, build_sampled_sensor, refuse_virtual_time)
