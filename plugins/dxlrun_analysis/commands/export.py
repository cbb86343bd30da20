"""`dxlrun export`: conversion of logs to CSV, Parquet or a LeRobot data set."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from dxlrun import InputError
from dxlrun.tooling.output import counted, err, print_warning, show_json, show_parts
from dxlrun.tooling.verbs import DebugFlag, JsonFlag, missing_extra

if TYPE_CHECKING:
    from collections.abc import Sequence

    from dxlrun import LogReader
    from dxlrun_analysis.export.episodes import Choice

Format = Literal["csv", "parquet", "lerobot"]
Joints = Annotated[tuple[str, ...], Parameter(negative=(), show_default=False, consume_multiple=True)]


def export(
    *paths: Annotated[Path, Parameter(name="log")],
    file_format: Annotated[Format, Parameter(name="--format")],
    topic: Annotated[str | None, Parameter(show_default=False)] = None,
    fps: Annotated[int | None, Parameter(show_default=False)] = None,
    observation: Joints = (),
    action: Joints = (),
    task: str = "",
    as_json: JsonFlag = False,
    debug: DebugFlag = False,
) -> int:
    """Convert a log to another format, in a new file or directory.

    `dxlrun export LOG OUTPUT --format csv`: the last path is the output, and is not overwritten. Needs
    pyarrow: `pip install 'dxlrun[logs]'`. Programs that read MCAP with ROS 2 messages, such as Foxglove and
    rosbag readers, can open the log itself.

    Parameters
    ----------
    paths
        Log of a run: an .mcap file, or the directory of a log in parts. lerobot takes several, one episode
        each. Then the output: a new file for csv, a new directory for the other formats.
    file_format
        Output format. csv: one line per cycle, or per record of another --topic. parquet: one file each for
        cycles, packets, events, commands and every topic; topics without a file are listed with the reason.
        lerobot: a data set in the layout of LeRobotDataset v3.0.
    topic
        Topic for csv: /events, /commands, /bus/NAME or a topic of a controller. Default: /cycle.
    fps
        Frames per second of lerobot, not above the rate of the loop. Default: 30, or the rate of a slower
        loop.
    observation
        Joints or groups whose positions are the observation of lerobot. Default: all joints but the leaders
        of a leader_follower.
    action
        Joints or groups whose goals are the action of lerobot. Default: all joints with goals but the leaders
        of a leader_follower.
    task
        Task of lerobot in words, such as "pick the cube". Default: recorded motion of the robot.
    """
    *logs, output = _checked(paths)
    if topic is not None and file_format != "csv":
        raise InputError(f"--topic is only for csv, {file_format} has all topics; omit --topic")
    given = {"--fps": fps is not None, "--observation": observation, "--action": action, "--task": task}
    if file_format != "lerobot":
        if len(logs) > 1:
            raise InputError(f"{len(logs)} logs, but {file_format} is of one; export one log at a time")
        if option := next((name for name, there in given.items() if there), None):
            raise InputError(f"{option} is only for lerobot; omit {option}")
    if fps is not None and fps < 1:
        raise InputError(f"--fps {fps}: not a rate; give at least 1")
    if missing := missing_extra(file_format, "logs", "pyarrow"):
        raise InputError(missing)
    from dxlrun.tooling.output import new_target
    from dxlrun_analysis.export.episodes import Choice

    shown = str(logs[0]) if len(logs) == 1 else counted(len(logs), "log", "logs")
    with err().status(f"exporting {shown}"), new_target(output) as beside:
        readers = _opened(logs)
        if file_format == "lerobot":
            choice = Choice(observation, action, fps, task)
            result, lines, warnings = _write_dataset(readers, beside, choice)
        else:
            result, lines = _write_table(readers[0], beside, file_format, topic)
            warnings = []
    if as_json:
        show_json({"output": str(output), "format": file_format, **result}, warnings=warnings)
        return 0
    for warning in warnings:
        print_warning(warning)
    show_parts(f"{output}: {lines[0]}", *lines[1:])
    return 0


def _checked(paths: Sequence[Path]) -> Sequence[Path]:
    """Return logs and the output. Raises InputError if one of them is missing."""
    *logs, output = paths or [Path()]
    if not logs:
        given = f"only {output} is given" if paths else "no log is given"
        raise InputError(f"{given}; give a log and then the output, as in `dxlrun export LOG OUTPUT`")
    problems = [
        f"log {log} not found; a run prints the path of its log when it ends"
        for log in dict.fromkeys(logs)
        if not log.exists()
    ]
    twice = sorted({str(log) for log in logs if logs.count(log) > 1})
    problems += [f"log {log} is given twice; give it once" for log in twice]
    if problems:
        raise InputError("\n".join(problems))
    return paths


def _opened(logs: Sequence[Path]) -> list[LogReader]:
    """Open all logs. Raises LogError with a sentence for each that cannot be opened."""
    from dxlrun import LogError, open_log

    readers: list[LogReader] = []
    problems: list[str] = []
    for log in logs:
        try:
            readers.append(open_log(log))
        except LogError as error:
            problems.append(str(error))
    if problems:
        raise LogError("\n".join(problems))
    return readers


def _write_dataset(
    readers: Sequence[LogReader], target: Path, choice: Choice
) -> tuple[dict[str, object], list[str], list[str]]:
    """Write a data set; return its result as JSON, its lines, and a warning for each incomplete log."""
    from dxlrun_analysis.export.lerobot import write_dataset

    made = write_dataset(readers, target, choice)
    episodes = counted(sum(made.episodes), "episode", "episodes")
    lines = [
        f"{counted(made.frames, 'frame', 'frames')} in {episodes}, {made.fps} per second",
        f"observation: {', '.join(made.columns.observation)}",
        f"action: {', '.join(made.columns.action)}",
    ]
    for reader, count in zip(readers, made.episodes, strict=True):
        if count > 1:
            lines.append(f"{reader.path}: {count} episodes, because cycles or replies are missing for a time")
    if made.held:
        lines.append(f"{counted(made.held, 'frame has', 'frames have')} a state from an earlier cycle")
    if not made.columns.environment:
        lines.append("no observation.environment_state: add images before you train ACT or diffusion")
    result: dict[str, object] = {
        "frames": made.frames,
        "fps": made.fps,
        "episodes": made.episodes,
        "held": made.held,
        "observation": list(made.columns.observation),
        "action": list(made.columns.action),
    }
    return result, lines, made.damage


def _write_table(
    reader: LogReader, target: Path, to: Format, topic: str | None
) -> tuple[dict[str, object], list[str]]:
    """Write CSV or Parquet; return its result as JSON, and its lines. `topic` is for CSV."""
    from dxlrun_analysis.export.arrow_tables import topics_without_table

    if to == "csv":
        from dxlrun_analysis.export.csv_file import write_csv

        count = write_csv(reader, target, topic or "/cycle")
        # With --topic, CSV can hold any topic that has messages.
        without = topics_without_table(reader, lambda _: True)
    else:
        from dxlrun_analysis.export.parquet import has_file, write_parquet

        count = write_parquet(reader, target)
        without = topics_without_table(reader, lambda name: has_file(target, name))
    kind = "file" if to == "parquet" else "table"
    lines = [f"no {kind} for {name}: {reason}" for name, reason in without.items()]
    return {"rows": count, "without_file": without}, [counted(count, "row", "rows"), *lines]
