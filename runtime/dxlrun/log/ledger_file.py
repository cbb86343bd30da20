"""The file of the simulated buses' ledger."""

from __future__ import annotations

from pathlib import Path

from dxlrun.output.target import open_empty
from dxlsim.bus.ledger import Ledger

_MODE = 0o640  # Of a new file: it can be read by its user and group only
_BUFFER = 1 << 16  # Bytes that are written out together


def open_ledger(path: Path | None) -> Ledger:
    """Return a ledger that keeps nothing in memory, and writes a file where one is named.

    Raises OSError for a file that cannot be written, or is not empty.
    """
    if path is None:
        return Ledger(keep=False)
    return Ledger(open(open_empty(path, _MODE), "wb", _BUFFER), keep=False)
