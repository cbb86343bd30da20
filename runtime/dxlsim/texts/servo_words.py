"""Servo words: parses the servos of one bus in the syntax of a command line: `XL430-W250:1-3`."""

from __future__ import annotations

import re
from collections.abc import Sequence

from dxlsim.simulation_plan import BusConfig, ServoConfig
from dxlwire.control_table import (
    ControlTable,
    added_control_tables,
    find_table,
    perhaps_meant,
    protocols_of,
)
from dxlwire.exceptions import InputError

BUS = "main"  # Name of the bus
_SERVO = re.compile(r"(.+?):(\d+(?:-\d+)?(?:,\d+(?:-\d+)?)*)", re.ASCII)
_HIGHEST_ID = {1.0: 253, 2.0: 252}
"""Highest ID of a servo by protocol: 254 is the broadcast ID; 253 is part of the header of Protocol 2.0
(e-Manual, Packet ID)."""
_MOST_DIGITS = 9


def bus_of_servos(
    words: Sequence[str], baud_rate: int | None = None, protocol: float | None = None
) -> BusConfig:
    """Return the configuration of a simulated bus with servos written as `MODEL:IDS`, each in the middle
    of its travel.

    Args:
        words: Models with their IDs, such as `XL430-W250:1-3` or `AX-12A:1,4`.
        baud_rate: bit/s; None: the common factory setting of all models.
        protocol: 1.0 or 2.0; None: the common protocol of all models.

    Raises:
        InputError: A model, an ID, the protocol or the baud rate does not fit. The message has a sentence
            for each error, with the options of a command line: `--servo`, `--baud`, `--protocol`.

    Example:
        >>> bus = bus_of_servos(["XL430-W250:1-3"])
        >>> bus.protocol, bus.baud_rate, [servo.servo_id for servo in bus.servos]
        (2.0, 57600, [1, 2, 3])
    """
    models = _models(words)
    spoken = _protocol([model for model, _ in models], protocol)
    _check_ids(models, spoken)
    tables = {model: find_table(model, spoken) for model, _ in models}
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
            raise ValueError(f"{part} is not a servo ID; write an ID from 0 to 252 (Protocol 1.0: to 253)")
        if high and int(high) < int(low):
            raise ValueError(f"{part} is reversed; write the lower ID first")
        ids += range(int(low), int(high or low) + 1)
    return ids


def _unknown(models: Sequence[str]) -> list[str]:
    return [
        f"--servo: unknown model {model}; {perhaps_meant(model)}"
        for model in dict.fromkeys(models)
        if not protocols_of(model)
    ]


def _protocol(models: Sequence[str], chosen: float | None) -> float:
    """Return the chosen protocol, or the common protocol of all models. Raises InputError if none fits."""
    if chosen not in (None, 1.0, 2.0):
        raise InputError(f"unknown protocol {chosen:g}; write --protocol 1.0 or 2.0")
    spoken = {model: protocols_of(model) for model in models}
    if chosen is not None:
        strange = [model for model, protocols in spoken.items() if chosen not in protocols]
        if strange:
            raise InputError(
                "\n".join(
                    f"{model} uses Protocol {spoken[model][0]:.1f}, not {chosen:.1f}; omit --protocol"
                    for model in strange
                )
            )
        return chosen
    common = [each for each in (1.0, 2.0) if all(each in protocols for protocols in spoken.values())]
    if not common:
        first = next(model for model, protocols in spoken.items() if protocols == (1.0,))
        second = next(model for model, protocols in spoken.items() if protocols == (2.0,))
        raise InputError(
            f"{first} uses Protocol 1.0, but {second} uses Protocol 2.0; "
            "simulate each protocol on its own bus, with a robot file or two commands"
        )
    if len(common) > 1:
        names = " and ".join(spoken)
        support = "supports" if len(spoken) == 1 else "support"
        raise InputError(f"{names} {support} Protocol 1.0 and 2.0; choose with --protocol 1.0 or 2.0")
    return common[0]


def _check_ids(models: Sequence[tuple[str, Sequence[int]]], protocol: float) -> None:
    highest = _HIGHEST_ID[protocol]
    wrong: list[str] = []
    owners: dict[int, str] = {}
    for model, ids in models:
        for servo_id in ids:
            if servo_id > highest:
                wrong.append(
                    f"ID {servo_id} of {model} is too high for Protocol {protocol:.1f}; "
                    f"write an ID up to {highest}"
                )
            elif servo_id in owners:
                wrong.append(
                    f"ID {servo_id} is given to {owners[servo_id]} and to {model}; "
                    f"give each ID once (for a second servo: --fault 'duplicate_id servo={servo_id}')"
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
                f"the servos have different factory baud rates ({rated}); choose a rate with --baud"
            )
        return next(rate for rate in rates if rate is not None)
    wrong = [
        f"{table.model} does not support {chosen} bit/s; "
        f"choose from {', '.join(str(rate) for rate in sorted(table.baud_rates.values()))}"
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
