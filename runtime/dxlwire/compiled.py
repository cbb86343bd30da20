"""Compiled C sources: loads their shared objects, and gives their structs and memory to ctypes."""

from __future__ import annotations

import ctypes
import re
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import TypeVar
from zlib import crc32

from dxlwire.exceptions import NotCompiled, help_link

_HINT = "install dxlrun again"  # The distribution that contains dxlwire
Library = TypeVar("Library", bound=ctypes.CDLL)


def load_compiled(source: Path, kind: type[Library], path: Path | None = None) -> Library:
    """Load the shared object that was compiled from a C source when the package was built.

    Args:
        source: The C file. It defines `dxl_source`, which returns the checksum of the compiled source.
        kind: Type of the library, such as `ctypes.CDLL`.
        path: The shared object; None: the file next to the source.

    Raises:
        NotCompiled: The object is missing, or was compiled from another source.
    """
    try:
        library = kind(str(path or source.with_name(f"lib{source.stem}.so")))
        known = library.dxl_source() & 0xFFFFFFFF
    except (OSError, AttributeError):
        raise NotCompiled(f"the compiled {source.stem} is missing; {_HINT}") from None
    if known != crc32(source.read_bytes()):
        raise NotCompiled(
            f"the compiled {source.stem} does not match {source.name}; {_HINT}; "
            f"{help_link('a-compiled-part-is-missing-or-old')}"
        )
    return library


def parse_structs(source: str) -> Mapping[str, type[ctypes.Structure]]:
    """Return the structs that the text of a C source defines, as ctypes classes by name. Pointers become
    addresses (`c_void_p`).

    Supported fields are numbers of fixed size, pointers, structs defined earlier in the source, and arrays
    of these."""
    # Comments may contain semicolons, which separate the fields below.
    text = re.sub(r"/\*.*?\*/", "", source, flags=re.DOTALL)
    # Array lengths may be macros, such as MOST_PIECES.
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


def array_of(memory: memoryview) -> ctypes.Array[ctypes.c_char]:
    """Return writable memory as a ctypes array for arguments of compiled functions, without a copy. The
    array keeps the memory alive."""
    return (ctypes.c_char * len(memory)).from_buffer(memory)
