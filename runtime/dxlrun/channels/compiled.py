"""Compiled sources: the C files of this package as shared objects, and their structs as ctypes has them."""

from __future__ import annotations

import ctypes
import re
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import TypeVar
from zlib import crc32

from dxlrun.errors import StartUpError

_HINT = "install dxlrun again"
SOURCES = tuple(
    Path(__file__).parents[2] / name
    for name in ("dxlrun/channels/shared_memory.c", "dxlrun/control/gate.c", "dxlwire/exchange/kernel.c")
)
"""All that the build compiles."""
Library = TypeVar("Library", bound=ctypes.CDLL)


def missing() -> str:
    """Return why what is compiled cannot be used, in one sentence; empty: it can."""
    try:
        for source in SOURCES:
            compiled(source, ctypes.PyDLL)
    except StartUpError as error:
        return f"{error}"
    return ""


def compiled(source: Path, kind: type[Library], path: Path | None = None) -> Library:
    """Return what the build compiled of a C source, which lies beside it.

    Raises StartUpError where it was not built, or of another source.
    """
    try:
        library = kind(str(path or source.with_name(f"lib{source.stem}.so")))
        known = library.dxl_source() & 0xFFFFFFFF
    except (OSError, AttributeError):
        raise StartUpError(f"the compiled {source.stem} is missing: {_HINT}") from None
    if known != crc32(source.read_bytes()):
        raise StartUpError(
            f"the compiled {source.stem} is of another source than {source.name} beside it: {_HINT}"
        )
    return library


def structs(source: str) -> Mapping[str, type[ctypes.Structure]]:
    """Return the structs that a C source defines, by name; a pointer is an address.

    Their fields are numbers of fixed size, pointers to anything, structs above, and arrays of these.
    """
    text = re.sub(r"/\*.*?\*/", "", source, flags=re.DOTALL)
    sizes = dict(re.findall(r"#define (\w+) (\d+)", text))
    found: dict[str, type[ctypes.Structure]] = {}
    for body, struct in re.findall(r"typedef struct(?: \w+)? \{(.*?)\n\} (\w+);", text, re.DOTALL):
        fields: list[tuple[str, type[ctypes._CDataType]]] = []
        for line in body.replace("const ", "").split(";")[:-1]:
            if function := re.search(r"\(\*(\w+)\)", line):
                fields.append((function[1], ctypes.c_void_p))
                continue
            kind, names = line.split(maxsplit=1)
            for star, name, count in re.findall(r"(\*?)(\w+)(?:\[(\w+)\])?(?:, |$)", names):
                one = (
                    ctypes.c_void_p
                    if star
                    else found.get(kind) or getattr(ctypes, f"c_{kind.removesuffix('_t')}")
                )
                fields.append((name, one * int(sizes.get(count, count)) if count else one))
        found[struct] = type(struct, (ctypes.Structure,), {"_fields_": fields})
    return MappingProxyType(found)
