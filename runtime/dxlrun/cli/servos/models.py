"""`dxlrun models`: which servos dxlrun knows, and what stands where in their memory."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import TYPE_CHECKING

from dxlrun.cli.output.flags import Flag, JsonFlag
from dxlrun.cli.output.terminal import out
from dxlrun.errors import InputError

if TYPE_CHECKING:
    from dxlrun.dynamixel.control_table import ControlTable


def models(
    name: str | None = None,
    /,
    *,
    protocol: float | None = None,
    as_json: JsonFlag = False,
    debug: Flag = False,
) -> int:
    """List the servo models that a robot file can name, or print the control table of one.

    Parameters
    ----------
    name
        A model, for example AX-12A; without it all are listed.
    protocol
        Only those of this protocol, 1.0 or 2.0.
    as_json
        Print the result as JSON.
    debug
        Print the traceback of an error.
    """
    from dxlrun.control.controllers.plugins import load_plugins

    load_plugins()  # they may bring servo models along
    tables = _tables(name, protocol)
    if as_json:
        value = [_as_json(table, items=name is not None) for table in tables]
        out().file.write(json.dumps(value, indent=2, ensure_ascii=False) + "\n")
        return 0
    from dxlrun.cli.output.models_tables import facts, items_of, overview
    from dxlrun.cli.output.narrow import fitting

    console = out()
    if name is None:
        console.print(fitting(overview(tables), console.width))
    else:
        for table in tables:
            console.print(facts(table))
            console.print(fitting(items_of(table), console.width))
    return 0


def _tables(name: str | None, protocol: float | None) -> list[ControlTable]:
    """Return the tables that are asked for; raises InputError when there is none."""
    from dxlrun.dynamixel.control_table import all_tables, control_table, perhaps_meant, protocols_of

    if protocol not in (None, 1.0, 2.0):
        raise InputError(f"there is no Protocol {protocol:g}; --protocol is 1.0 or 2.0")
    if name is None:
        return [table for table in all_tables() if protocol in (None, table.protocol)]
    wanted = [each for each in (1.0, 2.0) if protocol in (None, each)]
    found = [control_table(name, each) for each in protocols_of(name) if each in wanted]
    if not found:
        speaks = "" if protocol is None else f" of Protocol {protocol:.1f}"
        raise InputError(f"there is no model {name}{speaks}; {perhaps_meant(name, protocol)}")
    return found


def _motor(table: ControlTable) -> dict[str, object]:
    """Return the motor of the simulated servo, in SI units."""
    from dxlrun.simulation.motion.motor import motor_of

    motor = motor_of(table)
    return {
        **asdict(motor),
        "no_load_speed": motor.no_load_speed,
        "time_constant": motor.time_constant,
        "voltage": motor.voltage or None,
        "p_gain_duty": motor.p_gain_duty or None,
        "gain_source": motor.gain_source or None,
    }


def _as_json(table: ControlTable, *, items: bool) -> dict[str, object]:
    value: dict[str, object] = {
        "model": table.model,
        "aliases": list(table.aliases),
        "model_number": table.model_number,
        "protocol": table.protocol,
        "firmware": table.firmware,
        "rad_per_tick": table.rad_per_tick,
        "min_tick": table.min_tick,
        "max_tick": table.max_tick,
        "rad_s_per_tick": table.rad_s_per_tick,
        "max_speed_tick": table.max_speed_tick,
        "effort_per_tick": table.effort_per_tick,
        "effort_unit": table.effort_unit,
        "max_speed": table.max_speed,
        "stall_torque": table.stall_torque or None,
        "stall_current": table.stall_current or None,
        "nominal_voltage": table.nominal_voltage or None,
        "gear_ratio": table.gear_ratio or None,
        "simulated_motor": _motor(table),
        "capabilities": sorted(table.capabilities),
        "baud_rates": dict(table.baud_rates),
    }
    if items:
        value["items"] = [asdict(item) for item in table.items.values()]
    return value
