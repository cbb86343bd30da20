"""Registers: what a client wants in a servo's memory, checked against the table before the loop has it."""

from __future__ import annotations

import msgspec

from dxlrun.compile.plan import Plan
from dxlrun.compile.registers import UnfitRegister, steered_value
from dxlrun.control.steering import Register
from dxlrun.dynamixel.control_table import ControlTable, control_table
from dxlrun.errors import suggestion
from dxlrun.remote.preparation import Refusal


class Value(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a client sends: the integer on the wire, or a quantity with its unit."""

    value: int | str


def register_wish(plan: Plan, joint: str, item: str, value: int | str) -> Register:
    """Return what the loop is asked for; raises Refusal: no such joint or item, or none to be changed now."""
    tables = _tables(plan)
    table = tables.get(joint)
    if table is None:
        raise Refusal(404, f"there is no joint {joint[:80]}; {suggestion(joint[:80], tuple(tables))}")
    try:
        wanted = steered_value(table, item[:80], value)
    except UnfitRegister as error:
        raise Refusal(404 if item not in table.items else 422, f"{joint}: {error}") from error
    except ValueError as error:  # a quantity that is none
        raise Refusal(422, f"{item} of {joint}: {error}") from error
    return Register(joint, item, wanted.value)


def _tables(plan: Plan) -> dict[str, ControlTable]:
    return {
        servo.joint: control_table(servo.model, bus.protocol) for bus in plan.buses for servo in bus.servos
    }
