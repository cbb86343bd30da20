"""Monitor that ends a run when a sensor with `on_lost: stop` delivers no samples."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

from dxlrun.channels.cycle import CycleRecord
from dxlrun.control.monitors.monitor_stage import MonitorStage
from dxlrun.control.monitors.policy_actions import PolicyActions
from dxlrun.features.sensors.plan import SensorPlan, decode_sensors
from dxlrun.plan.loop_plan import LoopPlan


@dataclass(slots=True)
class NeededSensors:
    """Sensors with `on_lost: stop`; the run ends by `on_fault` if the newest sample of one is too old."""

    needed: tuple[tuple[int, SensorPlan], ...]
    """These sensors, each with its row among the sources of the record."""
    record: CycleRecord
    actions: PolicyActions

    @classmethod
    def build(cls, plan: LoopPlan, record: CycleRecord, actions: PolicyActions) -> Self | None:
        """Return the monitor of all sensors with `on_lost: stop` in a plan; None if there are none."""
        needed = tuple(
            (record.layout.sources.index(one.name), one)
            for one in decode_sensors(plan.feature_plans.get("sensors", b""))
            if one.on_lost == "stop"
        )
        return cls(needed, record, actions) if needed else None

    def check_cycle(self, time_ns: int) -> None:
        """End the run if a sensor's newest sample (without one: the run) is older than its timeout."""
        ages_ns = self.record.sources.age_ns
        for row, sensor in self.needed:
            age_ns = ages_ns.item(row)
            if (age_ns if age_ns >= 0 else time_ns) > sensor.timeout_ns:
                nothing = f"sensor {sensor.name} delivered nothing for {sensor.timeout_ns / 1e6:g} ms"
                self.actions.end_run("on_fault", nothing)


STAGE = MonitorStage(NeededSensors)
