"""Questions to a season in SQL: DuckDB over the Parquet files of its logs, larger than memory.

A statement only reads: one SELECT, no file but the season's tables, no extension, no setting.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path

import duckdb

from dxlrun.errors import InputError
from dxlrun_analysis.season.conversion import SCHEMAS
from dxlrun_analysis.season.season import Season

TABLES = tuple(SCHEMAS)
_SPILL = "spill"
Value = object


@dataclass(frozen=True, slots=True)
class Answer:
    """Rows with the names of their columns."""

    columns: tuple[str, ...]
    rows: tuple[tuple[Value, ...], ...]


def ask(season: Season, statement: str, option: str) -> Answer:
    """Return the answer to a SELECT over the tables of a season.

    Raises InputError with one sentence about a wrong statement, which `option` of the command line has given.
    """
    try:
        kinds = [one.type for one in duckdb.extract_statements(statement)]
        if kinds != [duckdb.StatementType.SELECT]:
            raise InputError(f"{option}: it may only read, in one statement; write a single SELECT")
        with _opened(season) as database:
            found = database.execute(statement)
            columns = _distinct([column[0] for column in found.description or ()])
            return Answer(columns, tuple(tuple(map(_plain, row)) for row in found.fetchall()))
    except duckdb.Error as error:
        raise InputError(f"{option}: {_reason(error)}; {_known(statement)}") from error


def where(condition: str, sort: str) -> str:
    """Return the statement for the logs that meet a condition, in an order; without both all by name."""
    chosen = f" WHERE ({condition}\n)" if condition else ""
    return f"SELECT * FROM logs{chosen} ORDER BY {sort or 'log'}"  # noqa: S608  # `ask` lets it only read


@contextmanager
def _opened(season: Season) -> Iterator[duckdb.DuckDBPyConnection]:
    """Give a database with the tables as views; nothing else can be read or written by it."""
    folders = {name: folder.absolute() for name, folder in season.tables.items()}
    with duckdb.connect(":memory:") as database:
        database.execute("CREATE TABLE found (log VARCHAR, folder VARCHAR, problem VARCHAR)")
        rows = [
            *((name, str(folder), None) for name, folder in folders.items()),
            *((name, None, problem) for name, problem in season.problems.items()),
        ]
        database.executemany("INSERT INTO found VALUES (?, ?, ?)", rows)
        places = sorted({folder.parent for folder in folders.values()})
        for place in places[:1]:
            database.execute(f"SET temp_directory = {_text(str(place / _SPILL))}")
        for setting in ("autoinstall_known_extensions", "autoload_known_extensions"):
            database.execute(f"SET {setting} = false")
        allowed = ", ".join(_text(f"{place}/") for place in places)
        database.execute(f"SET allowed_directories = [{allowed}]")
        database.execute("SET enable_external_access = false")
        for name in TABLES:
            _view(database, name, list(folders.values()))
        database.execute("SET lock_configuration = true")
        yield database


def _view(database: duckdb.DuckDBPyConnection, name: str, folders: Sequence[Path]) -> None:
    if not folders:
        types = {"string": "VARCHAR", "int64": "BIGINT", "double": "DOUBLE", "bool": "BOOLEAN"}
        empty = ", ".join(
            f"NULL::{types.get(str(column.type), 'TIMESTAMP')} AS {column.name}" for column in SCHEMAS[name]
        )
        stored = f"(SELECT NULL::VARCHAR AS filename, {empty} LIMIT 0)"
    else:
        files = ", ".join(_text(str(folder / f"{name}.parquet")) for folder in dict.fromkeys(folders))
        stored = f"read_parquet([{files}], filename = true)"
    columns = ", ".join(f"t.{column.name}" for column in SCHEMAS[name])
    joined = f"found f JOIN {stored} t ON t.filename = f.folder || '/{name}.parquet'"
    statement = f"SELECT f.log, {columns} FROM {joined}"  # noqa: S608  # names of our own
    if name == "logs":  # those that could not be converted have a row too
        columns = ", ".join(
            "f.problem" if column.name == "unreadable" else "NULL" for column in SCHEMAS[name]
        )
        problems = f"SELECT f.log, {columns} FROM found f WHERE f.problem IS NOT NULL"  # noqa: S608  # as above
        statement = f"{statement} UNION ALL {problems}"
    database.execute(f"CREATE VIEW {name} AS {statement}")


def _distinct(names: Sequence[str]) -> tuple[str, ...]:
    """Return names of columns of which no two are the same: `lost` and `lost_2` of two joined tables."""
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


def _text(value: str) -> str:
    """Return a text as SQL has it."""
    return "'" + value.replace("'", "''") + "'"


def _reason(error: duckdb.Error) -> str:
    """Return what is wrong in a line, without the kind of error, candidates and the place."""
    first = str(error).strip().splitlines()[0]
    return re.sub(r"^\w+( \w+)* Error: ", "", first).rstrip("!. ")


def _known(statement: str) -> str:
    names = [name for name in TABLES if re.search(rf"\b{name}\b", statement)] or ["logs"]
    found = (f"{name} has log, {', '.join(SCHEMAS[name].names)}" for name in names)
    return f"{'; '.join(found)}; tables: {', '.join(TABLES)}"
