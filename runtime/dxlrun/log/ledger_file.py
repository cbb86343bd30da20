"""Ledger file: file with the packets that simulated buses exchanged."""

from __future__ import annotations

from pathlib import Path

from dxlrun.output.target import open_empty
from dxlsim.bus.ledger import Ledger

# Mode of a new file, which only its user and group can read.
_MODE = 0o640
# Buffer size, bytes.
_BUFFER = 1 << 16


def open_ledger(path: Path | None) -> Ledger:
    """Return the ledger of the simulated buses, which writes to a new file, or discards everything for None.

    Raises OSError for a file that cannot be written, or is not empty.
    """
    if path is None:
        return Ledger(keep=False)
    return Ledger(open(open_empty(path, _MODE), "wb", _BUFFER), keep=False)
