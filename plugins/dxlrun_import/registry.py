"""Registry: all formats that this package knows, in the order in which a file is compared with them."""

from __future__ import annotations

from dxlrun_import.formats import pypot, roboplus, signatures

FORMATS = (
    *signatures.FIRST,
    pypot.FORMAT,
    roboplus.FORMAT,
    *signatures.LAST,
)
"""The first format whose predicate is true is the one of a file."""
