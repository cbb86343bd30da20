"""Pruning: a robot file's data without the parts whose form is wrong, so that the rest can be checked too.

A person wants all mistakes of a file at once: also the ones that only show when parts are compared.
"""

from __future__ import annotations

from collections.abc import Iterable

from dxlrun.description.marks import KeyPath

_PLACEHOLDERS: dict[str, object] = {"name": "unnamed", "loop": {"rate": 1.0}}
"""For what a robot cannot be without; whoever checks further sees in `left_out` that they mean nothing."""


def prune(data: dict[str, object], wrong: Iterable[KeyPath]) -> frozenset[KeyPath]:
    """Take the parts at the wrong paths out of `data`, and return what was taken out.

    Whole entries of buses, joints and controllers go; elsewhere single keys, so that their default counts.
    """
    left_out: set[KeyPath] = set()
    for path in wrong:
        if not path:
            continue
        section = data.get(str(path[0]))
        if len(path) == 1 or not isinstance(section, dict):
            data.pop(str(path[0]), None)
            left_out.add(path[:1])
        else:
            section.pop(path[1], None)
            if not section:  # what is left says nothing, and may need what was wrong
                del data[str(path[0])]
            left_out.add(path[:2])
    for key, value in _PLACEHOLDERS.items():
        data.setdefault(key, value)
    loop = data["loop"]
    if isinstance(loop, dict):
        loop.setdefault("rate", 1.0)
    return frozenset(left_out)
