"""`dxlrun servo PORT ID VERB`: one servo, its registers, its address, its state."""

from __future__ import annotations

import json
import math
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from dxlrun.cli.output.flags import Flag, JsonFlag
from dxlrun.cli.output.terminal import out
from dxlrun.cli.servos.scan import load_models, read_search
from dxlrun.cli.servos.servo_verbs import VERBS, Asked, Keep
from dxlrun.errors import InputError, ServoFault

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rich.table import Table

    from dxlrun.dynamixel.control_table import ControlItem
    from dxlrun.dynamixel.tools.one_servo import OneServo
    from dxlrun.dynamixel.tools.scanning import FoundServo, Search
    from dxlrun.dynamixel.tools.tool_line import ToolLine

_HIGHEST_ID = 253


def servo(
    port: str,
    servo_id: Annotated[int, Parameter(name="ID")],
    verb: Annotated[str, Parameter(name="VERB")],
    /,
    *words: Annotated[str, Parameter(name="WORD", allow_leading_hyphen=False)],
    protocol: float | None = None,
    baud: int | None = None,
    keep: Keep | None = None,
    yes: Flag = False,
    as_json: JsonFlag = False,
    debug: Flag = False,
) -> int:
    """Deal with one servo on a port that no run uses: its registers, ID, baud rate, torque.

    VERB is one of: get [ITEM...], set ITEM VALUE, id NEW, baud RATE, reboot, factory-reset, backup [FILE],
    restore [FILE], blink [TIMES], torque on|off. What changes the EEPROM is asked for first, needs the torque
    off, and is looked at afterwards. Without FILE the servo's own backup is meant.

    Parameters
    ----------
    port
        The adapter, for example /dev/ttyUSB0.
    servo_id
        ID of the servo; `dxlrun scan` shows who is there.
    verb
        What to do.
    words
        What the verb needs.
    protocol
        Protocol of the servo, 1.0 or 2.0; without it both are tried.
    baud
        Its rate, bit/s; without it all are tried.
    keep
        What a factory reset keeps; without it ID and baud rate (Protocol 2.0), or nothing (Protocol 1.0).
    yes
        Do not ask before the EEPROM is changed.
    as_json
        Print the result as JSON.
    debug
        Print the traceback of an error.
    """
    from dxlrun.dynamixel.tools.one_servo import OneServo
    from dxlrun.dynamixel.tools.tool_line import ToolLine, TunablePort

    search = read_search(protocol, () if baud is None else (baud,), None)
    asked = Asked(words, keep, yes)
    _check(servo_id, verb, asked)
    load_models()
    with TunablePort(port) as line:
        tool = ToolLine(line)
        one = OneServo(tool, _find(tool, servo_id, search))
        VERBS[verb].do(one, asked)
    _tell(one, verb, asked, as_json=as_json)
    return 1 if asked.declined else 0


def _check(servo_id: int, verb: str, asked: Asked) -> None:
    """Refuse words that mean nothing before the port is opened; raises InputError."""
    if not 0 <= servo_id <= _HIGHEST_ID:
        raise InputError(f"{servo_id} is no ID of a servo; they are 0..{_HIGHEST_ID}")
    found = VERBS.get(verb)
    if found is None:
        from dxlrun.errors import suggestion

        raise InputError(f"a servo cannot {verb}; {suggestion(verb, tuple(VERBS))}")
    if not found.fewest <= len(asked.words) <= found.most:
        said = " ".join(asked.words) or "nothing"
        raise InputError(f"{verb} takes {found.usage or 'no words'}, not {said}")
    if asked.keep is not None and verb != "factory-reset":
        raise InputError(f"--keep belongs to factory-reset, not to {verb}; leave it out")
    found.check(asked)


def _find(tool: ToolLine, servo_id: int, search: Search) -> FoundServo:
    """Look for the servo; raises ServoFault where it is not there, or is there more than once."""
    from dxlrun.dynamixel.tools.scanning import find

    port, found = tool.port.name, find(tool, servo_id, search)
    if not found:
        raise ServoFault(
            f"nobody with ID {servo_id} answers at {port}: check power, cable and ID; `dxlrun scan {port}` "
            "shows who is there"
        )
    if len(found) > 1:
        places = "; ".join(f"Protocol {each.protocol} at {each.baud_rate} bit/s" for each in found)
        raise ServoFault(
            f"ID {servo_id} answers more than once ({places}); say which by --protocol and --baud"
        )
    return found[0]


def _tell(one: OneServo, verb: str, asked: Asked, *, as_json: bool) -> None:
    if as_json:
        identity = {
            "id": one.servo_id,
            "model": one.table.model,
            "firmware": one.found.firmware,
            "protocol": one.table.protocol,
            "baud_rate": one.baud_rate,
        }
        result = {"servo": identity, "verb": verb, "done": asked.done, "declined": asked.declined}
        text = json.dumps(result | {"registers": asked.registers}, indent=2, ensure_ascii=False)
        out().file.write(text + "\n")
        return
    if verb == "get":
        from dxlrun.cli.output.narrow import fitting

        console = out()
        console.print(fitting(_registers(asked.registers, one.table.items), console.width))
    for sentence in asked.done:
        out().print(f"{one.called}: {sentence}", markup=False, soft_wrap=True)
    if asked.declined:
        out().print("nothing was changed", soft_wrap=True)


def _registers(values: Mapping[str, int], items: Mapping[str, ControlItem]) -> Table:
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    for head in ("item", "address", "area", "access", "value", "is"):
        table.add_column(head, justify="right" if head in ("address", "value") else "left")
    for name, value in values.items():
        item = items[name]
        table.add_row(name, str(item.address), item.area, item.access, str(value), _meaning(item, value))
    return table


def _meaning(item: ControlItem, value: int) -> str:
    """Return a value with its unit; empty for what has none."""
    from dxlrun.dynamixel.servo.watchdog import tripped

    if tripped(item, value):
        return "tripped"
    if not item.unit:
        return ""
    quantity = item.decode(value.to_bytes(item.size, "little", signed=item.signed)) * item.scale
    if item.unit == "s" and abs(quantity) < 1:
        return f"{quantity * 1e3:.6g} ms" if abs(quantity) >= 1e-3 else f"{quantity * 1e6:.6g} us"
    if item.unit.startswith("rad"):
        return f"{math.degrees(quantity):.6g} {item.unit.replace('rad', 'deg')}"
    return f"{quantity * 100:.6g} %" if item.unit == "1" else f"{quantity:.6g} {item.unit}"
