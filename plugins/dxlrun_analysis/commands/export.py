"""`dxlrun export`: conversion of a log to CSV, Parquet or a LeRobot data set."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from dxlrun import InputError
from dxlrun.tooling.output import counted, err, show_json, show_parts
from dxlrun.tooling.verbs import DebugFlag, JsonFlag, missing_extra

if TYPE_CHECKING:
    from dxlrun import LogReader

Format = Literal["csv", "parquet", "lerobot"]
_OF = {"csv": "row", "parquet": "row", "lerobot": "frame"}


def export(
    log: Path,
    output: Annotated[Path, Parameter(name="output")],
    /,
    *,
    file_format: Annotated[Format, Parameter(name="--format")],
    topic: Annotated[str | None, Parameter(show_default=False)] = None,
    as_json: JsonFlag = False,
    debug: DebugFlag = False,
) -> int:
    """Convert a log to another format, in a new file or directory.

    Existing files are not overwritten. Needs pyarrow: `pip install 'dxlrun[logs]'`. Programs that read MCAP
    with ROS 2 messages, such as Foxglove and rosbag readers, can open the log itself.

    Parameters
    ----------
    log
        Log of a run: an .mcap file, or the directory of a log in parts.
    output
        New file for csv, new directory for the other formats.
    file_format
        Output format. csv: one line per cycle, or per record of another --topic. parquet: one file each for
        cycles, packets, events, commands and every topic; topics without a file are listed with the reason.
        lerobot: a data set in the layout of LeRobotDataset v3.0.
    topic
        Topic for csv: /events, /commands, /bus/NAME or a topic of a controller. Default: /cycle.
    """
    if not log.exists():
        raise InputError(f"log {log} not found; a run prints the path of its log when it ends")
    if topic is not None and file_format != "csv":
        raise InputError(f"--topic is only for csv, {file_format} has all topics; omit --topic")
    if missing := missing_extra(file_format, "logs", "pyarrow"):
        raise InputError(missing)
    from dxlrun import open_log
    from dxlrun.tooling.output import new_target

    with err().status(f"exporting {log}"), new_target(output) as beside:
        reader = open_log(log)
        count = _write(reader, beside, file_format, topic)
        without = _without_table(reader, beside, file_format)
    if as_json:
        result = {"output": str(output), "format": file_format, f"{_OF[file_format]}s": count}
        show_json({**result, **({} if without is None else {"without_file": without})})
        return 0
    show_parts(f"{output}: {counted(count, _OF[file_format], f'{_OF[file_format]}s')}")
    for name, reason in (without or {}).items():
        show_parts(f"no {'file' if file_format == 'parquet' else 'table'} for {name}: {reason}")
    return 0


def _without_table(reader: LogReader, target: Path, to: Format) -> dict[str, str] | None:
    """Return the topics of the log that were not exported as a table, with reasons; None for LeRobot."""
    if to not in ("csv", "parquet"):
        return None
    from dxlrun_analysis.export.arrow_tables import topics_without_table
    from dxlrun_analysis.export.parquet import has_file

    # With --topic, CSV can hold any topic that has messages.
    return topics_without_table(reader, lambda name: to == "csv" or has_file(target, name))


def _write(reader: LogReader, target: Path, to: Format, topic: str | None) -> int:
    """Write the log in a format to `target`; return the number of rows or frames. `topic` is for CSV."""
    if to == "csv":
        from dxlrun_analysis.export.csv_file import write_csv

        return write_csv(reader, target, topic or "/cycle")
    if to == "lerobot":
        from dxlrun_analysis.export.lerobot import write_dataset

        return write_dataset(reader, target)
    from dxlrun_analysis.export.parquet import write_parquet

    return write_parquet(reader, target)
