"""`dxlrun bench rate`: the highest loop rate that a robot keeps on this machine."""

from __future__ import annotations

from typing import TYPE_CHECKING

from cyclopts import App

from dxlrun import InputError
from dxlrun.tooling.output import counted, show_json, show_parts
from dxlrun.tooling.verbs import Assignment, DebugFlag, JsonFlag, RobotPath, Seconds, parse_assignments

if TYPE_CHECKING:
    from dxlrun.tooling.output import Table
    from dxlrun_lab.highest_rate import HighestRate

bench = App(name="bench", help="Measure a robot on this machine.")


@bench.command(name="rate")
def bench_rate(
    robot: RobotPath,
    /,
    *assignments: Assignment,
    duration: Seconds = 3.0,
    as_json: JsonFlag = False,
    debug: DebugFlag = False,
) -> int:
    """Find the highest rate that a robot keeps, by runs at decreasing rates.

    Torque is enabled, and the robot holds its position. A rate is kept if at most one cycle in a thousand
    overruns. Overruns that simulated servos cause do not count. Exit code: 0, or 1 if no rate is kept.

    Parameters
    ----------
    duration
        Duration of the run at each rate, s.
    """
    if not robot.is_file():
        raise InputError(f"robot file {robot} not found; check the path")
    if not 0.1 <= duration <= 3600:
        raise InputError(f"--duration {duration:g}: give 0.1 to 3600 s")
    from dxlrun.tooling.robots import read_robot
    from dxlrun_lab.highest_rate import highest_rate, runs_to_discard

    description = read_robot(robot, parse_assignments(assignments))
    with runs_to_discard() as run:
        result = highest_rate(
            description,
            duration,
            run,
            lambda rate: None if as_json else show_parts(f"running at {rate:g} Hz"),
        )
    code = 0 if result.kept_hz else 1
    if as_json:
        show_json(result, code=code, errors=[_highest(result)] * code)
    else:
        show_parts(_rates(result), _highest(result))
    return code


def _rates(result: HighestRate) -> Table:
    from dxlrun.tooling.output import Column, Table, numbers

    columns = [
        Column("rate", form="{:g} Hz"),
        *numbers("cycles", "overruns", "by simulated servos"),
        Column("median", form="{:.0f} us"),
        Column("99.9 %", form="{:.0f} us"),
        Column("kept", "name"),
    ]
    rows = [
        (
            one.rate_hz,
            one.cycles,
            one.overruns,
            one.by_simulation,
            one.median_us,
            one.p999_us,
            "yes" if one.kept else "no",
        )
        for one in result.tries
    ]
    return Table.from_rows("", columns, rows)


def _highest(result: HighestRate) -> str:
    computed = f"the buses allow {result.computed_hz:g} Hz"
    if result.kept_hz is None:
        return (
            f"{result.robot} kept no rate ({counted(len(result.tries), 'rate', 'rates')} tried); {computed}"
        )
    return f"{result.robot} keeps {result.kept_hz:g} Hz on this machine; {computed}"
