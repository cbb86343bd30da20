"""Ledger of simulated buses: every byte between host and servos with its time, and every fault. The
runtime cannot edit it."""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Callable
from ctypes import byref, string_at
from pathlib import Path
from typing import IO, Annotated, Literal, NamedTuple

import msgspec

from dxlsim.wire.compiled_line import line_library, new_ledger
from dxlwire.exceptions import InputError

Direction = Literal["in", "out", "note"]

FLUSH_NS = 500_000_000  # Longest time before an entry is written to the file


FAULT = "fault: "  # Prefix of the note of a fault; the fault's text follows


class LedgerEntry(NamedTuple):
    """One entry of the ledger: bytes that passed the wire together, or a note about an action on the bus."""

    # `in`: time at which the host wrote them; `out`: time at which the last byte had passed the wire
    t_ns: int
    bus: str
    direction: Direction  # As seen from the servos: `in` came from the host, `out` went to the host
    data: bytes
    note: str
    late_ns: int = 0  # `out`, in real time: delay until the host got the last byte


# Range of 73 years on the machine's clock; the difference of two such times fits into 64 bits.
_Time = Annotated[int, msgspec.Meta(ge=-(1 << 62), le=1 << 62)]


class _Line(msgspec.Struct, omit_defaults=True):
    """One ledger entry as a line of the JSON-lines file; a busy bus has thousands of them per second."""

    t_ns: _Time
    bus: str
    direction: Direction
    bytes: str  # hexadecimal
    note: str
    late_ns: _Time = 0


_RECORD = struct.Struct("<3q4i")
"""Head of an entry in the line's ledger, before note and data: time, lateness, size of the data; bus,
direction, size of the note, unused."""
_MOST_HELD = 1 << 18  # Bytes that the line holds while a file is written
_DIRECTIONS: tuple[Direction, Direction] = ("in", "out")  # In the order of line.c


_encoder, _decoder = msgspec.json.Encoder(), msgspec.json.Decoder(_Line)


class Ledger:
    """Writes the entries of simulated buses to memory, a JSON-lines file, or both; `keep=False` bounds the
    memory of long runs.

    Args:
        file: File open for buffered writing: a busy bus has thousands of entries per second. `close`
            closes it. A full disk ends the file, never the simulation.
        keep: Keep the entries in memory.
    """

    def __init__(self, file: IO[bytes] | None = None, *, keep: bool = True) -> None:
        self._entries: list[LedgerEntry] = []
        self.error: str | None = None  # Reason why the file is incomplete; None: it is complete
        self.on_note: Callable[[str], None] | None = None  # Called with each note
        self._keep = keep
        self._file = file
        self._unflushed_ns: int | None = None
        self._buses: list[str] = []
        self.state = new_ledger(self)
        """State that the lines use: the entries that they have added, and how many they may hold."""
        self.state.on = keep or file is not None
        self.state.most = 0 if file is None else _MOST_HELD

    @property
    def entries(self) -> list[LedgerEntry]:
        """The entries in memory."""
        self.take_entries()
        return self._entries

    def add_bus(self, name: str) -> int:
        """Return the number under which the line of a bus adds entries."""
        self._buses.append(name)
        return len(self._buses) - 1

    def take_entries(self) -> None:
        """Take the entries that the lines have added since the last call."""
        held = self.state.entries
        if not held.size:
            return
        data, at = string_at(held.data, held.size), 0
        line_library().line_forget(byref(self.state))
        while at < len(data):
            t_ns, late_ns, size, bus, direction, noted, _ = _RECORD.unpack_from(data, at)
            at += _RECORD.size
            note = data[at : at + noted].decode()
            at += noted + size
            self._append(
                LedgerEntry(
                    t_ns, self._buses[bus], _DIRECTIONS[direction], data[at - size : at], note, late_ns
                )
            )

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
        """Add an entry with bytes or a note. `flush_if_due` or `close` makes sure that it is in the file."""
        self.take_entries()
        self._append(LedgerEntry(t_ns, bus, direction, data, note, late_ns))
        if direction == "note" and self.on_note is not None:
            self.on_note(note)

    def _append(self, entry: LedgerEntry) -> None:
        if self._keep:
            self._entries.append(entry)
        if self._file is not None:
            if self._unflushed_ns is None:
                self._unflushed_ns = entry.t_ns
            try:
                line = _Line(*entry[:3], entry.data.hex(), entry.note, entry.late_ns)
                self._file.write(_encoder.encode(line) + b"\n")
            except OSError as error:
                self._give_up(error)

    def flush_due_ns(self) -> int | None:
        """Return the time by which the file must be flushed, ns on the clock of the entries; None if
        nothing is unwritten."""
        if self._file is not None:
            self.take_entries()
        return None if self._unflushed_ns is None else self._unflushed_ns + FLUSH_NS

    def flush_if_due(self, now_ns: int) -> None:
        """Flush the file if its oldest unwritten entry is at least half a second old at `now_ns`."""
        due = self.flush_due_ns()
        if due is not None and now_ns >= due:
            self.flush()

    def flush(self) -> None:
        """Write all entries that are buffered to the file."""
        self.take_entries()
        self._unflushed_ns = None
        if self._file is not None:
            try:
                self._file.flush()
            except OSError as error:
                self._give_up(error)

    def close(self) -> None:
        """Flush and close the file; the entries in memory stay."""
        self.flush()
        if self._file is not None:
            self._file.close()
            self._file = None

    def _give_up(self, error: OSError) -> None:
        self.error = f"the ledger is not complete: {error}"
        self._unflushed_ns = None
        if self._file is not None:
            with contextlib.suppress(OSError):  # Closing tries once more to write the data that does not fit
                self._file.close()
            self._file = None

    def __enter__(self) -> Ledger:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def read_ledger(path: Path) -> tuple[LedgerEntry, ...]:
    """Return the entries of a ledger file, without a truncated last line.

    Raises:
        InputError: Another line is not an entry.
        OSError: The file cannot be read.
    """
    lines = path.read_bytes().split(b"\n")
    complete = lines[:-1]  # The text after the last newline is empty or truncated
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
