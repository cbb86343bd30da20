"""Processes of the sensors: one for each sensor, which samples it at its own rate."""

from __future__ import annotations

import msgspec

from dxlrun.control.source_process import ProcessStage, SourceContext, SourceProcess
from dxlrun.features.sensors.plan import SensorPlan, decode_sensors
from dxlrun.features.sensors.sampling import SampledSensor, build_sensor


def list_processes(plan: bytes) -> tuple[SourceProcess, ...]:
    """Return the process of each sensor, in the order of the file."""
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


def build_sampled_sensor(plan: bytes, context: SourceContext) -> SampledSensor:
    """Build the sensor of a process; raise PlugInError."""
    sensor = msgspec.json.decode(plan, type=SensorPlan)
    built = build_sensor(context.plugins, sensor)
    return SampledSensor(sensor, built, context.writer, context.now_ns, context.body)


def refuse_virtual_time(plan: bytes) -> str:
    """Return a sentence about sensors of the real world, which cannot follow virtual time; empty: none."""
    measuring = [sensor for sensor in decode_sensors(plan) if not sensor.simulated]
    names = ", ".join(f"{sensor.name} ({sensor.type})" for sensor in measuring)
    return names and (
        f"virtual time needs simulated sensors, but {names} measures the real world: "
        "leave --virtual out, or take the sensor and what reads it out of the file that runs so"
    )


STAGE = ProcessStage(list_processes, build_sampled_sensor, refuse_virtual_time)
