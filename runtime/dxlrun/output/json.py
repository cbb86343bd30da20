"""JSON: the answers of commands with --json, see docs/reference/commands.md."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import TypeAlias

from dxlrun.errors import Problem, what_and_fix
from dxlrun.output.escaping import escaped_json

Report: TypeAlias = Sequence[Problem | str]
"""Errors or warnings: problems with places in files, or sentences `problem; fix`."""
NO_REASON: Mapping[str, object] = MappingProxyType({})


def answer_text(
    result: object,
    errors: Report,
    warnings: Report,
    reason: Mapping[str, object] = NO_REASON,
    *,
    ok: bool,
    indent: int | None = None,
) -> str:
    """Return the JSON text of a command's answer: `ok`, `result`, `errors` and `warnings`.

    `reason`: code and fields of a running robot's refusal.
    """
    answer = {
        "ok": ok,
        "result": result,
        "errors": [{**_problem(one), **reason} for one in errors],
        "warnings": [_problem(one) for one in warnings],
    }
    return json_text(answer, indent)


def json_text(value: object, indent: int | None = 2) -> str:
    """Write any value as JSON: dataclasses by field, bytes in hexadecimal, NaN and infinity as null."""
    # Imported here because most commands print no JSON.
    import msgspec

    plain = _plain(msgspec.to_builtins(value, builtin_types=(bytes,)))
    return escaped_json(json.dumps(plain, ensure_ascii=False, indent=indent))


def _plain(value: object) -> object:
    if isinstance(value, bytes):
        return value.hex()
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, list | tuple) else value


def _problem(problem: Problem | str) -> dict[str, object]:
    """Return a problem as a JSON object; a sentence has null for file, line and column."""
    if isinstance(problem, str):
        what, fix = what_and_fix(problem)
        place: tuple[object, ...] = None, None, None
    else:
        what, fix, mark = problem.what, problem.fix, problem.mark
        place = mark.file, mark.line, mark.column
    file, line, column = place
    return {
        "what": what,
        "fix": fix,
        "file": file,
        "line": line,
        "column": column,
        "code": None,
        "fields": {},
    }
