"""Hardware errors of a servo model: the item that reports them, and the meaning of its bits or codes."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Literal

import msgspec

Fault = Literal["voltage", "overheating", "overload"]
"""Kinds of faults that the analysis of a log distinguishes, independent of a model's own names and values."""

STATUS_BYTE: Mapping[str, int] = {"input_voltage": 0x01, "overheating": 0x04, "overload": 0x20}
"""Bits in the error byte of Protocol 1.0 that report a fault of the servo, the same for every model; the
other bits concern one instruction. Source: e-Manual, "DYNAMIXEL Protocol 1.0", Error."""


class HardwareErrors(msgspec.Struct, frozen=True):
    """Item that reports the hardware errors of a servo model, with the meaning of its values."""

    item: str = ""
    """Name of the item: `hardware_error_status`, `error_code` (Y series), or empty for the error byte of
    each reply."""
    values: Mapping[str, int] = MappingProxyType({})
    """Bit of each error by the e-Manual's name in snake_case; the error's code instead if `has_codes`."""

    @property
    def has_codes(self) -> bool:
        """True if the item holds the code of the newest error instead of a bit for each error."""
        return self.item == "error_code"

    @property
    def mask(self) -> int:
        """All error bits of the item together; only for an item of bits."""
        return sum(self.values.values())

    def names(self, value: int) -> tuple[str, ...]:
        """Return the names of the errors that a value of the item reports."""
        if self.has_codes:
            return tuple(name for name, code in self.values.items() if code == value)
        return tuple(name for name, bit in self.values.items() if value & bit)

    def describe_errors(self, value: int) -> str:
        """Return a value of the item in the e-Manual's words, such as `overload error`; `no hardware
        error` for 0."""
        if not value:
            return "no hardware error"
        names = self.names(value)
        words = [(name if is_warning(name) else f"{name} error").replace("_", " ") for name in names]
        if self.has_codes:
            return words[0] if words else f"code {value}, not defined in the control table"
        if unknown := value & ~self.mask:
            words.append(f"bits {unknown:02x}, not defined in the control table")
        return "; ".join(words)

    def is_warning(self, value: int) -> bool:
        """Return True if a value reports only warnings: the servo still accepts torque and goals."""
        names = self.names(value)
        return bool(names) and all(map(is_warning, names))

    def faults(self, value: int) -> frozenset[Fault]:
        """Return the kinds of faults that a value of the item reports: voltage, overheating, overload."""
        kinds: tuple[Fault, ...] = ("voltage", "overheating", "overload")
        return frozenset(kind for kind in kinds for name in self.names(value) if name.endswith(kind))

    def value_of(self, *names: str) -> int:
        """Return the bit or code of the first of these errors that the model has; 0 if it has none."""
        return next((self.values[name] for name in names if name in self.values), 0)


def is_warning(name: str) -> bool:
    """Return True if an error's name is that of a warning (e-Manual, Y series, Error Code (153))."""
    return name.endswith("_warning")


def error_item(items: Mapping[str, object]) -> str:
    """Return the name of the item among a model's items that reports hardware errors; empty if it has
    none."""
    return next((name for name in ("hardware_error_status", "error_code") if name in items), "")
