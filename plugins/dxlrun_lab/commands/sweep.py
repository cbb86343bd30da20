"""`dxlrun sweep`: one motion at many values of the robot file, each run scored."""

from __future__ import annotations

import os
import shlex
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from dxlrun.cli.inputs import (
    CLUSTER_ADDRESS,
    Assignment,
    Flag,
    JsonFlag,
    Motions,
    Seconds,
    known_file,
    parse_assignments,
    terminated_as_interrupted,
)
from dxlrun.errors import InputError, Mark, Problem, ProcessFault, counted
from dxlrun.output.terminal import err, print_error, print_warning, progress_bar, show, show_json

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from contextlib import AbstractContextManager

    from dxlrun_lab.sweep.grid import Grid
    from dxlrun_lab.sweep.results import Row, SweepHeader
    from dxlrun_lab.sweep.sweep import Sweep
    from dxlrun_lab.sweep.workers import Worker

Ranges = Annotated[tuple[str, ...], Parameter(negative=(), show_default=False)]
By = Literal["rms", "worst", "overshoot", "settling", "energy", "temperature"]
DIRECTORY = Path("sweeps")
"""Where results are written without --output, from the working directory."""
_INTERRUPTED = 130
_MOST_WORKERS = 512
_LONGEST_S = 1e6


def sweep(
    robot: Path,
    /,
    *assignments: Assignment,
    play: Motions = (),
    over: Ranges = (),
    by: By = "rms",
    output: Path | None = None,
    picture: Path | None = None,
    workers: int | None = None,
    cluster: str | None = None,
    time_limit: Seconds = 600.0,
    as_json: JsonFlag = False,
    debug: Flag = False,
) -> int:
    """Run a motion at many values of the robot file, on virtual time, and score each run.

    All cores are used. Rows are kept in a Parquet file as they come; the same command continues a sweep that
    was ended. Needs pyarrow: `pip install 'dxlrun[sweep]'`.

    Parameters
    ----------
    robot
        The robot file; all its servos are simulated.
    assignments
        Arguments of the robot file, for example rate:=100.
    play
        Play this motion file; may be given several times.
    over
        Values of one place in the robot file, such as gains.p=0.5..3x8 (8 values), gains.p=0.1..10x5log
        (evenly spaced in their logarithm), gains.p=1,2,5, 'limits.acceleration=5 rad/s^2..20 rad/s^2x4'. May
        be given several times: every combination is run.
    by
        The score by which runs are ordered, the lowest first.
    output
        The Parquet file, or the directory for it; without it the directory sweeps.
    picture
        Also draw the score over the parameters: an .svg, .png or .pdf file.
    workers
        How many runs at once, on this machine; without it one a core.
    cluster
        Use the Dask cluster that runs at this address, such as tls://HOST:8786, with the certificates of
        Dask's configuration.
    time_limit
        Seconds of real time that one run may take.
    as_json
        Print the result as JSON.
    debug
        Print the traceback of an error.
    """
    _check_extra(cluster)
    wrong = [*_motion_mistakes(play, over), *_picture_mistakes(picture)]
    wrong += _cluster_mistakes(workers, cluster, time_limit)
    known_file(robot)
    arguments = parse_assignments(assignments)
    from dxlrun_lab.sweep.results import check_output, only_writer
    from dxlrun_lab.sweep.sweep import Sweep, default_name, header_of

    with err().status("trying the values in the robot file"):
        grid = _checked_grid(robot, arguments, play, over, wrong)
    header = header_of(grid, arguments, shlex.join(("dxlrun", *sys.argv[1:])))
    place = output or DIRECTORY
    if place.suffix != ".parquet":
        place /= default_name(header)
    check_output(place)
    for warning in grid.first.warnings:
        print_warning(str(warning))
    found = Sweep(grid, header, place, time_limit)
    code, sentence = 0, ""
    try:
        with terminated_as_interrupted(), only_writer(place), progress_bar(hidden=as_json) as draw:
            found.run(_workers(cluster, workers), draw)
    except ProcessFault as error:
        code, sentence = error.exit_code, str(error)
    except KeyboardInterrupt:
        code, sentence = _INTERRUPTED, "interrupted"
    code = code or (0 if any(row.measured.scores is not None for row in found.rows) else 1)
    if as_json:
        show_json(_result(header, found, place, by, sentence))
    else:
        _show(grid, header, found, place, by)
    if picture is not None and found.rows:
        _draw(picture, grid, header, found.rows, by)
    if sentence:
        print_error(sentence if code == _INTERRUPTED else f"dxlrun: {sentence}")
    return code


def _check_extra(cluster: str | None) -> None:
    """Raise InputError where the extra is not installed."""
    if find_spec("pyarrow") is None:
        raise InputError("a sweep needs pyarrow, which is not installed: pip install 'dxlrun[sweep]'")
    if cluster is not None and find_spec("distributed") is None:
        raise InputError("--cluster needs dask, which is not installed: pip install 'dask[distributed]'")


def _checked_grid(
    robot: Path, arguments: dict[str, str], play: tuple[Path, ...], over: tuple[str, ...], wrong: list[str]
) -> Grid:
    """Return the grid; raises InputError with all that is wrong with it, and with the other options."""
    from dxlrun.description.arguments import COMMAND_LINE
    from dxlrun_lab.sweep.grid import Grid

    parts = [sentence.partition("; ") for sentence in wrong]
    problems = [Problem(Mark(COMMAND_LINE), what, fix) for what, _, fix in parts]
    try:
        grid = Grid(robot, arguments, play, over)
    except InputError as error:
        if not error.problems and not problems:
            raise
        raise InputError([*problems, *error.problems]) from None
    if problems:
        raise InputError(problems)
    return grid


def _motion_mistakes(play: tuple[Path, ...], over: tuple[str, ...]) -> Iterator[str]:
    if not play:
        yield "without a motion there is nothing to score; give --play MOTION.yaml"
    if not over:
        yield "nothing is swept; give --over PATH=LO..HIxN, as in --over gains.p=0.5..3x8"


def _picture_mistakes(picture: Path | None) -> Iterator[str]:
    if picture is None:
        return
    if picture.suffix.lower() not in (".svg", ".png", ".pdf"):
        yield f"--picture {picture} has no format; end it in .svg, .png or .pdf"
    elif find_spec("matplotlib") is None:
        yield "--picture needs matplotlib, which is not installed; pip install 'dxlrun[sweep]'"
    elif not picture.parent.is_dir():
        yield f"--picture {picture}: there is no directory {picture.parent}; make it"


def _cluster_mistakes(workers: int | None, cluster: str | None, time_limit: float) -> Iterator[str]:
    if workers is not None and not 1 <= workers <= _MOST_WORKERS:
        yield f"--workers is {workers}; give from 1 to {_MOST_WORKERS}"
    if cluster is not None and not CLUSTER_ADDRESS.fullmatch(cluster):
        yield f"--cluster {cluster} is no address with TLS; write it as tls://HOST:8786"
    if cluster is not None and workers is not None:
        yield "--workers is for this machine, and --cluster has its own; give one of the two"
    if not 0 < time_limit <= _LONGEST_S:
        yield f"--time-limit is {time_limit:g}; give seconds, from above 0 to {_LONGEST_S:g}"


def _workers(
    address: str | None, count: int | None
) -> Callable[[], AbstractContextManager[Sequence[Worker]]]:
    from dxlrun_lab.sweep import workers

    if address is not None:
        return lambda: workers.cluster_workers(address)
    return lambda: workers.local_workers(count or len(os.sched_getaffinity(0)))


def _show(grid: Grid, header: SweepHeader, found: Sweep, place: Path, by: By) -> None:
    from dxlrun_lab.sweep.ranking import parts

    counts = found.counts
    names = [parameter.name for parameter in grid.parameters]
    show(*parts(header.parameters, names, found.rows, by))
    done = counts.there + counts.measured
    before = f", {counts.there} of them before" if counts.there else ""
    left = "" if done == counts.points else "; the same command continues"
    show(f"\n{done} of {counted(counts.points, 'run', 'runs')}{before}{left}")
    if found.rows:
        show(f"results: {place}")


def _result(header: SweepHeader, found: Sweep, place: Path, by: By, sentence: str) -> dict[str, object]:
    """Return the result as JSON has it: the rows, the best ones first, then those without a score."""
    from dxlrun_lab.sweep.ranking import influences, ranked

    best = ranked(found.rows, by)
    rest = [row for row in found.rows if row not in best]
    names = [column.place for column in header.parameters]
    rows = [
        {
            "values": dict(zip(names, row.values, strict=True)),
            "status": row.measured.status,
            "reason": row.measured.reason,
            "scores": row.measured.scores,
        }
        for row in (*best, *rest)
    ]
    return {
        "robot": header.robot,
        "by": by,
        "output": str(place),
        "parameters": header.parameters,
        "counts": found.counts,
        "ended_by": sentence,
        "influences": influences(header.parameters, found.rows, by),
        "rows": rows,
    }


def _draw(picture: Path, grid: Grid, header: SweepHeader, rows: tuple[Row, ...], by: By) -> None:
    from dxlrun_lab.sweep.picture import draw

    names = [parameter.name for parameter in grid.parameters]
    try:
        draw(picture, header.parameters, names, rows, by=by, title=f"{header.robot}: {by} of each run")
    except OSError as error:
        raise InputError(f"--picture {picture} cannot be written ({error.strerror or error})") from None
