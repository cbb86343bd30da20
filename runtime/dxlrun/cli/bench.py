"""`dxlrun bench`: measure the exchange with the servos on this machine."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import App, Parameter

from dxlrun.cli.output.flags import Flag, JsonFlag
from dxlrun.cli.output.terminal import out, say_error, say_warning
from dxlrun.errors import InputError

if TYPE_CHECKING:
    from dxlrun.bench.bus import BusBench

bench = App(name="bench", help="Measure the exchange with the servos on this machine.")

List = Annotated[str, Parameter(show_default=True)]
_MOST_SERVOS = 50


@bench.command(name="bus")
def bench_bus(
    *,
    servos: List = "1,8,20",
    protocol: List = "1.0,2.0",
    peers: List = "ours,polled,unrecorded,sdk,sdk-fast,rustypot,rustypot-fast",
    against: List = "canned",
    baud: int = 1_000_000,
    seconds: float = 4.0,
    raw: Flag = False,
    as_json: JsonFlag = False,
    debug: Flag = False,
) -> int:
    """Measure one read and write of all servos: ours, dynamixel-sdk's and rustypot's, side by side.

    All read and write the same registers of the same servos, in turns, each on the same core.

    Parameters
    ----------
    servos
        Numbers of servos on the bus.
    protocol
        Protocols, 1.0 (AX-12A) and 2.0 (XM430-W350).
    peers
        Who is measured: ours (dxlrun, every packet kept for a log), polled (the same, polling for replies),
        unrecorded (ours without a log), sdk, rustypot; sdk-fast and rustypot-fast use fast sync read
        (Protocol 2.0). Who is not installed is left out.
    against
        Who answers: canned (another process that answers at once, without a wire and without thinking), or
        simulated (servos on a bus with wire times, whose own lateness is taken out by their ledger).
    baud
        Rate of the simulated bus, bit/s.
    seconds
        How long each case is measured, s.
    raw
        Let the peers leave raw bytes as they come and send bytes made before; ours goes on to SI units.
    as_json
        Print the result as JSON.
    debug
        Print the traceback of an error.
    """
    from dxlrun.bench import bus
    from dxlrun.bench.case import Case
    from dxlrun.bench.hosts import HOSTS
    from dxlrun.cli.output.bench_table import progress_bar

    names = _words("--peers", peers, [kind.name for kind in HOSTS])
    protocols = [float(word) for word in _words("--protocol", protocol, ["1.0", "2.0"])]
    opponents = _words("--against", against, ["canned", "simulated"])
    if not 0.01 <= seconds <= 3600:
        raise InputError(f"--seconds {seconds:g}: give from 0.01 to 3600")
    if not 9600 <= baud <= 4_500_000:
        raise InputError(f"--baud {baud}: give from 9600 to 4500000")
    lines = [Case(each, count, baud) for each in protocols for count in _counts(servos)]
    cases: list[tuple[bus.Against, Case]] = []
    if "canned" in opponents:
        cases += [("canned", case) for case in lines]
    if "simulated" in opponents:
        cases += [("simulated", case) for case in lines]
    with progress_bar(hidden=as_json) as progress:
        result = bus.bench_bus(cases, bus.Wish(bus.chosen_hosts(names), seconds, not raw), progress)
    for name in result.missing:
        say_warning(f"{name} is not installed and was left out; `pip install 'dxlrun[bench]'` installs it")
    if as_json:
        out().file.write(bus.to_json(result).decode() + "\n")
    else:
        _print(result)
    unmeasured = [
        f"{one.host} ({case.servos} x {case.model}, {case.against})"
        for case in result.cases
        for one in case.hosts
        if not one.exchanges
    ]
    if unmeasured:
        say_error(f"without a whole exchange, so not measured: {', '.join(unmeasured)}")
    return 1 if unmeasured else 0


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
    from dxlrun.bench.rate import bench_rate as measure
    from dxlrun.bench.rate import to_json
    from dxlrun.bench.real_run import runs
    from dxlrun.cli.inputs import parse_assignments
    from dxlrun.cli.output.bench_table import rate_table, rate_verdict
    from dxlrun.cli.output.narrow import fitting
    from dxlrun.description import read_robot

    description = read_robot(robot, parse_assignments(assignments))
    with runs() as run:
        result = measure(
            description,
            seconds,
            run,
            lambda rate: None if as_json else out().print(f"running at {rate:g} Hz"),
        )
    if as_json:
        out().file.write(to_json(result).decode() + "\n")
    else:
        console = out()
        console.print(fitting(rate_table(result), console.width))
        console.print(rate_verdict(result), soft_wrap=True)
    return 0 if result.kept_hz else 1


def _words(option: str, text: str, known: list[str]) -> list[str]:
    words = [word.strip() for word in text.split(",") if word.strip()]
    if not words:
        raise InputError(f"{option} says nothing; there are {', '.join(known)}")
    if unknown := [word for word in words if word not in known]:
        raise InputError(f"{option}: there is no {', '.join(unknown)}; there are {', '.join(known)}")
    return words


def _counts(text: str) -> list[int]:
    try:
        counts = [int(word) for word in text.split(",")]
    except ValueError:
        counts = [0]
    if not all(1 <= count <= _MOST_SERVOS for count in counts):
        raise InputError(f"--servos {text}: give numbers from 1 to {_MOST_SERVOS}, for example 1,8,20")
    return counts


def _print(result: BusBench) -> None:
    from dxlrun.cli.output.bench_table import bus_table
    from dxlrun.cli.output.narrow import fitting

    console = out()
    console.print(fitting(bus_table(result), console.width))
