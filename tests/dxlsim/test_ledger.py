from __future__ import annotations

from pathlib import Path
from typing import IO

import pytest

from dxlsim.bus.ledger import FLUSH_NS, Ledger, LedgerEntry, read_ledger
from dxlwire.exceptions import InputError

ENTRIES = (
    LedgerEntry(5, "main", "in", b"\xff\xff\x01", ""),
    LedgerEntry(7, "arm", "out", b"", "echo"),
    LedgerEntry(9, "main", "note", b"", 'a "note", and more\n'),
)


def opened(path: Path) -> IO[bytes]:
    return path.open("wb", 1 << 16)


def fill(ledger: Ledger) -> None:
    for each in ENTRIES:
        ledger.add(each.t_ns, each.bus, each.direction, each.data, each.note)


def test_a_file_gives_back_what_was_entered(tmp_path):
    with Ledger(opened(tmp_path / "bus.jsonl"), keep=False) as ledger:
        fill(ledger)
        assert ledger.entries == []
    assert read_ledger(tmp_path / "bus.jsonl") == ENTRIES


def test_memory_holds_the_same(tmp_path):
    ledger = Ledger()
    fill(ledger)
    ledger.close()
    assert tuple(ledger.entries) == ENTRIES


def test_it_is_written_out_half_a_second_after_the_oldest_entry(tmp_path):
    path = tmp_path / "bus.jsonl"
    with Ledger(opened(path)) as ledger:
        assert ledger.flush_due_ns() is None
        fill(ledger)
        assert ledger.flush_due_ns() == 5 + FLUSH_NS
        ledger.flush_if_due(5 + FLUSH_NS - 1)
        assert path.read_bytes() == b""
        ledger.flush_if_due(5 + FLUSH_NS)
        assert ledger.flush_due_ns() is None
        assert read_ledger(path) == ENTRIES


def test_a_line_that_was_cut_off_is_left_out(tmp_path):
    path = tmp_path / "bus.jsonl"
    with Ledger(opened(path)) as ledger:
        fill(ledger)
    path.write_bytes(path.read_bytes()[:-3])
    assert read_ledger(path) == ENTRIES[:2]


def entry(t_ns: object, late_ns: object = 0, note: str = "") -> str:
    return f'{{"t_ns":{t_ns},"bus":"m","direction":"in","bytes":"","note":"{note}","late_ns":{late_ns}}}'


@pytest.mark.parametrize(
    "line",
    [
        "{",
        "[]",
        "null",
        '{"t_ns": 1}',
        '{"t_ns":1,"bus":"m","direction":"up","bytes":"","note":""}',
        '{"t_ns":1,"bus":"m","direction":"in","bytes":"f","note":""}',
        "[" * 100_000,
        entry("Infinity"),
        entry("NaN"),
        entry(10**30),
        entry(1, -(10**30)),
    ],
)
def test_another_file_is_refused_by_name_and_line(tmp_path, line):
    path = tmp_path / "other.jsonl"
    path.write_text(f"{entry(1)}\n{line}\n{entry(2)}\n")
    with pytest.raises(InputError, match=r"other\.jsonl is not a ledger of a simulated bus: line 2: "):
        read_ledger(path)


def test_bytes_that_are_no_text_are_refused(tmp_path):
    path = tmp_path / "other.jsonl"
    path.write_bytes(entry(1, note="X").encode().replace(b"X", b"\xff") + b"\n")
    with pytest.raises(InputError, match=r"other\.jsonl is not a ledger of a simulated bus: line 1: "):
        read_ledger(path)


def test_a_full_disk_ends_the_file_and_not_the_simulation():
    with Ledger(opened(Path("/dev/full"))) as ledger:
        fill(ledger)
        assert ledger.error is None
        ledger.flush_if_due(5 + FLUSH_NS)
        assert "No space left" in str(ledger.error)
        ledger.add(10, "main", "in", b"more")
        assert ledger.flush_due_ns() is None
    assert tuple(ledger.entries[:-1]) == ENTRIES


def test_a_disk_that_fills_while_entries_are_added_ends_the_file_too():
    with Ledger(opened(Path("/dev/full")), keep=False) as ledger:
        for t_ns in range(1000):  # beyond the buffer of the file
            ledger.add(t_ns, "main", "in", bytes(100))
        assert "No space left" in str(ledger.error)


def test_what_does_not_fit_at_the_end_is_reported():
    ledger = Ledger(opened(Path("/dev/full")))
    fill(ledger)
    ledger.close()
    assert "No space left" in str(ledger.error)
