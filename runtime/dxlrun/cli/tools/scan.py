"""`dxlrun scan PORT`: find the servos and devices on a serial port, and draft a robot file."""

from __future__ import annotations

import json
import math
import re
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from dxlrun.cli.inputs import DebugFlag, JsonFlag
from dxlrun.cli.tools.tool_log import tool_log
from dxlrun.errors import InputError, ServoFault
from dxlrun.output.target import check_target, write_target
from dxlrun.output.terminal import print_error, print_warning, progress_bar, show_json, show_parts

if TYPE_CHECKING:
    from dxlrun.dynamixel.tools.scanning import FoundServo, ScanResult, Search
    from dxlrun.output.text_table import Table
    from dxlwire.control_table import ControlTable

Rates = Annotated[tuple[int, ...], Parameter(negative=(), show_default=False)]
HIGHEST_ID = 253
_FASTEST = 10_500_000
_SLOW = 30
"""Velocity limit of each drafted joint, deg/s: slow enough to step back from."""
_LONGEST_STEP = 3
"""Longest step of a goal per cycle, deg; at low rates it lowers the velocity limit, as servos step at full
speed.
"""
_RATES = (100, 50, 25, 20, 10, 5, 2, 1)
_SHARE = 0.5
"""Largest share of the loop's period that the bus may need at the drafted rate."""
_LONGEST_DELAY_NS = 500_000
"""Return delay of the draft, ns, when no servo reported its own: the factory's (protocol.md, Line)."""


def scan(
    port: str,
    /,
    *,
    protocol: float | None = None,
    baud: Rates = (),
    ids: str | None = None,
    output: Path | None = None,
    log: Path | None = None,
    as_json: JsonFlag = False,
    debug: DebugFlag = False,
) -> int:
    """Search a port for servos and devices: both protocols, all baud rates, all IDs.

    Nothing is written. The search takes about half a minute; --protocol, --baud and --ids make it faster.
    Exit code: 0, or 1 if no servo and no device answered.

    Parameters
    ----------
    port
        Port of the adapter, for example /dev/ttyUSB0. `dxlrun doctor` lists the connected adapters.
    protocol
        Protocol, 1.0 or 2.0, to search. Default: both.
    baud
        Baud rate, bit/s, to search. Can be given several times. Default: all baud rates.
    ids
        IDs to search, for example 1-20 or 1,4,7. Default: all IDs.
    output
        Output file for a draft of a robot file with the servos that were found. Complete it by hand.
    log
        New log file for all packets.
    """
    from dxlrun.dynamixel.tools import scanning
    from dxlrun.dynamixel.tools.tool_line import ToolLine
    from dxlrun.dynamixel.tools.tool_port import TunablePort

    search = read_search(protocol, baud, ids)
    if output is not None:
        check_draft(output)
    load_models()
    with (
        TunablePort(port) as line,
        tool_log(log, f"dxlrun scan {port}") as packets,
        progress_bar(hidden=as_json) as progress,
    ):
        scanned = scanning.scan(ToolLine(line, packets), search, progress)
        latency_ns, rates = line.latency_ns, line.other_rates
    narrowed = protocol is not None or bool(baud) or ids is not None
    _show(port, scanned, rates, narrowed=narrowed, as_json=as_json)
    if output is not None and scanned.servos:
        draft_file(output, port, scanned.servos, latency_ns)
        if not as_json:
            show_parts(f"robot file: {output}; complete it, then `dxlrun check {output}`")
    return 0 if scanned.servos else 1


def read_search(protocol: float | None, baud: Sequence[int], ids: str | None) -> Search:
    """Return the protocols, baud rates and IDs to search; raises InputError with all mistakes of the
    options.
    """
    from dxlrun.dynamixel.tools.scanning import Search

    wrong = []
    if protocol not in (None, 1.0, 2.0):
        wrong.append(f"--protocol {protocol:g} does not exist; give 1.0 or 2.0")
    wrong += [
        f"--baud {rate} is not a rate of a servo; give bit/s from 9600 to {_FASTEST}"
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
    """Return the sorted IDs of a text such as `1-20` or `1,4,7`; raises InputError."""
    found: set[int] = set()
    for part in text.split(","):
        first, dash, last = part.partition("-")
        if not first.strip().isdecimal() or (dash and not last.strip().isdecimal()):
            raise InputError(f"--ids {text}: {part!r} is not an ID; give for example 1-20 or 1,4,7")
        span = range(int(first), int(last if dash else first) + 1)
        if not span or span[-1] > HIGHEST_ID:
            raise InputError(f"--ids {text}: {part} is not an ID of a servo; give 0 to {HIGHEST_ID}")
        found.update(span)
    return tuple(sorted(found))


def load_models() -> None:
    """Load all plug-ins, so that their servo models are known."""
    from dxlrun.control.controllers.plugin_loading import load_plugins

    load_plugins()


def _show(port: str, scanned: ScanResult, rates: Mapping[int, int], *, narrowed: bool, as_json: bool) -> None:
    """Print what a scan found, with errors and warnings.

    `rates`: baud rate that the port does not support -> rate that the driver set; `narrowed`: options limited
    it.
    """
    from dxlwire.port.adapters import warnings_for
    from dxlwire.wire.dialect import ONE_PROTOCOL

    nothing = (
        f"no servo answers at {port}; check power, cable and port (`dxlrun doctor` lists the adapters)"
        + ", or omit --protocol, --baud and --ids to try everything" * narrowed
    )
    errors = [] if scanned.servos else [nothing]
    set_as = {rate: f": its driver set {real}" for rate, real in rates.items()}
    warnings = [
        f"{port} cannot run at {rate} bit/s{set_as.get(rate, '')}; this rate was skipped"
        for rate in scanned.left_out
    ]
    warnings += warnings_for(port)
    warnings += [
        f"ID {servo.servo_id} at {servo.baud_rate} bit/s: {remark}"
        for servo in scanned.servos
        for remark in servo.remarks
    ]
    if len({servo.protocol for servo in scanned.servos}) > 1:
        warnings.append(
            f"{port} has servos of both protocols: give each protocol an adapter of its own: {ONE_PROTOCOL}"
        )
    if as_json:
        found = {"port": port, "servos": scanned.servos, "left_out": scanned.left_out}
        show_json(found, code=len(errors), errors=errors, warnings=warnings)
        return
    if scanned.servos:
        show_parts(_table(scanned.servos))
    for warning in warnings:
        print_warning(warning)
    for error in errors:
        print_error(error)


def _table(servos: Sequence[FoundServo]) -> Table:
    from dxlrun.output.text_table import Column, Table

    columns = [
        Column("ID"),
        Column("model", "name", missing="unknown"),
        Column("number"),
        Column("firmware"),
        Column("protocol", form="{:.1f}"),
        Column("baud rate"),
        Column("position"),
        Column("return delay", form="{:g} us"),
    ]
    rows = [
        (
            servo.servo_id,
            servo.model or None,
            servo.model_number if servo.model_number >= 0 else None,
            servo.firmware if servo.model_number >= 0 else None,
            servo.protocol,
            servo.baud_rate,
            servo.position,
            None if servo.return_delay is None else servo.return_delay / 1000,
        )
        for servo in servos
    ]
    return Table.from_rows("", columns, rows)


# The draft of a robot file. Unknown properties (names of joints, zero positions, directions) are assumed, and
# marked by a comment in the draft.


def draft_file(path: Path, port: str, servos: Sequence[FoundServo], latency_ns: int) -> str:
    """Write a draft of a robot file with these servos on one bus, which `dxlrun check` accepts; return its
    text.

    Raises InputError when the file exists or cannot be written, ServoFault when these servos cannot share a
    bus: a port is one bus with one protocol and one rate.
    """
    check_draft(path)
    text = draft(path.stem, port, servos, latency_ns)
    write_target(path, text)
    return text


def check_draft(path: Path) -> None:
    """Raise InputError when a draft could not be written to a path: it exists, or does not end in .yaml."""
    check_target(path)
    if path.suffix not in (".yaml", ".yml"):
        raise InputError(f"{path} is not a name for a robot file; end it in .yaml")


def draft(stem: str, port: str, servos: Sequence[FoundServo], latency_ns: int) -> str:
    """Return the text of a drafted robot file, compiled as a test; raises ServoFault as `draft_file`."""
    from dxlwire.wire.dialect import ONE_PROTOCOL

    known = [servo for servo in servos if servo.model]
    if not any(not each.device for each in known):
        raise ServoFault("no servo of a known model was found, so no robot file was written")
    lines = sorted({(servo.protocol, servo.baud_rate) for servo in known})
    if len(lines) > 1:
        found = [
            f"Protocol {protocol} at {rate} bit/s: ID {_ids(known, protocol, rate)}"
            for protocol, rate in lines
        ]
        fix = f"give them one baud rate by `dxlrun servo {port} ID baud RATE`, or scan each alone by --baud"
        if lines[0][0] != lines[-1][0]:
            fix = f"scan each by --protocol, and give it an adapter of its own: {ONE_PROTOCOL}"
        raise ServoFault(f"these servos cannot share a bus ({'; '.join(found)}); {fix}")
    from dxlrun.compile.robot_compiler import compile_files

    text = _text(stem, port, known, latency_ns, rate=1)
    with tempfile.TemporaryDirectory() as folder:
        trial = Path(folder) / "draft.yaml"
        trial.write_text(text)
        budget = compile_files(trial, {}, []).plan.buses[0].budget
        rate = next((each for each in _RATES if budget.total_ns * 1e-9 * each <= _SHARE), 1)
        text = _text(stem, port, known, latency_ns, rate)
        trial.write_text(text)
        compile_files(trial, {}, [])
    return text


def _text(stem: str, port: str, servos: Sequence[FoundServo], latency_ns: int, rate: int) -> str:
    first = servos[0]
    delays = [each.return_delay for each in servos if each.return_delay is not None]
    delay_ns = max(delays, default=_LONGEST_DELAY_NS)
    velocity = min(_SLOW, _LONGEST_STEP * rate)
    movers = [servo for servo in servos if not servo.device]
    joints = [line for servo in movers for line in _joint(servo, velocity)]
    names = ", ".join(_name(servo) for servo in movers)
    devices = [
        f"  device_{each.servo_id}: {{bus: main, id: {each.servo_id}, model: {each.model}}}"
        for each in servos
        if each.device
    ]
    return "\n".join(
        [
            f"# Drafted by `dxlrun scan {port}`. What cannot be read from a servo is assumed:",
            "# check every line that has a comment.",
            "# Then: dxlrun check THIS_FILE --online",
            f"name: {_robot_name(stem)}",
            "",
            "arguments:",
            f"  port: {{default: {json.dumps(port)}, help: serial port of the adapter or sim}}",
            "",
            "buses:",
            "  main:",
            "    port: ${port}",
            f"    protocol: {first.protocol}",
            f"    baud_rate: {first.baud_rate}",
            f"    adapter: {{latency: {latency_ns * 1e-6:g} ms}}  # 0 ms without a latency timer",
            f"    return_delay_time: {delay_ns / 1000:g} us  # as found",
            "",
            "loop:",
            f"  rate: {rate}  # `dxlrun check` prints the highest possible rate",
            "",
            f"# Every joint is limited to {velocity} deg/s, so that the first commands move it slowly. Raise",
            "# limits.velocity after you have checked the limits and the direction of a joint.",
            "joints:  # choose names and directions; the reference is the servo's angle at joint position 0",
            *joints,
            *(("", "devices:", *devices) if devices else ()),
            "",
            "controllers:",
            "  joint_state_broadcaster: {type: joint_state_broadcaster}",
            f"  all_joints: {{type: joint_group_position_controller, joints: [{names}]}}",
            "",
        ]
    )


def _robot_name(stem: str) -> str:
    name = re.sub(r"[^a-z0-9_]", "_", stem.lower())
    return name if name[:1].isalpha() else f"robot_{name}"


def _joint(servo: FoundServo, velocity: int) -> list[str]:
    from dxlwire.control_table import find_table

    table = find_table(servo.model, servo.protocol)
    reference = _middle(table)
    entries = [
        f"bus: main, id: {servo.servo_id}, model: {servo.model}, reference: {reference} deg, direction: 1"
    ]
    limits = [f"velocity: {velocity} deg/s"]
    comment = "reference: middle of the travel"
    if servo.lowest is not None and servo.highest is not None:
        if servo.lowest >= servo.highest:
            comment += "; the servo has no position limits; write `continuous: true` for a wheel"
        elif servo.lowest > table.min_tick or servo.highest < table.max_tick:
            degrees = math.degrees(table.rad_per_tick)
            low = math.ceil((servo.lowest * degrees - reference) * 10) / 10
            high = math.floor((servo.highest * degrees - reference) * 10) / 10
            limits.insert(0, f"position: [{low:g} deg, {high:g} deg]")
            comment += "; position limits: the servo's own"
    entries.append(f"limits: {{{', '.join(limits)}}}")
    remarks = [f"  # {_name(servo)}: {remark}" for remark in servo.remarks]
    return [*remarks, f"  {_name(servo)}: {{{', '.join(entries)}}}  # {comment}"]


def _ids(servos: Sequence[FoundServo], protocol: float, rate: int) -> str:
    here = [each for each in servos if (each.protocol, each.baud_rate) == (protocol, rate)]
    return ", ".join(str(each.servo_id) for each in here)


def _name(servo: FoundServo) -> str:
    return f"joint_{servo.servo_id}"


def _middle(table: ControlTable) -> int:
    """Return the middle of a servo model's travel, deg from raw 0, rounded."""
    return round(math.degrees((table.min_tick + table.max_tick) / 2 * table.rad_per_tick))
