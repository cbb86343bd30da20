"""Parquet: a directory with a file for cycles, packets, events, commands, and each topic of controllers."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from contextlib import ExitStack
from pathlib import Path
from types import MappingProxyType, TracebackType

import pyarrow as pa
import pyarrow.parquet as pq

from dxlrun.log.reader import LogReader
from dxlrun_analysis.export.tables import LogTables, Rows

_NAMES = {"/cycle": "cycles"}
_ODD = re.compile(r"[^\w.-]|^\.")
"""What a log that others made may have in a topic's name, and a file's name better has not."""
_LONGEST = 100
"""Characters of a file's name: 255 bytes of UTF-8, and its suffix."""
_GROUP_BYTES = 32 << 20
"""Of a table in memory; so much becomes one row group."""


def write_parquet(reader: LogReader, directory: Path) -> int:
    """Write all tables of a log into a directory that is made; return how many rows they have.

    Raises LogError when the log cannot be read, OSError when the files cannot be written.
    """
    tables = LogTables()
    with ParquetDirectory(directory) as files:
        for part in reader.slices():
            files.write(tables.take(part))
        files.write(tables.finish())
    return files.count


class ParquetDirectory:
    """Writes tables into the Parquet files of a directory, in memory that does not grow with them."""

    def __init__(self, directory: Path, schemas: Mapping[str, pa.Schema] = MappingProxyType({})) -> None:
        """Write into a directory that is made; the tables of `schemas` by name even without rows."""
        directory.mkdir(parents=True)
        self._directory = directory
        self._schemas = schemas
        self._writers: dict[str, pq.ParquetWriter] = {}
        self._waiting: dict[str, list[pa.Table]] = {
            name: [schema.empty_table()] for name, schema in schemas.items()
        }
        self._stack = ExitStack()
        self.count = 0
        """Rows that were taken."""

    def write(self, found: Iterable[Rows]) -> None:
        """Take rows; they are in the files at the end of the context. Raises OSError."""
        for rows in found:
            self.count += len(rows.table)
            waiting = self._waiting.setdefault(rows.name, [])
            schema = self._schemas.get(rows.name)
            waiting.append(rows.table if schema is None else rows.table.cast(schema))
            if sum(table.nbytes for table in waiting) >= _GROUP_BYTES:
                self._flush(rows.name)

    def __enter__(self) -> ParquetDirectory:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Write what is left, and finish the files. Raises OSError."""
        with self._stack:
            for name in self._waiting if error is None else ():
                self._flush(name)

    def _flush(self, name: str) -> None:
        tables = self._waiting[name]
        if not tables:
            return
        table = pa.concat_tables(tables).unify_dictionaries().combine_chunks()
        if name not in self._writers:
            file = self._directory / file_name(name)
            if file.exists():  # of another topic, whose name differs in what a file's name cannot have
                file = file.with_suffix(f".{len(self._writers)}.parquet")
            self._writers[name] = self._stack.enter_context(
                pq.ParquetWriter(file, table.schema, compression="zstd")
            )
        self._writers[name].write_table(table)
        tables.clear()


def file_name(topic: str) -> str:
    """Return the file of a topic: `cycles.parquet`, `arm.error.parquet` for `/arm/error`."""
    name = _NAMES.get(topic, topic.strip("/").replace("/", "."))
    return f"{_ODD.sub('_', name)[:_LONGEST] or '_'}.parquet"
