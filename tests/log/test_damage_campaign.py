"""A log that was cut, or has wrong bits or lengths, is read as far as it is whole, in bounded memory."""

import re
import tracemalloc
from dataclasses import dataclass
from pathlib import Path

import pytest
from mcap.records import Chunk
from mcap.stream_reader import StreamReader
from tests.kit.campaigns import campaign

from dxlrun.channels.logged_packets import PacketBatch
from dxlrun.channels.ring import Handover, RecordKind
from dxlrun.errors import LogError
from dxlrun.log.log_reader import LogReader, open_log
from dxlrun.log.log_writer import LogWriter
from dxlwire.packets import PacketKind

EVERY_BYTE = 100_000  # more than the log has
CHUNKS, CYCLES = 6, 4
"""Chunks of the log, and cycles of each."""
MOST_MEMORY = 24 << 20
"""Bytes: for a log of 20 kB."""
LENGTHS = (2**16, 2**24, 2**31 - 1, 2**32 - 1, 2**40, 2**63 - 1, 2**64 - 1)


@dataclass(frozen=True)
class Written:
    """A small log, and where its chunks lie."""

    data: bytes
    ends: tuple[int, ...]
    """The byte behind each chunk."""
    cycles: tuple[bytes, ...]

    def chunk_of(self, at: int) -> int | None:
        """Return which chunk a byte is in, or in the record before it."""
        return next((number for number, end in enumerate(self.ends) if at < end), None)


@pytest.fixture
def written(tmp_path, header, cycle):
    path = tmp_path / "written.mcap"
    log = LogWriter(path, header)
    batch = PacketBatch(Handover(log.write_record))
    cycles = [cycle(number) for number in range(CHUNKS * CYCLES)]
    for number, record in enumerate(cycles):
        batch.wake(number)
        batch.packet(0, PacketKind.INSTRUCTION, 1, number, number + 5, b"request")
        batch.packet(1, PacketKind.STATUS, 1, number, number + 9, bytes([number]))
        batch.commit_packets()
        log.write_record(RecordKind.CYCLE, record)
        if number % CYCLES == CYCLES - 1:
            log.finish_chunk()
    log.close()
    with path.open("rb") as stream:
        records = StreamReader(stream, emit_chunks=True).records
        ends = [stream.tell() for record in records if isinstance(record, Chunk)]
    assert len(ends) == CHUNKS
    return Written(path.read_bytes(), tuple(ends), tuple(cycles))


@pytest.fixture
def most_memory():
    tracemalloc.start()
    yield lambda: tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()


def read(path: Path, data: bytes) -> tuple[list[bytes], list[bytes], LogReader] | None:
    """Read all that can be; None: refused with one sentence."""
    path.write_bytes(data)
    refusal, parts = "", None
    try:
        reader = open_log(path)
        parts = [*reader.slices()]
        assert isinstance(reader.damage, tuple)
        assert reader.topics is not None
        reader.columns("/cycle", "cycle", "position")
    except LogError as error:
        refusal = str(error)
    assert re.fullmatch(f"({path}: .+)?", refusal)
    if parts is None:
        return None
    cycles = [row.tobytes() for part in parts for row in part.cycles]
    return cycles, [packet.data for part in parts for packet in part.packets], reader


@campaign(ci=100, night=2000, release=EVERY_BYTE)
def test_a_log_that_is_cut_at_any_byte_is_read_up_to_its_last_whole_chunk(written, tmp_path, amount, chance):
    first = written.data.index(b"dxlrun_msgs")  # before it there is no header yet
    every = range(len(written.data))
    for size in chance.sample(every, min(int(amount), len(every))):
        found = read(tmp_path / "cut.mcap", written.data[:size])
        whole = sum(end <= size for end in written.ends)
        if found is None:
            assert size < first or whole == 0, size
            continue
        assert found[0] == list(written.cycles[: whole * CYCLES]), size
        assert len(found[1]) == 2 * whole * CYCLES
        assert not found[2].about.complete
        if whole == CHUNKS:
            assert "ends early" in found[2].damage[-1]


@campaign(ci=60, night=1000, release=10_000)
def test_a_flipped_bit_costs_one_chunk_at_most(written, tmp_path, most_memory, amount, chance):
    for _ in range(int(amount)):
        at = chance.randrange(len(written.data))
        data = bytearray(written.data)
        data[at] ^= 1 << chance.randrange(8)
        found = read(tmp_path / "flipped.mcap", bytes(data))
        if found is None:
            assert at < written.ends[0], at
            continue
        cycles, _, reader = found
        missing = len(written.cycles) - len(cycles)
        assert set(cycles) <= set(written.cycles), at
        assert missing in (0, CYCLES), (at, reader.damage)
        if missing:
            hit = written.cycles.index(next(one for one in written.cycles if one not in cycles)) // CYCLES
            assert hit == written.chunk_of(at), (at, hit)
            assert reader.damage
    assert most_memory() < MOST_MEMORY


@pytest.mark.parametrize("opcode", [2, 7, 14, 0x46, 0])
def test_a_chunk_that_is_another_record_by_one_bit_is_missed(written, tmp_path, opcode):
    """A footer, an index, or a kind that no version knows: the file's statistics tell."""
    begin = written.data.index(b"\4\0\0\0zstd", written.ends[1]) - 37
    assert written.data[begin] == 6
    data = bytearray(written.data)
    data[begin] = opcode
    found = read(tmp_path / "other.mcap", bytes(data))
    assert found is not None
    assert found[0] == [*written.cycles[: 2 * CYCLES], *written.cycles[3 * CYCLES :]]
    assert (
        "of 24 messages of /cycle are missing" in found[2].damage[0] or "cannot be read" in found[2].damage[0]
    )


@campaign(ci=30, night=200, release=1000)
def test_a_wrong_length_takes_no_memory_and_costs_what_it_covers(
    written, tmp_path, most_memory, amount, chance
):
    for _ in range(int(amount)):
        size = chance.choice((4, 8))
        at = chance.randrange(8, len(written.data) - size)
        length = min(chance.choice(LENGTHS), 2 ** (8 * size) - 1)
        data = bytearray(written.data)
        data[at : at + size] = length.to_bytes(size, "little")
        found = read(tmp_path / "bomb.mcap", bytes(data))
        if found is not None:
            assert set(found[0]) <= set(written.cycles)
            assert len(found[0]) >= (CHUNKS - 2) * CYCLES, (at, length, found[2].damage)
    assert most_memory() < MOST_MEMORY
