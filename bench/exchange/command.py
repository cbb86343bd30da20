"""The command line of the benchmark, and its table."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence

from dxlrun.errors import DxlrunError, InputError
from dxlrun.output.terminal import print_error, print_warning, progress_bar, show_parts
from dxlrun.output.text_table import Column, Table, Value, numbers
from exchange.bus import Against, BusBench, Settings, bench_bus, chosen_hosts, to_json
from exchange.case import Case
from exchange.figures import HostFigures
from exchange.hosts import HOSTS

_INTERRUPTED = 130
_MOST_SERVOS = 50


def parser() -> argparse.ArgumentParser:
    """Return what understands the command line."""
    made = argparse.ArgumentParser(
        prog="bench/exchange",
        description="Measure one read and write of all servos: ours, dynamixel-sdk's and rustypot's, side by "
        "side. All read and write the same registers of the same servos, in turns, each on the same core.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    made.add_argument("--servos", default="1,8,20", help="numbers of servos on the bus")
    made.add_argument("--protocol", default="1.0,2.0", help="protocols, 1.0 (AX-12A) and 2.0 (XM430-W350)")
    made.add_argument(
        "--peers",
        default=",".join(kind.name for kind in HOSTS),
        help="hosts to measure: ours (dxlrun, every packet kept for a log), polled (the same, polling for "
        "replies), unrecorded (ours without a log), floor (the same bytes by write and read, without work), "
        "sdk, rustypot; sdk-fast and rustypot-fast use fast sync read (Protocol 2.0); a host that is not "
        "installed is left out",
    )
    made.add_argument(
        "--against",
        default="canned",
        help="what answers: canned (another process that answers at once, without a wire and without "
        "computing), simulated (servos on a bus with wire times, whose own lateness is taken out by their "
        "ledger)",
    )
    made.add_argument("--baud", type=int, default=1_000_000, help="rate of the simulated bus, bit/s")
    made.add_argument("--seconds", type=float, default=4.0, help="duration of each case, s")
    made.add_argument(
        "--raw",
        action="store_true",
        help="the peers leave bytes raw and send bytes made before; ours still has SI units",
    )
    made.add_argument("--json", action="store_true", help="print the result as JSON")
    return made


def main(words: Sequence[str] | None = None) -> int:
    """Measure and print; return 0, or 1: a host had no whole exchange, 2: wrong input, 130: interrupted."""
    try:
        return _measure(parser().parse_args(words))
    except DxlrunError as error:
        for sentence in str(error).splitlines():
            print_error(f"bench/exchange: {sentence}")
        return error.exit_code
    except KeyboardInterrupt:
        print_error("interrupted")
        return _INTERRUPTED


def _measure(options: argparse.Namespace) -> int:
    cases = _cases(options)
    names = _words("--peers", options.peers, [kind.name for kind in HOSTS])
    with progress_bar(hidden=options.json) as progress:
        result = bench_bus(cases, Settings(chosen_hosts(names), options.seconds, not options.raw), progress)
    for name in result.missing:
        print_warning(f"{name} is not installed and was left out; `pip install '.[test]'` installs it")
    if options.json:
        sys.stdout.write(to_json(result).decode() + "\n")
    else:
        show_parts(bus_table(result))
    unmeasured = [
        f"{one.host} ({case.servos} x {case.model}, {case.against})"
        for case in result.cases
        for one in case.hosts
        if not one.exchanges
    ]
    if unmeasured:
        print_error(f"without a whole exchange, so not measured: {', '.join(unmeasured)}")
    return 1 if unmeasured else 0


def _cases(options: argparse.Namespace) -> list[tuple[Against, Case]]:
    protocols = [float(word) for word in _words("--protocol", options.protocol, ["1.0", "2.0"])]
    opponents = _words("--against", options.against, ["canned", "simulated"])
    if not 0.01 <= options.seconds <= 3600:
        raise InputError(f"--seconds {options.seconds:g}: give from 0.01 to 3600")
    if not 9600 <= options.baud <= 4_500_000:
        raise InputError(f"--baud {options.baud}: give from 9600 to 4500000")
    lines = [Case(each, count, options.baud) for each in protocols for count in _counts(options.servos)]
    cases: list[tuple[Against, Case]] = []
    if "canned" in opponents:
        cases += [("canned", case) for case in lines]
    if "simulated" in opponents:
        cases += [("simulated", case) for case in lines]
    return cases


def _words(option: str, text: str, known: list[str]) -> list[str]:
    words = [word.strip() for word in text.split(",") if word.strip()]
    if not words:
        raise InputError(f"{option} is empty; there are {', '.join(known)}")
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


def bus_table(result: BusBench) -> Table:
    """Return the table of an exchange's cost; ratios are those of the first host of each case."""
    wired = any(case.baud_rate for case in result.cases)
    columns = [
        *(Column(name, "name") for name in ("against", "protocol", "servos", "host")),
        *numbers("10 % us", "median us", "99 % us", "processor us", "bytes", "wall", "processor", "lost"),
        *(numbers("wire us", "late us", "x wire") if wired else ()),
    ]
    rows: list[tuple[Value, ...]] = []
    for case in result.cases:
        against = "canned" if case.baud_rate is None else f"{case.baud_rate / 1e6:g} Mbit/s"
        for one in case.hosts:
            times = (one.p10_us, one.median_us, one.p99_us, one.processor_us)
            rows.append(
                (
                    against,
                    f"{case.protocol:.1f}",
                    f"{case.servos} x {case.model}",
                    one.host,
                    *(_number(value, 0) for value in times),
                    f"{one.sent_bytes:g} + {one.received_bytes:g}",
                    *_ratios(case.hosts[0], one),
                    one.lost,
                    *(_wire(one) if wired else ()),
                )
            )
    return Table.from_rows("", columns, rows)


def _ratios(first: HostFigures, one: HostFigures) -> tuple[str, str]:
    if one is first:
        return "", ""
    wall, processor = first.wall_ratio[one.host], first.processor_ratio[one.host]
    return f"{_number(wall, 2)} of it", f"{_number(processor, 2)} of it"


def _number(value: float, digits: int) -> str:
    """Write a figure; of a host that never exchanged whole there is none."""
    return "-" if math.isnan(value) else f"{value:.{digits}f}"


def _wire(one: HostFigures) -> tuple[str, str, str]:
    if one.wire is None:
        return "", "", ""
    return f"{one.wire.wire_us:.0f}", f"{one.wire.late_us:.0f}", f"{one.wire.ratio:.2f}"
