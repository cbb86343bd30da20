"""Lights at the end of a run: switched off by the process that brings the robot to a safe state."""

from __future__ import annotations

from dxlrun.tooling.features import Lines, Program, SafeStage, limit_patience, plan_line, retry
from dxlrun_lights.plan import LightPlan, decode_lights
from dxlwire import BusPlan


def switch_lights_off(lines: Lines, plan: bytes) -> tuple[str, ...]:
    """Switch the LEDs of the lights off; return a sentence for each LED that did not confirm it."""
    lights = decode_lights(plan)
    on_buses = [
        {name: light for name, light in lights.items() if light.bus == bus.name} for bus in lines.plans
    ]
    results = lines.run_programs(
        [limit_patience(_switch_off(bus, own)) for bus, own in zip(lines.plans, on_buses, strict=True)]
    )
    return tuple(sentence for sentences in results for sentence in sentences or ())


def _switch_off(bus: BusPlan, lights: dict[str, LightPlan]) -> Program[list[str]]:
    failures = []
    for name, light in lights.items():
        reply = yield from retry(plan_line(bus).write_range(light.servo_id, light.address, b"\0"))
        if not reply.answered:
            failures.append(
                f"light {name} (ID {light.servo_id} on bus {bus.name}) may still be on: no answer"
            )
    return failures


STAGE = SafeStage(switch_lights_off)
