"""Diagnostics: messages of /diagnostics with each joint's temperature, voltage, error and mode."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress

import numpy as np

from dxlrun.log.schemas import DIAGNOSTICS
from dxlrun.messages.cdr import Codec
from dxlwire.modes import Mode

DIAGNOSTICS_NS = 1_000_000_000
"""Shortest time between two messages, ns."""
_OK, _ERROR, _STALE = 0, 2, 3
"""Levels OK, ERROR and STALE of diagnostic_msgs/msg/DiagnosticStatus."""
_Status = tuple[int, str, str, str, tuple[tuple[str, str], ...]]


class Diagnostics:
    """Makes messages of /diagnostics from cycle records, at most one per second."""

    def __init__(self, joints: Sequence[str]) -> None:
        self._joints = tuple(joints)
        self._codec = Codec(DIAGNOSTICS)
        self._due_ns: int | None = None

    def pack_diagnostics(self, record: np.void, t_ns: int, stamp: tuple[int, int]) -> bytes | None:
        """Return the encoded message of a cycle; None if the last one is younger than DIAGNOSTICS_NS.

        `stamp` has seconds since 1970 and the remaining nanoseconds.
        """
        if self._due_ns is not None and t_ns < self._due_ns:
            return None
        self._due_ns = t_ns + DIAGNOSTICS_NS
        statuses = [self._status(record, row, name) for row, name in enumerate(self._joints)]
        return self._codec.pack((stamp, ""), statuses)

    def _status(self, record: np.void, row: int, name: str) -> _Status:
        error = int(record["hardware_error"][row])
        level, message = _OK, "answers"
        if error:
            level, message = _ERROR, f"hardware error 0x{error:02X}"
        elif not record["valid"][row]:
            level, message = _STALE, "did not answer in this cycle"
        values = (
            ("temperature", _number(record["temperature"][row], "deg C")),
            ("voltage", _number(record["voltage"][row], "V")),
            ("hardware_error", f"0x{error:02X}"),
            ("mode", _mode(int(record["mode"][row]))),
        )
        return level, name, message, "", values


def _number(value: float, unit: str) -> str:
    return f"{value:.1f} {unit}" if np.isfinite(value) else "not read yet"


def _mode(number: int) -> str:
    with suppress(ValueError):
        return Mode(number).name.lower()
    return str(number)
