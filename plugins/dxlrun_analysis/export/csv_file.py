"""CSV export: the records of one topic of a log, a line for each record, column names in the first line."""

from __future__ import annotations

import json
from pathlib import Path

import pyarrow as pa
from pyarrow import csv

from dxlrun import LogError, LogReader
from dxlrun.tooling.files import suggestion
from dxlrun.tooling.topics import bus_topic
from dxlrun_analysis.export.arrow_tables import COMMANDS, CYCLES, EVENTS, WITHOUT_TABLE, tables_of


def write_csv(reader: LogReader, target: Path, topic: str) -> int:
    """Write the records of one topic of a log to a CSV file. Unknown values are empty, bytes are hexadecimal.

    Returns:
        Number of records.

    Raises:
        LogError: The log cannot be read, or has no records of the topic.
        OSError: The file cannot be written.
    """
    writer: csv.CSVWriter | None = None
    count = 0
    try:
        for rows in tables_of(reader.slices(), frozenset((topic,))):
            plain = pa.table({name: _plain(rows.table.column(name)) for name in rows.table.column_names})
            writer = writer or csv.CSVWriter(str(target), plain.schema)
            writer.write_table(plain)
            count += len(plain)
    finally:
        if writer is not None:
            writer.close()
    if writer is None:
        if topic in WITHOUT_TABLE:
            raise LogError(f"{reader.path}: {topic} has no table: {WITHOUT_TABLE[topic]}")
        about = reader.about
        others = {*about.topics, *map(bus_topic, about.buses), CYCLES, EVENTS, COMMANDS} - {topic}
        raise LogError(f"{reader.path}: no records of {topic}; {suggestion(topic, sorted(others))}")
    return count


def _plain(column: pa.ChunkedArray) -> pa.ChunkedArray:
    """Convert an Arrow column to a form that CSV can hold: lists as JSON, bytes in hexadecimal."""
    kind = column.type
    if pa.types.is_dictionary(kind):
        return column.cast(kind.value_type)
    if pa.types.is_binary(kind):
        return pa.chunked_array([[value.hex() for value in column.to_pylist()]], pa.string())
    if pa.types.is_list(kind):
        return pa.chunked_array([[json.dumps(value) for value in column.to_pylist()]], pa.string())
    return column
