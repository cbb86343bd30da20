"""`dxlrun servo PORT ID VERB`: read or change registers, ID, baud rate and state of one servo."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from dxlrun.cli.inputs import DebugFlag, Flag, JsonFlag
from dxlrun.cli.tools.scan import HIGHEST_ID, load_models, read_search
from dxlrun.cli.tools.tool_log import tool_log
from dxlrun.errors import InputError, ServoFault
from dxlrun.output.target import check_target
from dxlrun.output.terminal import print_warning, show_json, show_parts

if TYPE_CHECKING:
    from dxlrun.dynamixel.tools.one_node import OneNode
    from dxlrun.dynamixel.tools.one_servo import OneServo
    from dxlrun.dynamixel.tools.scanning import FoundServo, Search
    from dxlrun.dynamixel.tools.tool_line import ToolLine
    from dxlrun.output.text_table import Table
    from dxlwire.control_table import BaseControlTable as ControlTable
    from dxlwire.control_table import FoundDeviation

Keep = Literal["nothing", "id", "id-and-baud"]
NOTHING_CHANGED = "nothing was changed"


def servo(
    port: str,
    servo_id: Annotated[int, Parameter(name="ID")],
    verb: Annotated[str, Parameter(name="VERB")],
    /,
    *words: Annotated[str, Parameter(name="WORD", allow_leading_hyphen=False)],
    protocol: float | None = None,
    baud: int | None = None,
    keep: Annotated[Keep | None, Parameter(name="--except")] = None,
    yes: Flag = False,
    log: Path | None = None,
    as_json: JsonFlag = False,
    debug: DebugFlag = False,
) -> int:
    """Read or change one servo on a port that no run uses: registers, ID, baud rate, torque.

    VERB is one of: get [ITEM...], set ITEM VALUE, id NEW, baud RATE, reboot, factory-reset, backup [FILE],
    restore [FILE], blink [TIMES], torque on|off. A device that is not a servo has only get and set. A change
    of the EEPROM asks for confirmation, requires disabled torque, and is verified afterwards. Without FILE,
    backup and restore use the backup in the servo itself.

    Parameters
    ----------
    port
        Port of the adapter, for example /dev/ttyUSB0.
    servo_id
        ID of the servo. `dxlrun scan` lists the servos.
    verb
        Action on the servo.
    words
        Arguments of VERB.
    protocol
        Protocol, 1.0 or 2.0. Default: both are tried.
    baud
        Baud rate, bit/s. Default: all are tried.
    keep
        Settings that a factory reset keeps. Default: ID and baud rate (Protocol 2.0), or nothing (Protocol
        1.0).
    yes
        Do not ask for confirmation.
    log
        New log file for all packets.
    """
    from dxlrun.dynamixel.tools.one_node import OneDevice
    from dxlrun.dynamixel.tools.one_servo import OneServo
    from dxlrun.dynamixel.tools.tool_line import ToolLine
    from dxlrun.dynamixel.tools.tool_port import TunablePort

    search = read_search(protocol, () if baud is None else (baud,), None)
    asked = VerbCall(words, keep, yes)
    _check(servo_id, verb, asked)
    load_models()
    with (
        TunablePort(port) as line,
        tool_log(log, f"dxlrun servo {port} {servo_id} {verb}") as packets,
    ):
        tool = ToolLine(line, packets)
        found = _find(tool, servo_id, search)
        one = OneDevice(tool, found) if found.device else OneServo(tool, found)
        if isinstance(one, OneServo):
            done = VERBS[verb].do(one, asked)
        elif verb in _OF_DEVICES:
            done = _OF_DEVICES[verb](one, asked)
        else:
            raise InputError(f"{one.called} is not a servo and cannot {verb}; use get or set")
        asked.done += filter(None, done)
    _show(one, verb, asked, as_json=as_json)
    return 1 if asked.declined else 0


def _check(servo_id: int, verb: str, asked: VerbCall) -> None:
    """Raise InputError for an invalid ID, verb, words or option, before the port is opened."""
    if not 0 <= servo_id <= HIGHEST_ID:
        raise InputError(f"{servo_id} is not an ID of a servo; give 0 to {HIGHEST_ID}")
    found = VERBS.get(verb)
    if found is None:
        from dxlrun.errors import suggestion

        raise InputError(f"a servo cannot {verb}; {suggestion(verb, tuple(VERBS))}")
    if not found.fewest <= len(asked.words) <= found.most:
        given = " ".join(asked.words) or "nothing"
        raise InputError(f"{verb} takes {found.usage or 'no words'}, not {given}")
    if asked.keep is not None and verb != "factory-reset":
        raise InputError(f"--except belongs to factory-reset, not to {verb}; omit it")
    found.check(asked)


def _find(tool: ToolLine, servo_id: int, search: Search) -> FoundServo:
    """Return the servo or device with an ID; raises ServoFault when none answers, or more than one."""
    from dxlrun.dynamixel.tools.scanning import find_servo

    port, found = tool.port.name, find_servo(tool, servo_id, search)
    if not found:
        raise ServoFault(
            f"no servo with ID {servo_id} answers at {port}; check power, cable and ID (`dxlrun scan {port}` "
            "lists the servos)"
        )
    if len(found) > 1:
        places = "; ".join(f"Protocol {each.protocol} at {each.baud_rate} bit/s" for each in found)
        raise ServoFault(
            f"ID {servo_id} answers more than once ({places}); choose one by --protocol and --baud"
        )
    return found[0]


def _show(one: OneNode, verb: str, asked: VerbCall, *, as_json: bool) -> None:
    if as_json:
        identity = {
            "id": one.servo_id,
            "model": one.table.model,
            "firmware": one.found.firmware,
            "protocol": one.table.protocol,
            "baud_rate": one.baud_rate,
        }
        result = {"servo": identity, "verb": verb, "done": asked.done, "declined": asked.declined}
        deviations = {
            each.item.name: {"factory": each.factory, "judgement": each.judgement, "effect": each.effect}
            for each in asked.deviations
        }
        declined = [NOTHING_CHANGED] if asked.declined else []
        result |= {"registers": asked.registers, "deviations": deviations}
        show_json(result, code=len(declined), errors=declined)
        return
    if verb == "get":
        show_parts(_registers(asked.registers, one.table, asked.deviations))
    show_parts(*(f"{one.called}: {sentence}" for sentence in asked.done))
    if asked.declined:
        show_parts(NOTHING_CHANGED)


def _registers(values: Mapping[str, int], table: ControlTable, deviations: Sequence[FoundDeviation]) -> Table:
    from dxlrun.dynamixel.servo.registers import meaning
    from dxlrun.output.text_table import Column, Table

    columns = [
        Column("item", "name"),
        Column("address"),
        Column("area", "name"),
        Column("access", "name"),
        Column("value"),
        Column("is", "name"),
        Column("at start", "text"),
    ]
    judged = {
        each.item.name: f"{verdict}: {each.effect} (factory: {each.factory})"
        for each in deviations
        for verdict in ("refused" if each.refused else "reported",)
    }
    rows = [
        (
            name,
            *(item.address, item.area, item.access),
            *(value, meaning(item, value, table.errors), judged.get(name, "")),
        )
        for name, value in values.items()
        for item in (table.items[name],)
    ]
    return Table.from_rows("", columns, rows)


# The verbs. Each passes its words on, and returns its actions, one sentence each.


@dataclass(slots=True)
class VerbCall:
    """Words and options that a verb was called with, and its results for the output."""

    words: tuple[str, ...]
    keep: Keep | None
    yes: bool
    done: list[str] = field(default_factory=list)
    """Sentences about what was done, one for each action."""
    registers: dict[str, int] = field(default_factory=dict)
    """Values that were read, by control table item."""
    deviations: Sequence[FoundDeviation] = ()
    """Registers that differ from the factory's and affect a run."""
    declined: bool = False

    def confirmed(self, question: str) -> bool:
        """Ask for confirmation; return True if it is given, or --yes was.

        Raises InputError without a terminal.
        """
        if self.yes:
            return True
        if not sys.stdin.isatty():
            raise InputError(
                f"{question}: not a terminal, cannot ask for confirmation, nothing was changed; add --yes"
            )
        sys.stderr.write(f"{question}. Continue? [y/N] ")
        sys.stderr.flush()
        self.declined = sys.stdin.readline().strip().lower() not in ("y", "yes")
        return not self.declined


@dataclass(frozen=True, slots=True)
class Verb:
    """A verb of `dxlrun servo`: its usage, number of words, check and action."""

    usage: str
    """Words of the verb, as the help shows them."""
    fewest: int
    most: int
    do: Callable[[OneServo, VerbCall], Iterable[str]]
    check: Callable[[VerbCall], None] = lambda _: None
    """Checks the words of the verb before the port is opened; raises InputError."""


def _get(one: OneNode, asked: VerbCall) -> Iterable[str]:
    from dxlrun.errors import suggestion

    names = asked.words or tuple(name for name in one.table.items if not name.startswith("indirect_"))
    wrong = [name for name in names if name not in one.table.items]
    if wrong:
        known = tuple(one.table.items)
        raise InputError(
            "\n".join(f"an {one.table.model} has no {name}; {suggestion(name, known)}" for name in wrong)
        )
    asked.registers |= one.read_items(names, refused=not asked.words)
    asked.deviations = one.deviations(asked.registers)
    return ()


def _set(one: OneNode, asked: VerbCall) -> Iterable[str]:
    from dxlrun.compile.joints.register_values import any_value

    name, text = asked.words
    if name in one.NOT_SET:
        raise InputError(one.NOT_SET[name])
    if name in one.table.items and one.table.items[name].access == "R":
        raise InputError(f"{one.table.items[name].title} can only be read; `get` shows it")
    try:
        target = any_value(one.table, name, _value(text))
    # This includes UnfitRegister.
    except ValueError as error:
        raise InputError(str(error)) from None
    return one.set_register(target, asked.confirmed)


def _value(text: str) -> int | str:
    try:
        return int(text, 0)
    except ValueError:
        return text


def _backup(one: OneServo, asked: VerbCall) -> Iterable[str]:
    from dxlrun.dynamixel.tools import servo_backup

    if not asked.words:
        return (one.back_up(asked.confirmed),)
    asked.registers |= one.read_items(servo_backup.kept_items(one.table), refused=True)
    address = one.servo_id, one.baud_rate
    path = Path(asked.words[0])
    backup = servo_backup.stamped(one.table, one.found.firmware, address, asked.registers)
    servo_backup.write_backup(path, backup)
    return (f"{len(asked.registers)} registers saved in {path}",)


def _new_file(asked: VerbCall) -> None:
    if asked.words:
        check_target(Path(asked.words[0]))


def _restore(one: OneServo, asked: VerbCall) -> Iterable[str]:
    from dxlrun.dynamixel.tools import servo_backup

    if not asked.words:
        return (one.take_back(asked.confirmed),)
    path = Path(asked.words[0])
    backup = servo_backup.read_backup(path)
    target = servo_backup.registers_to_restore(path, backup, one.table)
    if backup.firmware != one.found.firmware:
        firmware = f"firmware {backup.firmware}, but this servo has {one.found.firmware}"
        print_warning(f"{path} was saved from {firmware}; compare the settings afterwards")
    return one.restore(target, path, asked.confirmed)


def _old_file(asked: VerbCall) -> None:
    from dxlrun.dynamixel.tools.servo_backup import read_backup

    if asked.words:
        read_backup(Path(asked.words[0]))


def _factory_reset(one: OneServo, asked: VerbCall) -> Iterable[str]:
    from dxlwire.wire.protocol2 import Reset

    keep = {"nothing": Reset.ALL, "id": Reset.KEEP_ID, "id-and-baud": Reset.KEEP_ID_AND_BAUD_RATE}
    return (one.factory_reset(None if asked.keep is None else keep[asked.keep], asked.confirmed),)


def _whole(what: str, lowest: int, highest: int) -> Callable[[VerbCall], None]:
    def check_words(asked: VerbCall) -> None:
        for word in asked.words:
            if not word.isdecimal() or not lowest <= int(word) <= highest:
                raise InputError(
                    f"{word!r} is not a possible {what}; give a whole number from {lowest} to {highest}"
                )

    return check_words


def _on_or_off(asked: VerbCall) -> None:
    if asked.words[0] not in ("on", "off"):
        raise InputError(f"torque cannot be {asked.words[0]!r}; write on or off")


_OF_DEVICES: Mapping[str, Callable[[OneNode, VerbCall], Iterable[str]]] = {"get": _get, "set": _set}
"""Verb that devices other than servos have -> its action."""
VERBS: Mapping[str, Verb] = MappingProxyType(
    {
        "get": Verb("[ITEM...]", 0, 1000, _get),
        "set": Verb("ITEM VALUE", 2, 2, _set),
        "id": Verb(
            "NEW",
            1,
            1,
            lambda one, asked: (one.change_id(int(asked.words[0]), asked.confirmed),),
            _whole("ID", 0, 253),
        ),
        "baud": Verb(
            "RATE",
            1,
            1,
            lambda one, asked: (one.change_rate(int(asked.words[0]), asked.confirmed),),
            _whole("baud rate", 9_600, 10_500_000),
        ),
        "reboot": Verb("", 0, 0, lambda one, asked: (one.reboot(asked.confirmed),)),
        "factory-reset": Verb("[--except nothing|id|id-and-baud]", 0, 0, _factory_reset),
        "backup": Verb("[FILE]", 0, 1, _backup, _new_file),
        "restore": Verb("[FILE]", 0, 1, _restore, _old_file),
        "blink": Verb(
            "[TIMES]",
            0,
            1,
            lambda one, asked: (one.blink(*map(int, asked.words)),),
            _whole("number of times", 1, 1000),
        ),
        "torque": Verb("on|off", 1, 1, lambda one, asked: one.torque(asked.words[0] == "on"), _on_or_off),
    }
)
