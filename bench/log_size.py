"""Log size: where the bytes of a log are, a cycle; also what each topic takes when it is compressed alone.

dxlrun robots/bioloid_torso.yaml --virtual --play robots/motions/three_parts.yaml
python bench/log_size.py logs/*.mcap
"""

from __future__ import annotations

import sys
from collections import defaultdict
from pathlib import Path

import zstandard
from mcap.records import AttachmentIndex, Channel, Chunk, ChunkIndex, Message, MessageIndex
from mcap.stream_reader import StreamReader, breakup_chunk


def sizes(path: Path) -> tuple[int, dict[str, int]]:
    """Return the cycles of a log, and bytes by what they are for."""
    found: dict[str, int] = defaultdict(int)
    topics: dict[str, list[bytes]] = defaultdict(list)
    names: dict[int, str] = {}
    with path.open("rb") as stream:
        for record in StreamReader(stream, emit_chunks=True).records:
            if isinstance(record, Channel):
                names[record.id] = record.topic
            if not isinstance(record, Chunk):
                continue
            found["chunks"] += len(record.data) + 41
            found["chunks, not compressed"] += record.uncompressed_size
            parts: dict[str, list[bytes]] = defaultdict(list)
            for one in breakup_chunk(record):
                if isinstance(one, Channel):
                    names[one.id] = one.topic
                if isinstance(one, Message):
                    topics[names[one.channel_id]].append(b"")
                    parts[names[one.channel_id]].append(one.data)
            for topic, data in parts.items():
                found[f"  {topic} alone"] += len(zstandard.compress(b"".join(data)))
    with path.open("rb") as stream:
        for record in StreamReader(stream).records:
            if isinstance(record, AttachmentIndex):
                found[f"attachment {record.name}"] = record.length
            if isinstance(record, MessageIndex):
                found["message index"] += 15 + 16 * len(record.records)
            if isinstance(record, ChunkIndex):
                found["chunk index"] += 77 + 10 * len(record.message_index_offsets)
    found["file"] = path.stat().st_size
    return len(topics["/cycle"]), found


def main() -> None:
    """Print the sizes of logs."""
    for path in map(Path, sys.argv[1:]):
        cycles, found = sizes(path)
        print(f"{path.name}: {cycles} cycles; bytes, and bytes a cycle")
        for what, count in found.items():
            print(f"  {what:40} {count:10} {count / cycles:8.1f}")


if __name__ == "__main__":
    main()
