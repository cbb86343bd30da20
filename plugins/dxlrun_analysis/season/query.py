"""Query: filter and sort the table of logs by SQL expressions, with DuckDB.

Expressions can only read the table. They cannot access files, extensions or settings.
"""

from __future__ import annotations

import atexit
import gc
import re
from collections.abc import Iterator
from contextlib import contextmanager

import duckdb
import pyarrow as pa

from dxlrun import InputError

atexit.register(gc.unfreeze)  # DuckDB prints its uncollected objects at exit, and the cli freezes all objects
TABLE = "logs"
_READ_ONLY: dict[str, str | bool | int | float | list[str]] = {
    "autoinstall_known_extensions": False,
    "autoload_known_extensions": False,
    "python_enable_replacements": False,
    "enable_external_access": False,
    "lock_configuration": True,
}


def select_runs(runs: pa.Table, where: str | None, sort: str | None) -> list[dict[str, object]]:
    """Return the rows that meet the SQL condition `where`, ordered by `sort`, by default by name.

    Raises:
        InputError: An expression is wrong; the message names its option of the command line.
    """
    with duckdb.connect(":memory:", config=_READ_ONLY) as database:
        database.register(TABLE, runs)
        found = database.view(TABLE)
        if where:
            with _input_errors("--where", runs):
                found = found.filter(where)
        with _input_errors("--sort", runs):
            found = found.order(sort or "log")
        with _input_errors("--where or --sort", runs):
            return [dict(zip(found.columns, row, strict=True)) for row in found.fetchall()]


@contextmanager
def _input_errors(option: str, runs: pa.Table) -> Iterator[None]:
    """Convert an error of DuckDB to an InputError of one sentence that names the option."""
    try:
        yield
    except duckdb.Error as error:
        first = str(error).strip().splitlines()[0]
        reason = re.sub(r"^\w+( \w+)* Error: ", "", first).rstrip("!. ")
        raise InputError(f"{option}: {reason}; {TABLE} has {', '.join(runs.column_names)}") from error
