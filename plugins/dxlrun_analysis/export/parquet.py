"""Parquet export: a directory with a file for cycles, packets, events, commands and each topic."""

from __future__ import annotations

import re
from contextlib import ExitStack
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from dxlrun import LogReader
from dxlrun.tooling.topics import BUS_PREFIX
from dxlrun_analysis.export.arrow_tables import PACKETS, tables_of

_NAMES = {"/cycle": "cycles"}
_ODD = re.compile(r"[^\w.-]|^\.")
"""Characters of a topic name that are replaced in its file name. Logs of other programs can have them."""
_LONGEST = 100  # Characters of a file name, which has at most 255 bytes of UTF-8 with its suffix
_GROUP_BYTES = 32 << 20  # Size of a table in memory that is written as one row group


def write_parquet(reader: LogReader, directory: Path) -> int:
    """Write all tables of a log as Parquet files into a new directory; return their number of rows.

    Memory does not grow with the log.

    Raises:
        LogError: The log cannot be read.
        OSError: A file cannot be written.
    """
    count = 0
    writers: dict[str, pq.ParquetWriter] = {}
    waiting: dict[str, list[pa.Table]] = {}
    directory.mkdir(parents=True)
    with ExitStack() as files:

        def flush(name: str) -> None:
            table = pa.concat_tables(waiting.pop(name)).unify_dictionaries().combine_chunks()
            if name not in writers:
                file = directory / file_name(name)
                if file.exists():  # Another topic has the same file name after characters were replaced
                    file = file.with_suffix(f".{len(writers)}.parquet")
                writers[name] = files.enter_context(pq.ParquetWriter(file, table.schema, compression="zstd"))
            writers[name].write_table(table)

        for rows in tables_of(reader.slices()):
            count += len(rows.table)
            waiting.setdefault(rows.name, []).append(rows.table)
            if sum(table.nbytes for table in waiting[rows.name]) >= _GROUP_BYTES:
                flush(rows.name)
        for name in tuple(waiting):
            flush(name)
    return count


def has_file(directory: Path, topic: str) -> bool:
    """Return whether a directory has the file of a topic's table. The packets of all buses share one."""
    table = PACKETS if topic.startswith(BUS_PREFIX) else topic
    return (directory / file_name(table)).exists()


def file_name(topic: str) -> str:
    """Return the name of the Parquet file of a topic: `arm.error.parquet` for `/arm/error`."""
    name = _NAMES.get(topic, topic.strip("/").replace("/", "."))
    return f"{_ODD.sub('_', name)[:_LONGEST] or '_'}.parquet"
