"""`dxlrun logs`: table of the logs of a season; `dxlrun upload`: copy of logs to a store."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter
from rich.prompt import Confirm

from dxlrun import InputError
from dxlrun.tooling.output import (
    Cell,
    Column,
    Table,
    Value,
    counted,
    flagged,
    microseconds,
    print_error,
    print_warning,
    progress_bar,
    show_json,
    show_parts,
)
from dxlrun.tooling.verbs import DebugFlag, Flag, JsonFlag, missing_extra, parse_size

if TYPE_CHECKING:
    from dxlrun_analysis.season.season_runs import Folder
    from dxlrun_analysis.season.store import Store

Row = Mapping[str, object]
_MOST_SHOWN = 1000
_MOST_NAMED = 3
Text = Annotated[str | None, Parameter(show_default=False, allow_leading_hyphen=True)]


def logs(
    directory: str,
    /,
    *,
    where: Text = None,
    sort: Text = None,
    prune: Flag = False,
    keep: Text = None,
    as_json: JsonFlag = False,
    debug: DebugFlag = False,
) -> int:
    """List all logs below a directory in a table, one row per log.

    Each log is read only once. The table is stored as Parquet in ~/.cache/dxlrun/logs. Needs duckdb and
    pyarrow: `pip install 'dxlrun[logs]'`.

    Parameters
    ----------
    directory
        Directory with logs, or s3://BUCKET/PREFIX for logs of `dxlrun upload`.
    where
        SQL condition that selects logs, such as "not good and lost > 10" or "list_contains(findings,
        'late_replies')". A wrong name is answered with all names.
    sort
        Order of the rows in SQL, such as "worst_wake_up_us DESC". Default: by name.
    prune
        List the oldest logs of runs in the directory beyond --keep, and delete them after confirmation.
    keep
        Total size of the newest logs that --prune keeps, such as 10GB.
    """
    if prune or keep is not None:
        if not prune or keep is None or (where, sort) != (None, None):
            raise InputError("write --prune and --keep together, without other options: --prune --keep 10GB")
        return _prune(Path(directory), keep, as_json=as_json)
    _check(directory)
    from dxlrun_analysis.season import query, season_runs

    folder = _found(directory)
    try:
        with progress_bar(hidden=as_json) as draw:
            table, read = (
                season_runs.table_of(folder, draw)
                if isinstance(folder, season_runs.Folder)
                else folder.load_table(draw)
            )
    except OSError as error:
        raise InputError(
            f"the table of runs cannot be saved in {season_runs.cache_directory()} "
            f"({error.strerror or error}); set XDG_CACHE_HOME to another directory"
        ) from error
    rows = query.select_runs(table, where, sort)
    if as_json:
        show_json({"rows": rows, "other_files": folder.others, "converted": read})
        return 0
    if folder.others:
        print_warning(_others(folder))
    _show_rows(rows, folder)
    return 0


def upload(directory: Path, store: str, /, *, as_json: JsonFlag = False, debug: DebugFlag = False) -> int:
    """Copy the logs below a directory to an object store, each with its row of `dxlrun logs`.

    Logs that are already in the store are skipped, and so is a log that a run is writing. The next upload
    completes an interrupted one. Nothing is deleted, and no other run is overwritten. Needs `pip install
    'dxlrun[store]'`. Exit code: 0, or 1 if the store has another run with the name of a log.

    Parameters
    ----------
    directory
        Directory with logs.
    store
        Address of the store, such as s3://BUCKET/PREFIX or file:///DIRECTORY. Credentials and endpoint are
        those of the AWS command line: AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY, AWS_ENDPOINT_URL.
    """
    if missing := missing_extra("`dxlrun upload`", "store", "fsspec", "duckdb", "pyarrow"):
        raise InputError(missing)
    _check(str(directory))
    from dxlrun_analysis.season import season_runs
    from dxlrun_analysis.season import store as stores

    folder = season_runs.find_logs(directory)
    with progress_bar(hidden=as_json) as draw:
        result = stores.upload(folder, store, draw)
    others = [
        f"{store} has a different run named {name}; use a URL per robot, such as s3://lab/torso"
        for name in result.others
    ]
    written = [f"{name} was skipped: a run is writing it" for name in result.written]
    if as_json:
        show_json(result._asdict(), code=1 if others else 0, errors=others, warnings=written)
        return 1 if others else 0
    for other in others:
        print_error(other)
    for name in written:
        print_warning(name)
    uploaded = counted(len(result.uploaded), "log was", "logs were")
    show_parts(f"{uploaded} copied to {store}; {len(result.there)} of {len(folder.logs)} were there already")
    return 1 if others else 0


def _prune(directory: Path, keep: str, *, as_json: bool) -> int:
    """List the oldest logs so that the rest is within the size `keep`, and delete them after confirmation;
    return the exit code."""
    from rich.filesize import decimal

    from dxlrun.tooling.logs import oldest_beyond, stored_logs

    if not directory.is_dir():
        raise InputError(
            f"directory {directory} not found; give the directory of the logs, by default `logs`"
        )
    keep_bytes = parse_size("--keep", keep)
    logs, oldest = stored_logs(directory), oldest_beyond(directory, keep_bytes)
    names = [str(one.path) for one in oldest]
    freed, whole = sum(one.bytes for one in oldest), sum(one.bytes for one in logs)
    if as_json:  # With --json only list the logs: a program can delete the listed files itself
        show_json({"directory": str(directory), "bytes": whole, "oldest": names, "oldest_bytes": freed})
        return 0
    them = counted(len(logs), "log", "logs")
    if not oldest:
        show_parts(f"{directory} has {them}, {decimal(whole)}: nothing to delete")
        return 0
    columns = [Column("the oldest", "name"), Column("last written", "name"), Column("size", "name")]
    rows = [
        (one.path.name, f"{datetime.fromtimestamp(one.changed_s):%Y-%m-%d %H:%M}", decimal(one.bytes))
        for one in oldest
    ]
    show_parts(Table.from_rows("", columns, rows), f"{directory} has {them}, {decimal(whole)}")
    if not sys.stdin.isatty():
        raise InputError("nothing was deleted: stdin is not a terminal; run the command in a terminal")
    question = f"Delete {counted(len(oldest), 'log', 'logs')}, {decimal(freed)}?"
    if not Confirm.ask(question, default=False):
        show_parts("nothing was deleted")
        return 0
    for one in oldest:
        try:
            one.delete()
        except OSError as error:
            raise InputError(f"{one.path} cannot be deleted: {error.strerror or error}") from None
    show_parts(f"deleted {counted(len(oldest), 'log', 'logs')}, {decimal(freed)}")
    return 0


def _found(place: str) -> Folder | Store:
    """Find the logs below a directory or in a store.

    Raises:
        InputError: The place has no logs.
    """
    from dxlrun_analysis.season import season_runs

    if "://" not in place:
        return season_runs.find_logs(Path(place))
    from dxlrun_analysis.season.store import find_store

    store = find_store(place)
    if not store.logs:
        raise InputError(f"{place}: no logs found; upload logs with `dxlrun upload DIRECTORY {place}`")
    return store


def _check(place: str) -> None:
    """Check that the argument is a directory or the address of a store, and that the needed packages are
    installed.

    Raises:
        InputError: One line for each problem.
    """
    wrong: list[str] = []
    needed = ("logs", "duckdb", "pyarrow")
    directory = Path(place)
    if "://" in place:
        needed = ("store", "duckdb", "fsspec")
    elif not directory.is_dir():
        wrong.append(
            f"{directory} is not a directory; analyze a single log with `dxlrun analyze`"
            if directory.exists()
            else f"directory {directory} not found; give the directory of logs, by default `logs`"
        )
    if missing := missing_extra("logs", *needed):
        wrong.append(missing)
    if wrong:
        raise InputError("\n".join(wrong))


def _others(folder: Folder | Store) -> str:
    named = ", ".join(folder.others[:_MOST_NAMED])
    more = len(folder.others) - _MOST_NAMED
    rest = f" and {more} more" if more > 0 else ""
    files = counted(len(folder.others), "other file is", "other files are")
    return f"{files} in {folder.directory}: {named}{rest}"


def _show_rows(rows: Sequence[Row], folder: Folder | Store) -> None:
    show_parts(Table.listing("", _COLUMNS, rows[:_MOST_SHOWN]))
    if len(rows) > _MOST_SHOWN:
        show_parts(f"\nthe first {_MOST_SHOWN} of {len(rows)} rows; --json prints all")
    else:
        show_parts(f"\n{len(rows)} of {counted(len(folder.logs), 'log', 'logs')}")


def _count(value: object) -> Value:
    return flagged(value) if isinstance(value, int) else None


def _times(value: object) -> Value:
    return microseconds(value) if isinstance(value, float) else None


def _plain(value: object) -> Value:
    if value is None:
        return None
    if isinstance(value, datetime):
        return f"{value:%Y-%m-%d %H:%M:%S}"
    return str(value)


def _number(value: object) -> float | None:
    return value if isinstance(value, int | float) else None


def _verdict(row: Row) -> Cell:
    if row["unreadable"]:
        return Cell("unreadable", "error")
    if row["being_written"]:
        return Cell("being written", "warning")
    return Cell("good", "good") if row["good"] else Cell("not good", "warning")


_COLUMNS: Sequence[tuple[Column, Callable[[Row], Value]]] = (
    (Column("log", "name"), lambda row: _plain(row["log"])),
    (Column("robot", "name", missing="-"), lambda row: _plain(row["robot"])),
    (Column("began (UTC)", "name", missing="-", detail=True), lambda row: _plain(row["began"])),
    (Column("lasted", form="{:.1f} s", missing="-"), lambda row: _number(row["lasted_s"])),
    (Column("verdict", "name"), _verdict),
    (
        Column("first finding", "text", missing="-"),
        lambda row: Cell(str(row["unreadable"]), "error") if row["unreadable"] else _plain(row["sentence"]),
    ),
    (Column("skipped", missing="-"), lambda row: _count(row["skipped"])),
    (
        Column("worst wake-up", missing="-"),
        lambda row: "-" if row["virtual"] else _times(row["worst_wake_up_us"]),
    ),
    (Column("lost", missing="-"), lambda row: _count(row["lost"])),
    (
        Column("hottest", form="{:.0f} deg C", missing="-", detail=True),
        lambda row: _number(row["hottest_deg_c"]),
    ),
)
