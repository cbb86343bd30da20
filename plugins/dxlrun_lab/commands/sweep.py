"""`dxlrun sweep`: one motion at many values of the robot file, each run scored."""

from __future__ import annotations

import os
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from dxlrun.cli.inputs import (
    AssignmentOfItsOwn,
    DebugFlag,
    JsonFlag,
    Motions,
    Seconds,
    known_file,
    parse_assignments,
    terminated_as_interrupted,
)
from dxlrun.errors import InputError, Mark, Problem, counted, missing_extra
from dxlrun.output.target import check_target
from dxlrun.output.terminal import err, print_error, print_warning, progress_bar, show, show_json
from dxlrun_lab.sweep import PICTURE_MARK, By

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from dxlrun_lab.sweep.grid import Grid
    from dxlrun_lab.sweep.sweep import Sweep

Ranges = Annotated[tuple[str, ...], Parameter(negative=(), show_default=False)]
DIRECTORY = Path("sweeps")
"""Where results are written without --output, from the working directory."""
_INTERRUPTED = 130
_MOST_WORKERS = 512
_LONGEST_S = 1e6
_MOST_DRAWN = 2


def sweep(
    robot: Path,
    /,
    *assignments: AssignmentOfItsOwn,
    play: Motions = (),
    over: Ranges = (),
    sort: By = "rms",
    output: Path | None = None,
    picture: Path | None = None,
    workers: int | None = None,
    time_limit: Seconds = 600.0,
    as_json: JsonFlag = False,
    debug: DebugFlag = False,
) -> int:
    """Run a motion at many values of the robot file: on virtual time; each run is scored.

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
    sort
        Order of the rows: by this score, the lowest first.
    output
        Write the result to this file (.parquet), or into this directory; without it into sweeps.
    picture
        Also draw the score over one or two parameters, as a map: an .svg, .png or .pdf file.
    workers
        How many runs at once; without it one a core.
    time_limit
        Seconds of real time that one run may take.
    """
    if missing := missing_extra("a sweep", "sweep", "pyarrow"):
        raise InputError(missing)
    wrong = tuple(_mistakes(play, over, picture, workers, time_limit))
    known_file(robot)
    arguments = parse_assignments(assignments)
    from dxlrun_lab.sweep.results import check_output, only_writer
    from dxlrun_lab.sweep.sweep import Sweep, default_name, header_of
    from dxlrun_lab.sweep.workers import workers as processes

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
    interrupted = False
    try:
        with terminated_as_interrupted(), only_writer(place), progress_bar(hidden=as_json) as draw:
            found.run(lambda: processes(workers or len(os.sched_getaffinity(0))), draw)
    except KeyboardInterrupt:
        interrupted = True
    scored = any(row.measured.scores is not None for row in found.rows)
    code = _INTERRUPTED if interrupted else 0 if scored else 1
    if as_json:
        why = ["interrupted"] if interrupted else ["no run was scored"] * code
        show_json(_result(found, sort, "interrupted" if interrupted else ""), code=code, errors=why)
    else:
        _show(found, sort)
    if picture is not None and found.rows:
        _draw(picture, found, sort)
    if interrupted and not as_json:
        print_error("interrupted")
    return code


def _checked_grid(
    robot: Path,
    arguments: dict[str, str],
    play: tuple[Path, ...],
    over: tuple[str, ...],
    wrong: Sequence[str],
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


def _mistakes(
    play: tuple[Path, ...],
    over: tuple[str, ...],
    picture: Path | None,
    workers: int | None,
    time_limit: float,
) -> Iterator[str]:
    """Yield `what; how to fix it` for each option with which nothing can be measured."""
    if not play:
        yield "without a motion there is nothing to score; give --play MOTION.yaml"
    if not over:
        yield "nothing is swept; give --over PATH=LO..HIxN, as in --over gains.p=0.5..3x8"
    if picture is not None and picture.suffix.lower() not in (".svg", ".png", ".pdf"):
        yield f"--picture {picture} has no format; end it in .svg, .png or .pdf"
    elif picture is not None and (missing := missing_extra("--picture", "sweep", "matplotlib")):
        yield missing
    elif picture is not None and len(over) > _MOST_DRAWN:
        yield f"--picture draws one or two parameters, and {len(over)} are swept; leave it out"
    elif picture is not None:
        try:
            check_target(picture, PICTURE_MARK)
        except InputError as error:
            yield str(error)
    if workers is not None and not 1 <= workers <= _MOST_WORKERS:
        yield f"--workers is {workers}; give from 1 to {_MOST_WORKERS}"
    if not 0 < time_limit <= _LONGEST_S:
        yield f"--time-limit is {time_limit:g}; give seconds, from above 0 to {_LONGEST_S:g}"


def _show(found: Sweep, by: By) -> None:
    from dxlrun_lab.sweep.ranking import parts

    names = [parameter.name for parameter in found.grid.parameters]
    show(*parts(found.header.parameters, names, found.rows, by))
    size, done = found.grid.size, found.there + found.measured
    before = f", {found.there} of them before" if found.there else ""
    left = "" if done == size else "; the same command continues"
    show(f"\n{done} of {counted(size, 'run', 'runs')}{before}{left}")
    if found.rows:
        show(f"results: {found.output}")


def _result(found: Sweep, by: By, ended_by: str) -> dict[str, object]:
    """Return the result as JSON has it: the rows, the best ones first, then those without a score."""
    from dxlrun_lab.sweep.ranking import ranked

    best = ranked(found.rows, by)
    names = [column.place for column in found.header.parameters]
    rows = [
        {
            "values": dict(zip(names, row.values, strict=True)),
            "status": row.measured.status,
            "reason": row.measured.reason,
            "scores": row.measured.scores,
        }
        for row in (*best, *(row for row in found.rows if row not in best))
    ]
    return {
        "robot": found.header.robot,
        "by": by,
        "output": str(found.output),
        "parameters": found.header.parameters,
        "counts": {"points": found.grid.size, "there": found.there, "measured": found.measured},
        "ended_by": ended_by,
        "rows": rows,
    }


def _draw(picture: Path, found: Sweep, by: By) -> None:
    from dxlrun_lab.sweep.picture import draw

    names = [parameter.name for parameter in found.grid.parameters]
    draw(picture, found.header, names, found.rows, by)
