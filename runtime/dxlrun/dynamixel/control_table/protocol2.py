"""Control tables of Protocol 2.0: the maker's own data files in dynamixel-sdk, completed and corrected.

The files give name, address and size of each item, and some units. What they lack (access, ranges, initial
values, no-load speeds) is in files of ours, what is wrong in them in `sdk_corrections.toml`, with a
reason each. Only the files are read; the SDK's code is never imported.
"""

from __future__ import annotations

import fnmatch
import functools
import importlib.util
import math
import re
import tomllib
from collections.abc import Iterator, Mapping, Set
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
from dxlrun.dynamixel.control_table.table import ControlTable

LAYER_FILES = (
    "every_model.toml",
    "x_and_mx.toml",
    "p.toml",
    "y.toml",
    "pro.toml",
    "models.toml",
    "sdk_corrections.toml",
)
"""In the order in which they are laid one over the other."""
FOLDER = Path(__file__).parent / "tables" / "protocol2"

_NOT_OF_THE_MODEL = frozenset({"models", "reason", "items", "left_out"})
_POSITIONS = frozenset(
    {
        "goal_position",
        "homing_offset",
        "max_position_limit",
        "min_position_limit",
        "position_trajectory",
        "present_position",
    }
)
"""Items with the unit of present position, unless a layer has another."""

_VELOCITIES = frozenset(
    {
        "goal_velocity",
        "moving_threshold",
        "present_velocity",
        "profile_velocity",
        "velocity_limit",
        "velocity_trajectory",
    }
)
"""Items with the unit of present velocity, unless a layer has another."""


def protocol2_listings() -> tuple[Listing, ...]:
    """Return all models of the SDK and those of our own; their tables are built when they are needed.

    Raises LookupError when dynamixel-sdk is not installed; `Listing.build` raises ValueError when a data file
    is broken.
    """
    numbers, files = _numbers(), sdk_files()
    stems = {path.stem for path in files}
    models = [(path.stem, path) for path in files] + list(_own_models())
    return tuple(_listing(stem, path, _own_entries(stem, stems, numbers)) for stem, path in models)


def sdk_files() -> tuple[Path, ...]:
    """Return the SDK's data files, one a model; raises LookupError when dynamixel-sdk is not installed."""
    return tuple(path for path in sorted(_sdk_folder().glob("*.model")) if path.name != "dynamixel.model")


def _own_models() -> Iterator[tuple[str, Path]]:
    """Yield models that the SDK has no file of: what the patterns match, and the file that each is like."""
    for entry in tomllib.loads((FOLDER / "own_models.toml").read_text("utf-8"))["models"]:
        own = FOLDER / f"{entry['like']}.model"
        yield entry["stem"], own if own.exists() else _sdk_folder() / own.name


def layers() -> tuple[Entry, ...]:
    """Return what is laid over the SDK's data, in this order: what it lacks, then what is wrong in it."""
    return tuple(layer for name in LAYER_FILES for layer in _layers(name))


@functools.cache
def _layers(name: str) -> tuple[Entry, ...]:
    return tuple(tomllib.loads((FOLDER / name).read_text("utf-8"))["layers"])


def _sdk_folder() -> Path:
    # the package is looked up but not imported: its __init__ imports all of its packet code
    found = importlib.util.find_spec("dynamixel_easy_sdk")
    if found is None or not found.submodule_search_locations:
        raise LookupError(
            "the control tables of Protocol 2.0 come with dynamixel-sdk, which is not installed"
        )
    return Path(found.submodule_search_locations[0]) / "control_table"


def _numbers() -> Mapping[str, int]:
    """File name -> model number."""
    numbers = {}
    for line in (_sdk_folder() / "dynamixel.model").read_text("utf-8").splitlines()[1:]:
        number, _, name = line.partition("\t")
        if name:
            numbers[name.strip()] = int(number)
    return numbers


def _listing(stem: str, path: Path, data: dict[str, object]) -> Listing:
    return Listing(
        names=(str(data["model"]), *words(data["aliases"])),
        model_number=whole(data, "model_number"),
        firmware=whole(data, "firmware"),
        build=functools.cache(lambda: _table(stem, path, data)),
    )


def _own_entries(stem: str, stems: Set[str], numbers: Mapping[str, int]) -> dict[str, object]:
    """Return the entries of the model itself, without its items."""
    family, _, version = stem.partition("_fw")
    newer = [int(each.removeprefix(f"{stem}_fw")) for each in stems if each.startswith(f"{stem}_fw")]
    data: dict[str, object] = {
        "model": model_name(family) + (f"-FW{min(newer) - 1}" if newer else ""),
        "aliases": [],
        "protocol": 2.0,
        "capabilities": [],
        "stall_torque": "0 Nm",
        "firmware": int(version or 0),
    }
    if (number := numbers.get(f"{family}.model")) is not None:
        data["model_number"] = number
    for layer in _layers_of(stem):
        data.update({key: value for key, value in layer.items() if key not in _NOT_OF_THE_MODEL})
    return data


def model_name(stem: str) -> str:
    """Return the maker's name of the model of a file: `xm430_w350` is the XM430-W350."""
    return re.sub(r"-RA$", "-R(A)", stem.upper().replace("_", "-"))


def _layers_of(stem: str) -> Iterator[Entry]:
    for layer in layers():
        if any(fnmatch.fnmatchcase(stem, pattern) for pattern in words(layer["models"])):
            yield layer


def _table(stem: str, path: Path, data: Mapping[str, object]) -> ControlTable:
    facts = dict(_sections(path.read_text("utf-8")))
    items = _bare_items(facts["control table"])
    _apply_units(items, facts)
    for layer in _layers_of(stem):
        _lay(layer, items)
    items["model_number"]["initial"] = data["model_number"]
    try:
        _complete(items, whole(data, "eeprom_end"))
        return build_table({**data, "items": in_order(items)})
    except (KeyError, ValueError) as error:
        raise ValueError(f"{stem}, {path.name}: {error}") from error


def _sections(text: str) -> Iterator[tuple[str, list[list[str]]]]:
    """Yield the sections of an SDK file: their title and their rows, the header left out."""
    title = ""
    rows: list[list[str]] = []
    for line in (*text.splitlines(), "[]"):
        if line.startswith("["):
            if title:
                yield title, rows[1:]
            title, rows = line.strip("[] "), []
        elif line.strip():
            rows.append([cell.strip() for cell in line.split("\t")])


def _bare_items(rows: list[list[str]]) -> Items:
    return {
        _snake_case(name): {
            "address": int(address),
            "size": int(size),
            "access": "RW",
            "encoding": "unsigned",
            "page": f"{name} ({address})",
        }
        for address, size, name in rows
    }


def _snake_case(name: str) -> str:
    return re.sub(r"\W+", "_", name).strip("_").lower()


def _apply_units(items: Items, facts: Mapping[str, list[list[str]]]) -> None:
    """Take over the SDK's units: position as a ratio of ranges, velocity in rad/s (its currents are raw)."""
    kind = {row[0]: float(row[1]) for row in facts["type info"]}
    low, high = kind["value_of_min_radian_position"], kind["value_of_max_radian_position"]
    turn = math.degrees(kind["max_radian"] - kind["min_radian"])
    for name in ("goal_position", "present_position"):
        items[name] |= {"minimum": int(low), "maximum": int(high)}
    for name in _POSITIONS & items.keys():
        items[name]["tick"] = f"{turn}/{high - low} deg"
    velocity = next(float(row[1]) for row in facts["unit info"] if row[0] == "Present Velocity")
    for name in _VELOCITIES & items.keys():
        items[name]["tick"] = f"{velocity * 30 / math.pi} rpm"


def _lay(layer: Entry, items: Items) -> None:
    """Lay one layer over the items of a model: items changed, added, left out."""
    for name in words(layer.get("left_out", [])):
        items.pop(name, None)
    for name, entry in section(layer.get("items", {})).items():
        change = section(entry)
        if name in items:
            items[name].update(change)
        elif "address" in change:
            items[name] = {"access": "RW", "encoding": "unsigned", **change}


def _complete(items: Items, eeprom_end: int) -> None:
    """Fill in what follows from the rest: area from the address, range from size and encoding, series."""
    for name in tuple(items):
        _expand(name, items)
    for item in items.values():
        signed = item["encoding"] == "twos_complement"
        bits = 8 * whole(item, "size") - signed
        item.setdefault("minimum", -(1 << bits) if signed else 0)
        item.setdefault("maximum", (1 << bits) - 1)
        item.setdefault("area", "EEPROM" if whole(item, "address") < eeprom_end else "RAM")


def _expand(name: str, items: Items) -> None:
    """Replace an item that `repeat`s by as many, numbered on: `indirect_address_1` by 1..28."""
    first = items[name]
    repeat = first.pop("repeat", 1)
    if not isinstance(repeat, int) or repeat == 1:
        return
    stem, _, number = name.rpartition("_")
    points_at = first.pop("initial_from", None)
    for step in range(repeat):
        item = {**first, "address": whole(first, "address") + step * whole(first, "size")}
        if isinstance(points_at, int):
            item["initial"] = points_at + step
        items[f"{stem}_{int(number) + step}"] = item
