"""CSV: one topic of a log, a line for each of its records, the names of the columns in the first."""

from __future__ import annotations

import json
from pathlib import Path

import pyarrow as pa
from pyarrow import csv

from dxlrun.errors import LogError, suggestion
from dxlrun.log.reader import LogReader
from dxlrun_analysis.export.tables import LogTables


def write_csv(reader: LogReader, target: Path, topic: str) -> int:
    """Write the records of a topic; return how many. What is not known is empty, bytes are hexadecimal.

    Raises LogError when the log cannot be read, or has no such records; OSError.
    """
    tables = LogTables(only=frozenset((topic,)))
    others: set[str] = set()
    writer: csv.CSVWriter | None = None
    count = 0
    try:
        for part in reader.slices():
            others |= {name for name, logged in part.topics.items() if logged.data}
            others |= {f"/bus/{bus}" for bus in part.buses} | {"/cycle", "/events", "/commands"}
            for rows in tables.take(part):
                count += len(rows.table)
                writer = _write(writer, target, rows.table)
        for rows in tables.finish():
            count += len(rows.table)
            writer = _write(writer, target, rows.table)
    finally:
        if writer is not None:
            writer.close()
    if writer is None:
        known = sorted(others - {topic})
        raise LogError(f"{reader.path}: it has no records of {topic}; {suggestion(topic, known)}")
    return count


def _write(writer: csv.CSVWriter | None, target: Path, table: pa.Table) -> csv.CSVWriter:
    plain = pa.table({name: _plain(table.column(name)) for name in table.column_names})
    if writer is None:
        writer = csv.CSVWriter(str(target), plain.schema)
    writer.write_table(plain)
    return writer


def _plain(column: pa.ChunkedArray) -> pa.ChunkedArray:
    """Return a column as CSV can hold it: lists as JSON, bytes in hexadecimal."""
    kind = column.type
    if pa.types.is_dictionary(kind):
        return column.cast(kind.value_type)
    if pa.types.is_binary(kind):
        return pa.chunked_array([[value.hex() for value in column.to_pylist()]], pa.string())
    if pa.types.is_list(kind):
        return pa.chunked_array([[json.dumps(value) for value in column.to_pylist()]], pa.string())
    return column
