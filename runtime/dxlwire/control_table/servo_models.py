"""Servo models: finds the control table of a servo by name or number, among shipped data files and those
of plug-ins."""

from __future__ import annotations

import functools
import math
import re
from collections.abc import Iterable, Mapping
from types import MappingProxyType

from dxlwire.control_table.control_items import BaseControlTable, ControlTable
from dxlwire.control_table.table_files import Listing, listings, read_control_table
from dxlwire.exceptions import suggestion

_ADDED: dict[float, list[Listing]] = {1.0: [], 2.0: []}
"""Models that plug-ins added, by protocol; added during process start, before the first robot file is
read."""
_MOST_MEANT = 4  # More suggestions than this do not help
_SERIES = re.compile(r"[0-9]?[A-Z]+[0-9]{3}")
_TEXTS: dict[str, str] = {}  # Name -> TOML text of the added tables


def find_table(model: str, protocol: float | None = None) -> ControlTable:
    """Return the control table of a servo model; `understood` lists the accepted spellings of its name.

    Args:
        model: Name or alias of the model.
        protocol: 1.0 or 2.0. Required for MX servos, whose two firmwares share one name.

    Raises:
        LookupError: The model is unknown, does not speak the protocol, or speaks both and none was given.
    """
    model = str(model)  # of a script, which may give the model number
    if protocol is not None and (table := _table(model, protocol)) is not None:
        return table
    spoken = protocols_of(model)
    if not spoken:
        raise LookupError(f"no control table for the model {model!r}; {perhaps_meant(model, protocol)}")
    if protocol is not None and protocol not in spoken:
        raise LookupError(f"{model} uses Protocol {spoken[0]}, not Protocol {protocol}")
    if protocol is None and len(spoken) > 1:
        raise LookupError(f"{model} supports Protocol 1.0 and 2.0; give the protocol")
    listing = understood(model, spoken[0] if protocol is None else protocol)
    if listing is None:  # Unreachable, because protocols_of has just found it
        raise LookupError(f"no control table for the model {model!r}")
    return listing.build()


def protocols_of(model: str) -> tuple[float, ...]:
    """Return the protocols in which a servo model exists, by any accepted spelling of its name; empty if
    the model is unknown."""
    return tuple(each for each in (1.0, 2.0) if understood(model, each) is not None)


def understood(name: str, protocol: float) -> Listing | None:
    """Return the servo model that a name identifies in a protocol; None if no model fits, or several.

    Accepted in addition to the names of models and their aliases: other case and punctuation (AX12,
    xl_320), the product name with its connector (XL430-W250-T or -R), and the series of a model that is
    the only one in it (XL430, XL-430)."""
    known = _index(protocol)
    if name in known:
        return known[name]
    key = _key(name)
    names = [(_key(each), listing) for each, listing in known.items()]
    series = [(_key(each.partition("-")[0]), listing) for each, listing in known.items()]
    ways = [(key, names)]
    ways += [(key[:-1], names)] if key.endswith(("T", "R")) else []
    ways += [(key, series)] if _SERIES.fullmatch(key) else []
    for part, keys in ways:
        found = {listing.names[0]: listing for each, listing in keys if each == part}
        if len(found) == 1:
            return next(iter(found.values()))
    return None


def _key(name: str) -> str:
    return "".join(filter(str.isalnum, name.upper()))


def model_names(protocol: float | None = None) -> tuple[str, ...]:
    """Return the exact names and aliases of all servo models, sorted; with `protocol` only those of that
    protocol."""
    return tuple(sorted({name for each in (1.0, 2.0) if protocol in (None, each) for name in _index(each)}))


def perhaps_meant(name: str, protocol: float | None = None) -> str:
    """Return a hint for an unknown servo model name, such as `did you mean ...?`."""
    protocols = (1.0, 2.0) if protocol is None else (protocol,)
    numbered = [models_by_number(int(name), each)[:1] for each in protocols if re.fullmatch(r"\d{1,5}", name)]
    if models := [table.model for tables in numbered for table in tables]:
        return f"write {' or '.join(models)}, the name of this model number"
    return beginning_or_near(name, model_names(protocol))


def perhaps_meant_item(name: str, table: BaseControlTable, known: Iterable[str] = ()) -> str:
    """Return a hint for an unknown item of a model: similar names, or those with this word.

    Args:
        name: The unknown name.
        table: Control table of the model.
        known: Names of the possible items, by default all.
    """
    known = [*(known or table.items)]
    longer = [each for each in known if name in each.split("_")]
    otherwise = f"`dxlrun models {table.model}` lists the items"
    if 0 < len(longer) <= _MOST_MEANT:
        otherwise = f"did you mean {' or '.join(longer)}?"
    return suggestion(name, known, otherwise)


def beginning_or_near(name: str, known: Iterable[str]) -> str:
    """Return a hint for an unknown name: the known names that start with it, else the most similar ones."""
    keys = {_key(each): each for each in sorted(known, reverse=True)}
    key = _key(name)
    meant = sorted(each for each in keys if key and each.startswith(key))
    if 0 < len(meant) <= _MOST_MEANT:
        return f"did you mean {' or '.join(keys[each] for each in meant)}?"
    return suggestion(name, keys.values(), "`dxlrun models` lists all")


def all_tables() -> tuple[ControlTable, ...]:
    """Return the control table of every servo model once, sorted by protocol, model number and firmware."""
    tables = [listing.build() for listing in (*_listings(1.0), *_listings(2.0))]
    return tuple(sorted(tables, key=lambda each: (each.protocol, each.model_number, each.firmware)))


def models_by_number(number: int, protocol: float, firmware: float = math.inf) -> tuple[ControlTable, ...]:
    """Return the control tables of servos with this model number, newest firmware first.

    The result is empty for an unknown number. It has several tables if the table depends on the firmware;
    the first one then belongs to the given `firmware`."""
    found = [listing.build() for listing in _listings(protocol) if listing.model_number == number]
    fitting = [each for each in found if each.firmware <= firmware]
    return tuple(sorted(fitting, key=lambda each: -each.firmware))


def add_control_table(text: str) -> ControlTable:
    """Register a servo model from a plug-in, and return its table.

    Args:
        text: TOML text of a data file.

    Raises:
        ValueError: The text is not a control table, or one of its names or its number is taken.
    """
    try:
        table = read_control_table(text)
    except KeyError as error:
        raise ValueError(f"the entry {error} is missing") from error
    names = (table.model, *table.aliases)
    for listing in _listings(table.protocol):
        if listing.model_number == table.model_number or set(names) & set(listing.names):
            if listing.build() == table:
                return table  # A process may load its plug-ins twice
            raise ValueError(
                f"a name of {table.model}, or its model number {table.model_number}, is already used by the "
                f"{listing.names[0]}"
            )
    _ADDED[table.protocol].append(Listing(names, table.model_number, table.firmware, lambda: table))
    _TEXTS.update(dict.fromkeys(names, text))
    return table


def added_control_tables(models: Iterable[str]) -> tuple[str, ...]:
    """Return the TOML texts of those of these models that plug-ins added; shipped models are omitted.

    A process that does not load plug-ins can add them from these texts."""
    return tuple(dict.fromkeys(_TEXTS[model] for model in models if model in _TEXTS))


def _table(name: str, protocol: float) -> ControlTable | None:
    # No dict is built here: the lookup of a servo that comes back runs inside the loop.
    listing = _shipped(protocol).get(name)
    if listing is None:
        listing = next((each for each in _ADDED.get(protocol, ()) if name in each.names), None)
    return None if listing is None else listing.build()


def _index(protocol: float) -> Mapping[str, Listing]:
    return {**_shipped(protocol), **{name: each for each in _ADDED.get(protocol, ()) for name in each.names}}


def _listings(protocol: float) -> tuple[Listing, ...]:
    return tuple({listing.names[0]: listing for listing in _index(protocol).values()}.values())


@functools.cache
def _shipped(protocol: float) -> Mapping[str, Listing]:
    """Return the shipped models of one protocol, by name and alias. The files of the other protocol are
    not read until needed."""
    found: dict[str, Listing] = {}
    for listing in listings(protocol):
        for name in listing.names:
            if name in found:
                raise ValueError(f"the model {name!r} is in two control tables")
            found[name] = listing
    return MappingProxyType(found)
