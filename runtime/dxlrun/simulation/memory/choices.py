"""Items whose values the e-Manual lists one by one; a control table knows only the lowest and the highest."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from dxlrun.dynamixel.control_table import ControlTable

TORQUE_ENABLE_OF_P = 512
"""Address of Torque Enable on P, PRO(A), RH-P12-RN(A) and Y."""


def choices(table: ControlTable) -> Mapping[str, frozenset[int]]:
    """Return the items of a model with the values that they may have; anything else is out of range.

    Sections "Operating Mode" and "Protocol Type" of the models' pages.
    """
    listed = {"operating_mode": _operating_modes(table), "protocol_type": _protocol_types(table)}
    return MappingProxyType({name: frozenset(each) for name, each in listed.items() if name in table.items})


def _operating_modes(table: ControlTable) -> tuple[int, ...]:
    item = table.items.get("operating_mode")
    if item is not None and item.minimum == 1:
        return 1, 3  # L42-10-S300-R
    if item is None or item.maximum == 3:
        return 0, 1, 3  # Y
    if item.maximum == 4:
        return 0, 1, 3, 4  # PRO
    if item.maximum == 5:
        return 0, 5  # RH-P12-RN, RH-P12-RN(A)
    if table.items["torque_enable"].address == TORQUE_ENABLE_OF_P:
        return 0, 1, 3, 4, 16
    return (0, 1, 3, 4, 5, 16) if "goal_current" in table.items else (1, 3, 4, 16)


def _protocol_types(table: ControlTable) -> tuple[int, ...]:
    item = table.items.get("protocol_type")
    if item is None or item.minimum == item.maximum:
        return (2,)  # Y
    if item.maximum == 10:
        return 2, 10  # P: Modbus-RTU
    if item.maximum == 22:
        return 2, 20, 21, 22  # X330, X335: S.BUS, iBUS, RC-PWM
    return 1, 2
