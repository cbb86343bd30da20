"""Bus Watchdog: unit and range of the timeout, and the servos of a plan that have one.

The register stops a servo of Protocol 2.0 that receives no more instructions (e-Manual XM430-W350, Bus
Watchdog (98)). Protocol 1.0 has none.
"""

from __future__ import annotations

from dxlwire.bus_plan import BusPlan, ServoPlan
from dxlwire.control_table import ControlItem, find_table

UNIT_NS = 20_000_000  # one step of the register (e-Manual XM430-W350, Bus Watchdog (98))
MOST_TICKS = 127  # longest timeout; higher values mean that it has tripped
LEAST_PERIODS = 3  # the timeout must be longer than two lost cycles (failures.md)


def has_watchdog(plan: BusPlan, servo: ServoPlan) -> bool:
    """Return True if the plan arms the Bus Watchdog of this servo, which then has one."""
    return bool(plan.watchdog_ticks) and watchdog_item(plan, servo) is not None


def watchdog_item(plan: BusPlan, servo: ServoPlan) -> ControlItem | None:
    """Return the Bus Watchdog item of a servo's control table; None if the model has none."""
    return find_table(servo.model, plan.protocol).items.get("bus_watchdog")
