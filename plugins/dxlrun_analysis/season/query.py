"""Questions to a table of runs in SQL, by DuckDB.

A statement only reads: one SELECT, no file but the table, no extension, no setting.
"""

from __future__ import annotations

import atexit
import gc
import re
from collections.abc import Sequence
from decimal import Decimal
from typing import NamedTuple

import duckdb
import pyarrow as pa

from dxlrun.errors import InputError

atexit.register(gc.unfreeze)  # at its end DuckDB prints what of it is not collected, and the cli freezes all
TABLE = "logs"
Value = object


class Answer(NamedTuple):
    """Rows with the names of their columns."""

    columns: tuple[str, ...]
    rows: tuple[tuple[Value, ...], ...]


def ask(runs: pa.Table, statement: str, option: str) -> Answer:
    """Return the answer to a SELECT over the table `logs`.

    Raises InputError with one sentence about a wrong statement, which `option` of the command line has given.
    """
    try:
        kinds = [one.type for one in duckdb.extract_statements(statement)]
        if kinds != [duckdb.StatementType.SELECT]:
            raise InputError(f"{option}: it may only read, in one statement; write a single SELECT")
        with duckdb.connect(":memory:") as database:
            database.register(TABLE, runs)
            for setting in (
                "autoinstall_known_extensions",
                "autoload_known_extensions",
                "python_enable_replacements",
                "enable_external_access",
            ):
                database.execute(f"SET {setting} = false")
            database.execute("SET lock_configuration = true")
            found = database.execute(statement)
            columns = _distinct([column[0] for column in found.description or ()])
            return Answer(columns, tuple(tuple(map(_plain, row)) for row in found.fetchall()))
    except duckdb.Error as error:
        raise InputError(f"{option}: {_reason(error)}; {TABLE} has {', '.join(runs.column_names)}") from error


def where(condition: str, sort: str) -> str:
    """Return the statement for the logs that meet a condition, in an order; without both all by name."""
    chosen = f" WHERE ({condition}\n)" if condition else ""
    return f"SELECT * FROM {TABLE}{chosen} ORDER BY {sort or 'log'}"  # noqa: S608  # `ask` lets it only read


def _distinct(names: Sequence[str]) -> tuple[str, ...]:
    """Return names of columns of which no two are the same: `lost` and `lost_2`."""
    found: list[str] = []
    for name in names:
        number = 1
        distinct = name
        while distinct in found:
            number += 1
            distinct = f"{name}_{number}"
        found.append(distinct)
    return tuple(found)


def _plain(value: Value) -> Value:
    """Return a value as JSON has it too: a decimal number, as of `sum(lost) * 1.5`, is a number."""
    return float(value) if isinstance(value, Decimal) else value


def _reason(error: duckdb.Error) -> str:
    """Return what is wrong in a line, without the kind of error, candidates and the place."""
    first = str(error).strip().splitlines()[0]
    return re.sub(r"^\w+( \w+)* Error: ", "", first).rstrip("!. ")
