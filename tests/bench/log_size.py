"""What a cycle costs in a log: bytes of each kind of record, and messages of each topic.

    python tests/bench/log_size.py LOG...

For example of runs of 20 s: `dxlrun robots/humanoid_20.yaml --duration 20`, with `--virtual` or in real time,
where times are less regular and compress worse.
"""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path

import zstandard
from mcap.records import Chunk, Message, MessageIndex, Statistics
from mcap.stream_reader import StreamReader, breakup_chunk

LEVEL = 3


def main(paths: list[str]) -> None:
    """Print a table for each log."""
    for path in paths:
        measure(Path(path))


def measure(path: Path) -> None:
    """Print bytes a cycle: of the file, of its chunks and of their index, and of each topic by itself."""
    kinds: Counter[str] = Counter()
    topics: dict[int, str] = {}
    counts: Counter[int] = Counter()
    bodies: dict[int, list[bytes]] = {}
    with path.open("rb") as stream:
        at = stream.seek(8)
        stream.seek(0)
        for record in StreamReader(stream, emit_chunks=True).records:
            size, at = stream.tell() - at, stream.tell()
            if isinstance(record, Chunk | MessageIndex):
                kinds[type(record).__name__] += size
            if isinstance(record, Chunk):
                for inner in breakup_chunk(record):
                    if isinstance(inner, Message):
                        counts[inner.channel_id] += 1
                        bodies.setdefault(inner.channel_id, []).append(inner.data)
            elif hasattr(record, "topic"):
                topics[record.id] = record.topic
            elif isinstance(record, Statistics):
                assert record.message_count == counts.total()
    cycles = next(counts[channel] for channel, topic in topics.items() if topic == "/cycle")
    whole = path.stat().st_size
    rest = whole - kinds.total()
    print(f"{path.name}: {whole} bytes, {cycles} cycles, {whole / cycles:.1f} bytes a cycle")
    for name, size in [*sorted(kinds.items()), ("everything else", rest)]:
        print(f"  {name:24}{size / cycles:10.1f} bytes a cycle {100 * size / whole:6.1f} %")
    for channel, count in counts.most_common():
        body = b"".join(bodies[channel])
        alone = len(zstandard.compress(body, LEVEL))
        print(
            f"  {topics[channel]:24}{count / cycles:10.3f} messages a cycle "
            f"{len(body) / cycles:8.1f} bytes, compressed alone {alone / cycles:6.1f}"
        )


if __name__ == "__main__":
    main(sys.argv[1:])
