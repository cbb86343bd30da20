"""JSON: results of commands as programs read them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

from dxlrun.output.escaping import escaped_json

if TYPE_CHECKING:
    from dxlrun.errors import Problem


def json_text(value: object) -> str:
    """Return a result as JSON, indented: dataclasses by their fields, bytes in hexadecimal, NaN as null."""
    import msgspec  # not above: a refusal needs none of it

    plain = _hexadecimal(msgspec.to_builtins(value, builtin_types=(bytes,)))
    return escaped_json(msgspec.json.format(msgspec.json.encode(plain), indent=2).decode())


def _hexadecimal(value: object) -> object:
    if isinstance(value, bytes):
        return value.hex()
    if isinstance(value, Mapping):
        return {key: _hexadecimal(item) for key, item in value.items()}
    return [_hexadecimal(item) for item in value] if isinstance(value, list | tuple) else value


def problems_json(problems: Iterable[Problem]) -> list[dict[str, object]]:
    """Return problems as commands print them under --json."""
    return [
        {
            "file": problem.mark.file,
            "line": problem.mark.line,
            "column": problem.mark.column,
            "what": problem.what,
            "mend": problem.fix,
        }
        for problem in problems
    ]
