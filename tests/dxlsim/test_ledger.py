"""The ledger of a bus: what was entered is in its file, whatever becomes of the disk."""

from pathlib import Path

import pytest

from dxlsim.bus.ledger import FLUSH_NS, Ledger, LedgerEntry, read_ledger
from dxlsim.wire import compiled_line
from dxlwire.exceptions import InputError, NotCompiled

ENTRIES = (
    LedgerEntry(5, "main", "in", b"\xff\xff\x01", ""),
    LedgerEntry(7, "arm", "out", b"", "echo"),
    LedgerEntry(9, "main", "note", b"", 'a "note", and more\n'),
)


def filled(path: Path | None = None, *, keep: bool = True) -> Ledger:
    ledger = Ledger(path.open("wb", 1 << 16), keep=keep) if path else Ledger()
    for each in ENTRIES:
        ledger.add(each.t_ns, each.bus, each.direction, each.data, each.note)
    return ledger


def test_file_and_memory_give_back_what_was_entered(tmp_path):
    path = tmp_path / "bus.jsonl"
    with filled(path, keep=False) as ledger:
        assert ledger.entries == []
    assert read_ledger(path) == ENTRIES
    assert tuple(filled().entries) == ENTRIES
    path.write_bytes(path.read_bytes()[:-3])  # a line that was cut off is left out
    assert read_ledger(path) == ENTRIES[:2]


def test_it_is_written_out_half_a_second_after_the_oldest_entry(tmp_path):
    path = tmp_path / "bus.jsonl"
    assert Ledger().flush_due_ns() is None
    with filled(path) as ledger:
        assert ledger.flush_due_ns() == 5 + FLUSH_NS
        ledger.flush_if_due(5 + FLUSH_NS - 1)
        assert path.read_bytes() == b""
        ledger.flush_if_due(5 + FLUSH_NS)
        assert ledger.flush_due_ns() is None
        assert read_ledger(path) == ENTRIES


def entry(t_ns: object, late_ns: object = 0, note: str = "") -> bytes:
    text = f'{{"t_ns":{t_ns},"bus":"m","direction":"in","bytes":"","note":"{note}","late_ns":{late_ns}}}'
    return text.encode().replace(b"?", b"\xff")


@pytest.mark.parametrize(
    "line",
    [
        b"{",
        b"[]",
        b"null",
        b'{"t_ns": 1}',
        b'{"t_ns":1,"bus":"m","direction":"up","bytes":"","note":""}',
        b'{"t_ns":1,"bus":"m","direction":"in","bytes":"f","note":""}',
        b"[" * 100_000,
        entry("Infinity"),
        entry("NaN"),
        entry(10**30),
        entry(1, -(10**30)),
        entry(1, note="?"),
    ],
)
def test_another_file_is_refused_by_name_and_line(tmp_path, line):
    path = tmp_path / "other.jsonl"
    path.write_bytes(b"\n".join((entry(1), line, entry(2), b"")))
    with pytest.raises(InputError, match=r"other\.jsonl is not a ledger of a simulated bus: line 2: "):
        read_ledger(path)


def test_a_full_disk_ends_the_file_and_not_the_simulation():
    with filled(Path("/dev/full")) as ledger:
        assert ledger.error is None
        ledger.flush_if_due(5 + FLUSH_NS)
        assert "No space left" in str(ledger.error)
        ledger.add(10, "main", "in", b"more")
        assert ledger.flush_due_ns() is None
    assert tuple(ledger.entries[:-1]) == ENTRIES


@pytest.mark.parametrize("more", [0, 1000], ids=["at the end", "while entries are added"])
def test_a_full_disk_is_reported(more):
    ledger = filled(Path("/dev/full"))
    for t_ns in range(more):  # beyond the buffer of the file
        ledger.add(t_ns, "main", "in", bytes(100))
    assert ("No space left" in str(ledger.error)) == bool(more)
    ledger.close()
    assert "No space left" in str(ledger.error)


def test_without_the_compiled_line_it_fails_at_once_and_not_at_its_end(monkeypatch):
    def missing() -> None:
        raise NotCompiled("missing")

    monkeypatch.setattr(compiled_line, "line_library", missing)
    with pytest.raises(NotCompiled):
        Ledger()
