"""Arrow: converts the messages of a topic to Arrow data; nested messages are structs, sequences lists."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from dxlrun.messages.cdr_columns import ColumnReader, FieldColumn
from dxlrun.messages.definition import (
    PRIMITIVES,
    Definitions,
    MessageField,
    MessageType,
    parse,
    short_name,
)


def schema_of(reader: ColumnReader, fields: Sequence[str] | None) -> pa.Schema:
    """Return the Arrow schema of a topic: `t_ns`, and the chosen fields, or all for None."""
    top, definitions = short_name(reader.message.name), reader.definitions
    if fields is None:
        fields = [one.name for one in definitions[top]]
    chosen = [(place, _type_at(definitions, top, place)) for place in fields]
    return pa.schema([("t_ns", pa.int64()), *chosen])


def batch_of(schema: pa.Schema, t_ns: NDArray[np.int64], tree: FieldColumn) -> pa.RecordBatch:
    """Convert decoded messages and their times to an Arrow record batch."""
    columns = [_array(tree.leaf(name), schema.field(name).type) for name in schema.names[1:]]
    return pa.record_batch([pa.array(t_ns), *columns], schema=schema)


def type_of(one: MessageField, definitions: Definitions) -> pa.DataType:
    """Return the Arrow type of one field of a message."""
    if one.kind in definitions:
        inside: pa.DataType = struct_of(one.kind, definitions)
    elif one.kind == "string":
        inside = pa.string()
    else:
        inside = pa.from_numpy_dtype(np.dtype(PRIMITIVES[one.kind]))
    return pa.list_(inside) if one.sequence or one.length else inside


def message_struct(message: MessageType) -> pa.DataType:
    """Return the Arrow struct type of a message type."""
    return struct_of(short_name(message.name), parse(message))


def struct_of(message: str, definitions: Definitions) -> pa.DataType:
    """Return the Arrow struct type of a message, by its short name in `definitions`."""
    return pa.struct([(field.name, type_of(field, definitions)) for field in definitions[message]])


def _type_at(definitions: Definitions, message: str, place: str) -> pa.DataType:
    name, _, rest = place.partition(".")
    one = next(field for field in definitions[message] if field.name == name)
    if not rest:
        return type_of(one, definitions)
    inside = _type_at(definitions, one.kind, rest)
    return pa.list_(inside) if one.sequence or one.length else inside


def _array(column: FieldColumn, kind: pa.DataType) -> pa.Array:
    if column.values is not None:
        return pa.array(column.values, type=kind)
    if column.counts is not None and column.elements is not None:
        offsets = np.concatenate((np.zeros(1, np.int64), np.cumsum(column.counts))).astype(np.int32)
        return pa.ListArray.from_arrays(offsets, _array(column.elements, kind.value_type), type=kind)
    children = [_array(column.fields[field.name], field.type) for field in kind]
    return pa.StructArray.from_arrays(children, fields=list(kind))
