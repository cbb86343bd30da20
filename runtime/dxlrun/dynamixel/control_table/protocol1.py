"""Control tables of Protocol 1.0: our own data files, one a model, which may extend one another."""

from __future__ import annotations

import functools
import tomllib
from collections.abc import Mapping
from pathlib import Path

from dxlrun.dynamixel.control_table.sources import (
    Entry,
    Items,
    Listing,
    build_table,
    in_order,
    section,
    whole,
    words,
)

FOLDER = Path(__file__).parent / "tables" / "protocol1"


def protocol1_listings() -> tuple[Listing, ...]:
    """Return the models of all data files; their tables are built when they are asked for.

    Raises ValueError or KeyError when a data file is broken.
    """
    entries = {path.stem: tomllib.loads(path.read_text("utf-8")) for path in sorted(FOLDER.glob("*.toml"))}
    return tuple(_listing(resolve(name, entries)) for name in entries)


def _listing(data: Entry) -> Listing:
    return Listing(
        names=(str(data["model"]), *words(data["aliases"])),
        model_number=whole(data, "model_number"),
        firmware=0,
        build=functools.cache(lambda: build_table(data)),
    )


def resolve(name: str, entries: Mapping[str, Entry]) -> Entry:
    """Return a model's entry with what it takes over from the one that it `extends`.

    Items are merged key by key; `left_out` names items that the model does not have; the baud rates are taken
    over as a whole. Raises ValueError when the chain leads nowhere or in a circle, KeyError when an item
    that is to be left out is not there.
    """
    chain = [name]
    while (parent := entries[chain[-1]].get("extends")) is not None:
        if not isinstance(parent, str) or parent not in entries or parent in chain:
            raise ValueError(f"{chain[-1]}: it cannot extend {parent!r}")
        chain.append(parent)
    merged: dict[str, object] = {}
    items: Items = {}
    for each in reversed(chain):
        entry = entries[each]
        for left_out in words(entry.get("left_out", [])):
            del items[left_out]
        for item, new in section(entry.get("items", {})).items():
            items.setdefault(item, {}).update(section(new))
        merged.update(entry)
    return {**merged, "items": in_order(items)}
