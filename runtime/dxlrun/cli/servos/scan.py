"""`dxlrun scan PORT`: who answers on a serial port, and a first robot file for them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from dxlrun.cli.output.flags import Flag, JsonFlag
from dxlrun.cli.output.terminal import out, say_error, say_warning
from dxlrun.errors import InputError

if TYPE_CHECKING:
    from rich.table import Table

    from dxlrun.dynamixel.tools.scanning import FoundServo, Scanned, Search

Rates = Annotated[tuple[int, ...], Parameter(negative=(), show_default=False)]
_HIGHEST_ID = 253
_FASTEST = 10_500_000


def scan(
    port: str,
    /,
    *,
    protocol: float | None = None,
    baud: Rates = (),
    ids: str | None = None,
    write: Path | None = None,
    as_json: JsonFlag = False,
    debug: Flag = False,
) -> int:
    """Look for servos on a serial port: both protocols, every baud rate, every ID; writes nothing.

    It takes about half a minute; --protocol, --baud and --ids make it quicker. Exit code 0, or 1 when nobody
    answered.

    Parameters
    ----------
    port
        The adapter, for example /dev/ttyUSB0; `dxlrun doctor` lists those that are plugged in.
    protocol
        Only this protocol, 1.0 or 2.0.
    baud
        Only this rate, bit/s; may be given several times.
    ids
        Only these IDs, for example 1-20 or 1,4,7.
    write
        Write a robot file for the servos that were found, to be completed by hand.
    as_json
        Print the result as JSON.
    debug
        Print the traceback of an error.
    """
    from dxlrun.cli.output.progress import progress_bar
    from dxlrun.dynamixel.tools import scanning
    from dxlrun.dynamixel.tools.tool_line import ToolLine, TunablePort

    search = read_search(protocol, baud, ids)
    if write is not None:
        from dxlrun.cli.servos.robot_draft import may_be_written

        may_be_written(write)
    load_models()
    with TunablePort(port) as line, progress_bar(hidden=as_json) as progress:
        scanned = scanning.scan(ToolLine(line), search, progress)
        latency_ns = line.latency_ns
    for rate in scanned.left_out:
        say_warning(f"{port} cannot run at {rate} bit/s; nobody was looked for there")
    narrowed = protocol is not None or bool(baud) or ids is not None
    _show(port, scanned, narrowed=narrowed, as_json=as_json)
    if write is not None and scanned.servos:
        from dxlrun.cli.servos.robot_draft import draft_file

        draft_file(write, port, scanned.servos, latency_ns)
        if not as_json:
            out().print(f"robot file: {write}; complete it, then `dxlrun check {write}`", soft_wrap=True)
    return 0 if scanned.servos else 1


def read_search(protocol: float | None, baud: Sequence[int], ids: str | None) -> Search:
    """Return where to look; raises InputError with everything that is wrong."""
    from dxlrun.dynamixel.tools.scanning import Search

    wrong = []
    if protocol not in (None, 1.0, 2.0):
        wrong.append(f"there is no Protocol {protocol:g}; --protocol is 1.0 or 2.0")
    wrong += [
        f"--baud {rate} is no rate of a servo; give bit/s from 9600 to {_FASTEST}"
        for rate in baud
        if not 9_600 <= rate <= _FASTEST
    ]
    chosen: tuple[int, ...] = ()
    try:
        chosen = () if ids is None else read_ids(ids)
    except InputError as error:
        wrong.append(str(error))
    if wrong:
        raise InputError("\n".join(wrong))
    return Search((2.0, 1.0) if protocol is None else (protocol,), tuple(dict.fromkeys(baud)), chosen)


def read_ids(text: str) -> tuple[int, ...]:
    """Return the IDs of `1-20` or `1,4,7`; raises InputError."""
    found: set[int] = set()
    for part in text.split(","):
        first, dash, last = part.partition("-")
        if not first.strip().isdecimal() or (dash and not last.strip().isdecimal()):
            raise InputError(f"--ids {text}: {part!r} is no ID; give for example 1-20 or 1,4,7")
        span = range(int(first), int(last if dash else first) + 1)
        if not span or span[-1] > _HIGHEST_ID:
            raise InputError(f"--ids {text}: {part} is no ID of a servo; they are 0..{_HIGHEST_ID}")
        found.update(span)
    return tuple(sorted(found))


def load_models() -> None:
    """Know the models that plug-ins bring along, too."""
    from dxlrun.control.controllers.plugins import load_plugins

    load_plugins()


def _show(port: str, scanned: Scanned, *, narrowed: bool, as_json: bool) -> None:
    if as_json:
        servos = [asdict(servo) for servo in scanned.servos]
        text = json.dumps({"port": port, "servos": servos, "left_out": scanned.left_out}, indent=2)
        out().file.write(text + "\n")
        return
    if not scanned.servos:
        say_error(
            f"nobody answers at {port}: check power, cable, and that the adapter is the one of the servos; "
            "`dxlrun doctor` lists the adapters"
            + "; without --protocol, --baud and --ids everything is tried"
            * narrowed
        )
        return
    from dxlrun.cli.output.narrow import fitting

    console = out()
    console.print(fitting(_table(scanned.servos), console.width))
    for servo in scanned.servos:
        for remark in servo.remarks:
            say_warning(f"ID {servo.servo_id} at {servo.baud_rate} bit/s: {remark}")


def _table(servos: Sequence[FoundServo]) -> Table:
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    for head in ("ID", "model", "number", "firmware", "protocol", "baud rate", "position", "return delay"):
        table.add_column(head, justify="left" if head == "model" else "right")
    for servo in servos:
        known = servo.model_number >= 0
        table.add_row(
            str(servo.servo_id),
            servo.model or "unknown",
            str(servo.model_number) if known else "",
            str(servo.firmware) if known else "",
            f"{servo.protocol:.1f}",
            str(servo.baud_rate),
            "" if servo.position is None else str(servo.position),
            "" if servo.return_delay is None else f"{servo.return_delay / 1000:g} us",
        )
    return table
