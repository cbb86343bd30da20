"""`dxlrun bench`: measure the exchange with the servos on this machine."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

from cyclopts import App, Parameter

from dxlrun.cli.flags import Flag, JsonFlag
from dxlrun.cli.terminal import out, say_warning
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
    peers: List = "ours,unrecorded,sdk,rustypot",
    against: List = "canned",
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
        Who is measured: ours (dxlrun, every packet kept for a log), unrecorded (the same without a log), sdk,
        rustypot. Who is not installed is left out.
    against
        Who answers: canned (another process that answers at once, without a wire and without thinking).
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

    if against != "canned":
        raise InputError(f"--against {against}: only canned can be measured against")
    names = _words("--peers", peers, [kind.name for kind in HOSTS])
    protocols = [float(word) for word in _words("--protocol", protocol, ["1.0", "2.0"])]
    cases = [Case(each, count) for each in protocols for count in _counts(servos)]
    if not 0.01 <= seconds <= 3600:
        raise InputError(f"--seconds {seconds:g}: give from 0.01 to 3600")
    result = bus.bench_bus(cases, bus.chosen_hosts(names), seconds, values=not raw)
    for name in result.missing:
        say_warning(f"{name} is not installed and was left out; `pip install 'dxlrun[bench]'` installs it")
    if as_json:
        out().file.write(bus.to_json(result).decode() + "\n")
    else:
        _print(result)
    return 0


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
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    for head in ("protocol", "servos", "host"):
        table.add_column(head)
    for head in ("median us", "p99 us", "processor us", "bytes", "wall", "processor", "lost"):
        table.add_column(head, justify="right")
    for case in result.cases:
        first = case.hosts[0]
        for one in case.hosts:
            ratios = ("", "")
            if one is not first:
                ratios = (
                    f"{first.wall_ratio[one.host]:.2f} of it",
                    f"{first.processor_ratio[one.host]:.2f} of it",
                )
            table.add_row(
                f"{case.protocol:.1f}",
                f"{case.servos} x {case.model}",
                one.host,
                f"{one.median_us:.0f}",
                f"{one.p99_us:.0f}",
                f"{one.processor_us:.0f}",
                f"{one.sent_bytes} + {one.received_bytes}",
                *ratios,
                str(one.lost),
            )
    out().print(table)
