"""`dxlrun bench`: measure a robot on this machine."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import App, Parameter

from dxlrun.cli.output.flags import Flag, JsonFlag
from dxlrun.cli.output.terminal import out
from dxlrun.errors import InputError, counted

if TYPE_CHECKING:
    from rich.table import Table

    from dxlrun.run.highest_rate import HighestRate

bench = App(name="bench", help="Measure a robot on this machine.")


@bench.command(name="rate")
def bench_rate(
    robot: Path,
    /,
    *assignments: Annotated[str, Parameter(name="arg:=value")],
    seconds: float = 3.0,
    as_json: JsonFlag = False,
    debug: Flag = False,
) -> int:
    """Find the highest rate that a robot keeps, by running it at one rate after another.

    The robot holds still where it stands: its servos get torque. At the kept rate at most one cycle in a
    thousand overruns; those that simulated servos cause do not count. Exit code 1 when no rate is kept.

    Parameters
    ----------
    robot
        The robot file.
    assignments
        Arguments of the robot file, for example port:=/dev/ttyUSB0.
    seconds
        How long each run lasts, s.
    as_json
        Print the result as JSON.
    debug
        Print the traceback of an error.
    """
    if not robot.is_file():
        raise InputError(f"there is no robot file {robot}; check the path")
    if not 0.1 <= seconds <= 3600:
        raise InputError(f"--seconds {seconds:g}: give from 0.1 to 3600")
    from dxlrun.cli.inputs import parse_assignments
    from dxlrun.cli.output.narrow import fitting
    from dxlrun.description import read_robot
    from dxlrun.run.highest_rate import highest_rate, runs_to_discard, to_json

    description = read_robot(robot, parse_assignments(assignments))
    with runs_to_discard() as run:
        result = highest_rate(
            description,
            seconds,
            run,
            lambda rate: None if as_json else out().print(f"running at {rate:g} Hz"),
        )
    if as_json:
        out().file.write(to_json(result).decode() + "\n")
    else:
        console = out()
        console.print(fitting(_table(result), console.width))
        console.print(_verdict(result), soft_wrap=True)
    return 0 if result.kept_hz else 1


def _table(result: HighestRate) -> Table:
    """Return the table of the runs at each rate."""
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    for head in ("rate Hz", "cycles", "overruns", "by simulated servos", "median us", "99.9 % us", "kept"):
        table.add_column(head, justify="right")
    for one in result.tries:
        table.add_row(
            f"{one.rate_hz:g}",
            str(one.cycles),
            str(one.overruns),
            str(one.by_simulation),
            f"{one.median_us:.0f}",
            f"{one.p999_us:.0f}",
            "yes" if one.kept else "no",
        )
    return table


def _verdict(result: HighestRate) -> str:
    """Return what was found in a sentence."""
    computed = f"its buses alone allow {result.computed_hz:g} Hz"
    if result.kept_hz is None:
        return f"{result.robot} kept no rate in {counted(len(result.tries), 'run', 'runs')}; {computed}"
    return f"{result.robot} keeps {result.kept_hz:g} Hz on this machine; {computed}"
