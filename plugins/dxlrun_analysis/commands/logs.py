"""`dxlrun logs`: the logs of a season as a table."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from datetime import datetime
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from dxlrun.cli.inputs import CLUSTER_ADDRESS, Flag, JsonFlag
from dxlrun.errors import InputError, counted
from dxlrun.output.table import Cell, Column, Table, Value, flagged, microseconds
from dxlrun.output.terminal import print_warning, progress_bar, show, show_json

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from dxlrun_analysis.season.query import Answer
    from dxlrun_analysis.season.season import Folder

_MOST_SHOWN = 1000
_MOST_NAMED = 3
Text = Annotated[str | None, Parameter(show_default=False, allow_leading_hyphen=True)]


def logs(
    directory: Path,
    /,
    *,
    where: Text = None,
    sort: Text = None,
    sql: Text = None,
    cluster: Annotated[str | None, Parameter(show_default=False)] = None,
    as_json: JsonFlag = False,
    debug: Flag = False,
) -> int:
    """Show all logs below a directory as a table, one row a log.

    Each log is converted once, several at a time, and kept in ~/.cache/dxlrun/logs. Needs duckdb and pyarrow:
    `pip install 'dxlrun[logs]'`.

    Parameters
    ----------
    directory
        The directory with the logs.
    where
        Only logs that meet this condition in SQL, such as "not good and lost > 10", or "log IN (SELECT log
        FROM findings WHERE finding = 'latency_timer')". A wrong name is answered with all names.
    sort
        Order of the rows in SQL, such as "worst_wake_up_us DESC"; without it by name.
    sql
        Instead of both: a whole SELECT over the tables logs, servos, joints, findings, events and cycles.
    cluster
        Convert on the Dask cluster that runs at this address, such as tls://HOST:8786, with the certificates
        of Dask's configuration; its workers need the logs and the cache under the same paths.
    as_json
        Print the result as JSON.
    debug
        Print the traceback of an error.
    """
    _check(directory, where, sort, sql, cluster)
    from dxlrun_analysis.season import query, season
    from dxlrun_analysis.season.cache import default_directory

    folder = season.find_logs(directory)
    statement = query.where(where or "", sort or "") if sql is None else sql
    option = "--sql" if sql is not None else "--where" if sort is None else "--where or --sort"
    try:
        with progress_bar(hidden=as_json) as draw:
            found = season.converted(folder, default_directory(), _pool(cluster), draw)
    except OSError as error:
        raise InputError(
            f"the cache {default_directory()} cannot be written ({error.strerror or error}); XDG_CACHE_HOME "
            "names another place"
        ) from error
    answer = query.ask(found, statement, option)
    if as_json:
        rows = [dict(zip(answer.columns, row, strict=True)) for row in answer.rows]
        counts = {"converted": found.converted, "rebuilt": found.rebuilt}
        show_json({"rows": rows, "other_files": folder.others, **counts})
        return 0
    if found.rebuilt:
        logs_ = counted(found.rebuilt, "log was", "logs were")
        print_warning(f"what the cache had of {logs_} damaged, and was made again")
    if folder.others:
        print_warning(_others(folder))
    _show(answer, folder, whole=sql is not None)
    return 0


def _check(
    directory: Path, where: str | None, sort: str | None, sql: str | None, cluster: str | None
) -> None:
    """Raise InputError with all that is wrong with the command line."""
    wrong = []
    if not directory.is_dir():
        fix = "`dxlrun analyze` takes single logs" if directory.exists() else "runs leave their logs in logs"
        wrong.append(f"there is no directory {directory}; {fix}")
    if sql is not None and (where is not None or sort is not None):
        wrong.append("--sql is a whole statement; write WHERE and ORDER BY in it, or leave it out")
    if cluster is not None and not CLUSTER_ADDRESS.fullmatch(cluster):
        wrong.append(f"--cluster {cluster} is no address with TLS; write it as tls://HOST:8786")
    if cluster is not None and find_spec("distributed") is None:
        wrong.append("--cluster needs dask, which is not installed: pip install 'dask[distributed]'")
    missing = [name for name in ("duckdb", "pyarrow") if find_spec(name) is None]
    if missing:
        wrong.append(f"logs needs {' and '.join(missing)}, not installed: pip install 'dxlrun[logs]'")
    if wrong:
        raise InputError("\n".join(wrong))


def _pool(cluster: str | None) -> Callable[[], AbstractContextManager[Executor]]:
    from dxlrun_analysis.season import pools

    if cluster is not None:
        return partial(pools.cluster_executor, cluster)
    return partial(pools.processes, len(os.sched_getaffinity(0)))


def _others(folder: Folder) -> str:
    named = ", ".join(folder.others[:_MOST_NAMED])
    more = len(folder.others) - _MOST_NAMED
    rest = f" and {more} more" if more > 0 else ""
    files = counted(len(folder.others), "other file is", "other files are")
    return f"{files} in {folder.directory}: {named}{rest}"


def _show(answer: Answer, folder: Folder, *, whole: bool) -> None:
    shown = answer.rows[:_MOST_SHOWN]
    if whole:
        columns = [Column(name, _kind(shown, index)) for index, name in enumerate(answer.columns)]
        show(Table.of("", columns, ([_plain(value) for value in row] for row in shown)))
    else:
        show(_table([dict(zip(answer.columns, row, strict=True)) for row in shown]))
    if len(answer.rows) > len(shown):
        show(f"\nthe first {len(shown)} of {len(answer.rows)} rows; --json prints all")
    elif not whole:
        show(f"\n{len(shown)} of {counted(len(folder.logs), 'log', 'logs')}")


def _table(rows: Sequence[Mapping[str, object]]) -> Table:
    columns = [
        Column("log", "name"),
        Column("robot", "name", missing="-"),
        Column("began (UTC)", "name", missing="-", detail=True),
        Column("lasted", form="{:.1f} s", missing="-"),
        Column("verdict", "name"),
        Column("first finding", "text", missing="-"),
        Column("skipped", missing="-"),
        Column("worst wake-up", missing="-"),
        Column("lost", missing="-"),
        Column("hottest", form="{:.0f} deg C", missing="-", detail=True),
    ]
    return Table.of("", columns, map(_log, rows))


def _log(row: Mapping[str, object]) -> Sequence[Value]:
    if row["unreadable"] is not None:
        cells: list[Value] = [str(row["log"]), None, None, None, Cell("unreadable", "error")]
        return [*cells, Cell(str(row["unreadable"]), "error"), None, None, None, None]
    verdict = Cell("good", "good") if row["good"] else Cell("not good", "warning")
    return [
        str(row["log"]),
        str(row["robot"]),
        _plain(row["began"]),
        _number(row["lasted_s"]),
        verdict,
        _plain(row["sentence"]),
        _count(row["skipped"]),
        "-" if row["virtual"] else _micro(row["worst_wake_up_us"]),
        _count(row["lost"]),
        _number(row["hottest_deg_c"]),
    ]


def _number(value: object) -> float | None:
    return value if isinstance(value, int | float) else None


def _count(value: object) -> Value:
    return flagged(value) if isinstance(value, int) else None


def _micro(value: object) -> Value:
    return microseconds(value) if isinstance(value, float) else None


def _plain(value: object) -> Value:
    if value is None:
        return None
    if isinstance(value, datetime):
        return f"{value:%Y-%m-%d %H:%M:%S}"
    if isinstance(value, float):
        return f"{value:.6g}"
    return str(value)


def _kind(rows: Sequence[Sequence[object]], column: int) -> Literal["name", "number", "text"]:
    values = [row[column] for row in rows if row[column] is not None]
    if values and all(isinstance(value, int | float) and not isinstance(value, bool) for value in values):
        return "number"
    return "text" if any(" " in str(value) for value in values) else "name"
