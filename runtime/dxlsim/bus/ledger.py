"""The ledger of a simulated bus: every byte in and out with its time; the runtime cannot edit it."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from pathlib import Path
from typing import IO, Annotated, Literal, NamedTuple

import msgspec

from dxlwire.errors import InputError

Direction = Literal["in", "out", "note"]

FLUSH_NS = 500_000_000  # A ledger file is never further behind than this


FAULT = "fault: "  # How the note of a fault that happens begins; its text follows


class LedgerEntry(NamedTuple):
    """Bytes that passed the wire together, or a note about something that was done to the bus."""

    t_ns: int  # `in`: when the host handed them over; `out`: when the last of them had passed the wire
    bus: str
    direction: Direction  # Seen from the servos: `in` came from the host, `out` went to it
    data: bytes
    note: str
    late_ns: int = 0  # `out`, in real time: how long after it should have been the host got the last of them


# 73 years on the clock of the machine; differences of two such times fit into 64 bits
_Time = Annotated[int, msgspec.Meta(ge=-(1 << 62), le=1 << 62)]


class _Line(msgspec.Struct, omit_defaults=True):
    """An entry as one line of the file; a busy bus has thousands of them a second."""

    t_ns: _Time
    bus: str
    direction: Direction
    bytes: str  # hexadecimal
    note: str
    late_ns: _Time = 0


_encoder, _decoder = msgspec.json.Encoder(), msgspec.json.Decoder(_Line)


class Ledger:
    """Keeps entries in memory, in a JSON-lines file, or both; `keep=False` bounds the memory of long runs.

    The file is open for writing, and buffered: a busy bus has thousands of entries a second.
    `close` closes it. A full disk ends the file, never the simulation.
    """

    def __init__(self, file: IO[bytes] | None = None, *, keep: bool = True) -> None:
        self.entries: list[LedgerEntry] = []
        self.error: str | None = None  # Why the file is not complete; None: it is
        self.on_note: Callable[[str], None] | None = None  # Called with each note
        self._keep = keep
        self._file = file
        self._unflushed_ns: int | None = None

    def add(
        self,
        t_ns: int,
        bus: str,
        direction: Direction,
        data: bytes = b"",
        note: str = "",
        *,
        late_ns: int = 0,
    ) -> None:
        """Enter bytes or a note; `flush_if_due` brings it into a file, at the latest its end."""
        if self._keep:
            self.entries.append(LedgerEntry(t_ns, bus, direction, data, note, late_ns))
        if self._file is not None:
            if self._unflushed_ns is None:
                self._unflushed_ns = t_ns
            try:
                line = _Line(t_ns, bus, direction, data.hex(), note, late_ns)
                self._file.write(_encoder.encode(line) + b"\n")
            except OSError as error:
                self._give_up(error)
        if direction == "note" and self.on_note is not None:
            self.on_note(note)

    def flush_due_ns(self) -> int | None:
        """Return when the file must be flushed, ns on the clock of the entries; None: all is written."""
        return None if self._unflushed_ns is None else self._unflushed_ns + FLUSH_NS

    def flush_if_due(self, now_ns: int) -> None:
        """Write the file out when its oldest unwritten entry is half a second old."""
        due = self.flush_due_ns()
        if due is not None and now_ns >= due:
            self.flush()

    def flush(self) -> None:
        """Write the file out."""
        self._unflushed_ns = None
        if self._file is not None:
            try:
                self._file.flush()
            except OSError as error:
                self._give_up(error)

    def close(self) -> None:
        """Write the file out and close it; the entries in memory stay."""
        self.flush()
        if self._file is not None:
            self._file.close()
            self._file = None

    def _give_up(self, error: OSError) -> None:
        self.error = f"the ledger is not complete: {error}"
        self._unflushed_ns = None
        if self._file is not None:
            with contextlib.suppress(OSError):  # it tries once more to write what does not fit
                self._file.close()
            self._file = None

    def __enter__(self) -> Ledger:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def read_ledger(path: Path) -> tuple[LedgerEntry, ...]:
    """Return the entries of a ledger file; a last line that was cut off in writing is left out.

    Raises InputError when another line is not an entry, OSError when the file cannot be read.
    """
    lines = path.read_bytes().split(b"\n")
    complete = lines[:-1]  # what follows the last newline is empty, or was cut off
    entries: list[LedgerEntry] = []
    try:
        for line in complete:
            one = _decoder.decode(line)
            data = bytes.fromhex(one.bytes)
            entries.append(LedgerEntry(one.t_ns, one.bus, one.direction, data, one.note, one.late_ns))
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise InputError(
            f"{path} is not a ledger of a simulated bus: line {len(entries) + 1}: {error}"
        ) from error
    return tuple(entries)
