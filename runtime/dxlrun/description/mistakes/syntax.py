"""Syntax: explains YAML errors by unclosed brackets and quotes, missing colons and units behind lists.

A YAML parser fails where it cannot continue, which is often far below the mistake. The indentation of the
keys below shows which bracket is not closed, and a key inside a quote that the quote is not closed.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import accumulate

import msgspec

from dxlrun.errors import Mark, Problem

_CLOSERS = {"{": "}", "[": "]"}
_DEEPEST = 32  # levels; a text that is nested deeper is refused for that reason
# Most files have no such mistake, so these are compiled on first use.
_KEY = r"( *)(?:- +)*(?:[\w./-]+|\"[^\"]*\"|'[^']*') *:(?= |$)"
_NUMBER = r"[-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?"
_UNIT = r"(?:%|°|[A-Za-z]+(?:/[A-Za-z]+)?(?:\^\d)?)"
_LIST_WITH_UNIT = rf"([\[(])([^\[\](){{}}]*)[\])]\s*({_UNIT})(?=\s*(?:[,}}\]#]|$))"
_RANGE = (
    rf"[\[(]?\s*({_NUMBER})\s*({_UNIT})?\s*(?:,|;|\.\.+|to\b|\s)\s*"
    rf"({_NUMBER})\s*({_UNIT})?\s*[\])]?\s*({_UNIT})?"
)
_MISSING_COLON = r"^ *[A-Za-z][\w-]*( )[{\[]"
_EQUALS_SIGN = r"^ *(?:- +)?([A-Za-z][\w-]*) *(=) *([^\s=:][^:]*?)\s*$"
_SLASHES = r"^[^#\"']*[\s}\]](//)\s"
_TYPOGRAPHIC_QUOTE = r"^[^#]*?[:,{\[-] *([“”„‟«])"
_BLOCK_SCALAR = r"(?:^|[ :-])[|>][-+0-9]*\s*$"


class _OpenQuoteError(Exception):
    """Raised if a quote is not closed, so that brackets after it cannot be judged.

    Its line and column are counted from 0.
    """

    def __init__(self, line: int, column: int) -> None:
        self.line, self.column = line, column


class _Bracket(msgspec.Struct, frozen=True):
    """An open bracket: its line and column, counted from 0, and the indentation of its line."""

    character: str
    line: int
    column: int
    indentation: int


def explain_syntax(text: str, file: str) -> list[Problem]:
    """Return problems with fixes for a text that is not YAML; empty if no known mistake is found."""
    lines = text.splitlines()
    found = [*_units_behind_lists(lines, file), *_foreign_signs(lines, file)]
    return sorted(found, key=lambda problem: problem.mark) or _open_brackets(lines, file)


def list_text(text: str) -> str:
    """Rewrite a range as a YAML list: `[-90 deg, 90 deg]` for `-90..90 deg`; empty if it is not a range."""
    match = re.fullmatch(_RANGE, text.strip())
    if match is None:
        return ""
    unit = match[5] or match[4] or match[2]
    first, second = (
        f"{each} {_unit(own or unit)}".strip() for each, own in ((match[1], match[2]), (match[3], match[4]))
    )
    return f"[{first}, {second}]"


def _unit(unit: str | None) -> str:
    return {"°": "deg", "degrees": "deg", "degree": "deg", "radians": "rad"}.get(unit or "", unit or "")


def _units_behind_lists(lines: list[str], file: str) -> Iterator[Problem]:
    for number, line in enumerate(lines, 1):
        for match in re.finditer(_LIST_WITH_UNIT, line.partition(" #")[0]):
            items = [item.strip() for item in match[2].split(",")]
            if not all(re.fullmatch(_NUMBER, item) for item in items):
                continue
            written = ", ".join(f"{item} {_unit(match[3])}" for item in items)
            yield Problem(
                Mark(file, number, match.start(3) + 1),
                f"a list cannot have a unit ({match[3]})",
                f"write the unit after each number: [{written}]",
            )


def _foreign_signs(lines: list[str], file: str) -> Iterator[Problem]:
    """Yield a problem for each colon, comment or quote that is missing, or written as in other languages."""
    for number, line in enumerate(lines, 1):
        if match := re.search(_MISSING_COLON, line):
            mark = Mark(file, number, match.start(1) + 1)
            yield Problem(mark, "a colon is missing before this", "write `key: value`")
        if match := re.search(_EQUALS_SIGN, line):
            mark = Mark(file, number, match.start(2) + 1)
            yield Problem(mark, "this = is not a colon", f"write `{match[1]}: {match[3]}`")
        if match := re.search(_SLASHES, line):
            mark = Mark(file, number, match.start(1) + 1)
            yield Problem(mark, "// does not start a comment", "write # instead")
        if match := re.search(_TYPOGRAPHIC_QUOTE, line):
            mark = Mark(file, number, match.start(1) + 1)
            yield Problem(mark, f"the quote {match[1]} is not a quote of YAML", 'write "')


def _open_brackets(lines: list[str], file: str) -> list[Problem]:
    """Return a problem for each bracket that is not closed or does not match."""
    try:
        if not _scanned(lines, file, by_keys=False) or _depth(lines) > _DEEPEST:
            return []
        return _scanned(lines, file, by_keys=True)
    except _OpenQuoteError as quote:
        mark = Mark(file, quote.line + 1, quote.column + 1)
        return [Problem(mark, "this quote is not closed", "close it in its line")]


def _depth(lines: list[str]) -> int:
    depths = accumulate(1 if each in _CLOSERS else -1 for *_, each, _ in _structure(lines) if each)
    return max(depths, default=0)


def _scanned(lines: list[str], file: str, *, by_keys: bool) -> list[Problem]:
    """Match the brackets of a text, and return the problems.

    Args:
        lines: The text.
        file: Its name.
        by_keys: True: a key that is not indented deeper than the line of an open bracket ends that bracket.
    """
    problems: list[Problem] = []
    opened: list[_Bracket] = []
    for number, column, character, before in _structure(lines):
        line = lines[number]
        indentation = len(line) - len(line.lstrip(" "))
        if not character:
            ended = [each for each in opened if by_keys and each.indentation >= column and each.line < number]
            if ended:
                problems.append(_not_closed(ended, lines, number, file))
                opened = opened[: -len(ended)]
        elif character in _CLOSERS:
            if opened or before in ("", ":", "-", "?"):  # else it is part of a text
                opened.append(_Bracket(character, number, column, indentation))
        elif opened and _CLOSERS[opened[-1].character] == character:
            opened.pop()
        elif any(_CLOSERS[each.character] == character for each in opened):
            problems.append(_mismatch(opened[-1], character, Mark(file, number + 1, column + 1)))
            while opened and _CLOSERS[opened.pop().character] != character:
                pass
        elif opened or before in ("]", "}"):  # else it is part of a text
            mark = Mark(file, number + 1, column + 1)
            problems.append(
                Problem(mark, f"this {character} has no opening bracket", "remove it, or open the bracket")
            )
    if opened:
        same = [each for each in opened if each.line == opened[-1].line]
        problems.append(_not_closed(same, lines, len(lines), file))
    return sorted(problems, key=lambda problem: problem.mark)


def _structure(lines: list[str]) -> Iterator[tuple[int, int, str, str]]:
    """Yield brackets outside of quotes, comments and block scalars, and the keys at starts of lines.

    Each has line and column from 0, and the last character before it that is not a space. For a key at the
    beginning of a line the bracket is empty, and the column is the indentation of the key.
    """
    quote, opened = "", (0, 0)
    block: int | None = None  # indentation of the line above a block scalar (`key: |`)
    for number, line in enumerate(lines):
        indentation = len(line) - len(line.lstrip(" "))
        if block is not None and (not line.strip() or indentation > block):
            continue
        block = indentation if re.search(_BLOCK_SCALAR, line) else None
        if key := re.match(_KEY, line):
            if quote:  # few texts of several lines have a line like that
                raise _OpenQuoteError(*opened)
            yield number, len(key[1]), "", ""
        escaped, before = False, ""
        for column, character in enumerate(line):
            if quote:
                quote = "" if character == quote and not escaped else quote
                escaped = character == "\\" and quote == '"' and not escaped
            elif character == "#" and line[column - 1 : column] in ("", " "):
                break
            elif character in "\"'" and before in ("", *":-[{,?"):
                quote, opened = character, (number, column)
            elif character in "[]{}":
                yield number, column, character, before
            before = before if character == " " else character
    if quote:
        raise _OpenQuoteError(*opened)


def _not_closed(unclosed: list[_Bracket], lines: list[str], number: int, file: str) -> Problem:
    """Return the problem that brackets are not closed before line `number` (from 0)."""
    last = unclosed[-1]
    end = next((above for above in range(number - 1, last.line, -1) if lines[above].strip()), last.line)
    closers = "".join(_CLOSERS[each.character] for each in reversed(unclosed))
    return Problem(
        Mark(file, last.line + 1, last.column + 1),
        f"this {last.character} is not closed",
        f"write {closers} at the end{f' of line {end + 1}' if lines[1:] else ''}",
    )


def _mismatch(bracket: _Bracket, character: str, mark: Mark) -> Problem:
    where = f"the {character} in line {mark.line}, column {mark.column}"
    return Problem(
        Mark(mark.file, bracket.line + 1, bracket.column + 1),
        f"this {bracket.character} is not closed",
        f"write {_CLOSERS[bracket.character]} before {where}",
    )
