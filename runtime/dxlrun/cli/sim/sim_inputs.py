"""The options of `dxlrun sim`: servos by name, fault lines, the adapter; from words to buses."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from msgspec.structs import replace

from dxlrun.description.document import read_file
from dxlrun.errors import InputError, Mark, Problem

if TYPE_CHECKING:
    from dxlsim.faults.fault import Fault
    from dxlsim.simulation_plan import BusConfig
    from dxlwire.control_table import ControlTable

Split = Literal["whole", "byte", "random"]
Absent = Literal["silent", "slot"]

_SERVO = re.compile(r"(.+?):(\d+(?:-\d+)?(?:,\d+(?:-\d+)?)*)", re.ASCII)
_HIGHEST_ID = {1.0: 253, 2.0: 252}
"""254 is the broadcast ID; 253 is part of the header of Protocol 2.0 (e-Manual, Packet ID)."""
_MOST_DIGITS = 9
BUS = "main"  # Name of the bus that `--servo` makes


class Mistakes:
    """Mistakes in independent parts of a command line, reported together."""

    def __init__(self) -> None:
        self._errors: list[InputError] = []

    @contextmanager
    def collected(self) -> Iterator[None]:
        """Keep the InputError of a part."""
        try:
            yield
        except InputError as error:
            self._errors.append(error)

    def refuse(self) -> None:
        """Raise what was kept as one InputError, if anything was."""
        if len(self._errors) == 1:
            raise self._errors[0]
        if self._errors:
            raise InputError("\n".join(str(error) for error in self._errors))


def servo_bus(words: Sequence[str], baud_rate: int | None, protocol: float | None) -> BusConfig:
    """Return the bus of `--servo MODEL:IDS` words, each servo in the middle of its travel.

    The protocol is the one that all models speak, the baud rate the one that they are shipped with, where
    they are not given. Raises InputError with a sentence for each thing that is wrong.
    """
    from dxlrun.control.controllers.plugins import load_plugins
    from dxlsim.simulation_plan import BusConfig, ServoConfig
    from dxlwire.control_table import added_control_tables, control_table

    load_plugins()  # they may bring servo models along
    models = _models(words)
    spoken = _protocol([model for model, _ in models], protocol)
    _check_ids(models, spoken)
    tables = {model: control_table(model, spoken) for model, _ in models}
    rate = _baud_rate(list(tables.values()), baud_rate)
    servos = [
        ServoConfig(servo_id, tables[model].model, _middle(tables[model]))
        for model, servo_ids in models
        for servo_id in servo_ids
    ]
    return BusConfig(
        name=BUS,
        baud_rate=rate,
        servos=tuple(servos),
        protocol=spoken,
        control_tables=added_control_tables(table.model for table in tables.values()),
    )


def read_latency(text: str | None) -> int | None:
    """Return the time of `--latency-timer` in ns; raises InputError for one that is none."""
    from dxlrun.description.units import duration

    try:
        return None if text is None else duration(text)
    except ValueError as error:
        raise InputError(f"--latency-timer {text!r}: {error}") from None


def with_adapter(bus: BusConfig, given: Mapping[str, object], absent: Absent | None, seed: int) -> BusConfig:
    """Return a bus behind an adapter with the keys that are `given`; of None the bus has its own."""
    keys = {name: value for name, value in given.items() if value is not None}
    absent = absent or bus.adapter.absent
    return replace(bus, adapter=replace(bus.adapter, seed=seed, absent=absent, **keys))


def read_faults(lines: Sequence[str], file: Path | None) -> tuple[Fault, ...]:
    """Return the faults of `--fault` and of a file; raises InputError with all lines that are wrong.

    In a file, empty lines and what follows a # are left out.
    """
    from dxlsim.faults.fault import parse_fault

    faults: list[Fault] = []
    wrong: list[str] = []
    for line in lines:
        try:
            faults.append(parse_fault(line))
        except InputError as error:
            wrong.append(f"--fault {line!r}: {error}")
    placed, problems = ([], []) if file is None else _faults_of(file)
    if problems and not wrong:
        raise InputError(problems)  # each with its place, for an editor
    if wrong:
        raise InputError("\n".join([*wrong, *map(str, problems)]))
    return (*faults, *placed)


def _faults_of(file: Path) -> tuple[list[Fault], list[Problem]]:
    from dxlsim.faults.fault import parse_fault

    try:
        text = read_file(file).decode("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is no text"
        raise InputError(f"the faults in {file} cannot be read ({reason}); give a text file") from None
    faults: list[Fault] = []
    problems: list[Problem] = []
    for number, whole in enumerate(text.splitlines(), start=1):
        line = whole.partition("#")[0].strip()
        if not line:
            continue
        try:
            faults.append(parse_fault(line))
        except InputError as error:
            what, _, fix = str(error).rpartition("; ")
            column = 1 + len(whole) - len(whole.lstrip())
            problems.append(Problem(Mark(str(file), number, column), what, fix))
    return faults, problems


def _models(words: Sequence[str]) -> list[tuple[str, list[int]]]:
    found: list[tuple[str, list[int]]] = []
    wrong: list[str] = []
    for word in words:
        match = _SERVO.fullmatch(word)
        if match is None:
            wrong.append(
                f"--servo {word}: this is not MODEL:IDS; write it such as XL430-W250:1-3 or AX-12A:1,4"
            )
            continue
        try:
            found.append((match[1], _ids(match[2])))
        except ValueError as error:
            wrong.append(f"--servo {word}: {error}")
    wrong += _unknown([model for model, _ in found])
    if wrong:
        raise InputError("\n".join(wrong))
    return found


def _ids(text: str) -> list[int]:
    ids: list[int] = []
    for part in text.split(","):
        low, _, high = part.partition("-")
        if max(len(low), len(high)) > _MOST_DIGITS or int(high or low) > max(_HIGHEST_ID.values()):
            raise ValueError(f"{part} is no ID of a servo; IDs go from 0 to 252, with Protocol 1.0 to 253")
        if high and int(high) < int(low):
            raise ValueError(f"{part} is empty; write the lower ID first")
        ids += range(int(low), int(high or low) + 1)
    return ids


def _unknown(models: Sequence[str]) -> list[str]:
    from dxlwire.control_table import perhaps_meant, protocols_of

    return [
        f"--servo: there is no model {model}; {perhaps_meant(model)}"
        for model in dict.fromkeys(models)
        if not protocols_of(model)
    ]


def _protocol(models: Sequence[str], chosen: float | None) -> float:
    """Return the protocol that was chosen, or the one that all models have in common."""
    from dxlwire.control_table import protocols_of

    if chosen not in (None, 1.0, 2.0):
        raise InputError(f"there is no Protocol {chosen:g}; --protocol is 1.0 or 2.0")
    spoken = {model: protocols_of(model) for model in models}
    if chosen is not None:
        strange = [model for model, protocols in spoken.items() if chosen not in protocols]
        if strange:
            raise InputError(
                "\n".join(
                    f"{model} speaks Protocol {spoken[model][0]:.1f}, not {chosen:.1f}; leave --protocol out"
                    for model in strange
                )
            )
        return chosen
    common = [each for each in (1.0, 2.0) if all(each in protocols for protocols in spoken.values())]
    if not common:
        first = next(model for model, protocols in spoken.items() if protocols == (1.0,))
        second = next(model for model, protocols in spoken.items() if protocols == (2.0,))
        raise InputError(
            f"{first} speaks Protocol 1.0 and {second} Protocol 2.0; a bus has one protocol, "
            "write a robot file with two buses or start two simulations"
        )
    if len(common) > 1:
        names = " and ".join(spoken)
        exist = "exists" if len(spoken) == 1 else "exist"
        raise InputError(
            f"{names} {exist} with Protocol 1.0 and with 2.0; choose one by --protocol 1.0 or 2.0"
        )
    return common[0]


def _check_ids(models: Sequence[tuple[str, Sequence[int]]], protocol: float) -> None:
    highest = _HIGHEST_ID[protocol]
    wrong: list[str] = []
    owners: dict[int, str] = {}
    for model, ids in models:
        for servo_id in ids:
            if servo_id > highest:
                wrong.append(f"{model} cannot have ID {servo_id}; Protocol {protocol:.1f} goes to {highest}")
            elif servo_id in owners:
                wrong.append(
                    f"ID {servo_id} is given to {owners[servo_id]} and to {model}; "
                    f"give every servo its own, the fault `duplicate_id servo={servo_id}` adds a second one"
                )
            else:
                owners[servo_id] = model
    if wrong:
        raise InputError("\n".join(wrong))


def _baud_rate(tables: Sequence[ControlTable], chosen: int | None) -> int:
    if chosen is None:
        shipped = {table.model: _shipped_rate(table) for table in tables}
        rates = set(shipped.values())
        if len(rates) > 1 or None in rates:
            rated = ", ".join(f"{model} {rate or 'an unknown rate'}" for model, rate in shipped.items())
            raise InputError(
                f"the servos are shipped with different baud rates ({rated}); give one by --baud"
            )
        return next(rate for rate in rates if rate is not None)
    wrong = [
        f"an {table.model} has no baud rate of {chosen} bit/s; "
        f"it has {', '.join(str(rate) for rate in sorted(table.baud_rates.values()))}"
        for table in tables
        if not table.has_baud_rate(chosen)
    ]
    if wrong:
        raise InputError("\n".join(wrong))
    return chosen


def _shipped_rate(table: ControlTable) -> int | None:
    for name in ("baud_rate", "baud_rate_bus"):
        item = table.items.get(name)
        if item is not None and item.initial is not None:
            return table.baud_rates.get(item.initial)
    return None


def _middle(table: ControlTable) -> float:
    return (table.min_tick + table.max_tick) / 2 * table.rad_per_tick
