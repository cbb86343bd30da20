"""The envelope of every answer of a command with --json, as commands.md has it."""

from typing import Any

import msgspec


class Problem(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    what: str
    fix: str
    file: str | None
    line: int | None
    column: int | None
    code: str | None
    fields: dict[str, Any]


class Answer(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    ok: bool
    result: Any
    errors: tuple[Problem, ...]
    warnings: tuple[Problem, ...]


def read_answer(text: str | bytes) -> Answer:
    """Return an answer. Raises msgspec.ValidationError for another form."""
    answer = msgspec.json.decode(text, type=Answer)
    assert answer.ok != bool(answer.errors), answer
    return answer


def result_of(text: str | bytes) -> Any:
    """Return the result in an answer, whose form is checked."""
    return read_answer(text).result
