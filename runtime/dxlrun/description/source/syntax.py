"""Syntax: a file's bytes -> a tree of YAML nodes, within limits; what is wrong is said in our words.

Nothing is constructed here, so no tag of a file can name a class. PyYAML does the scanning (a library, since
YAML's grammar has two hundred rules); limits are checked on its stream of events, before a tree exists.
"""

from __future__ import annotations

import stat
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import yaml
from yaml.reader import Reader

from dxlrun.errors import InputError, Mark, Problem

LARGEST_FILE = 1 << 20
"""Bytes."""
DEEPEST = 32
"""Mappings and lists inside each other."""
MOST_NODES = 200_000
"""Keys, values, mappings and lists of a file, with every use of an anchor counted."""

_Loader: type[yaml.SafeLoader] = getattr(
    yaml, "CSafeLoader", yaml.SafeLoader
)  # the fast one where it was built


class _Place(Protocol):
    """PyYAML's mark; its two scanners have a class each."""

    line: int
    column: int


@dataclass(frozen=True, slots=True)
class Tree:
    """A file's nodes, and what is wrong with them although they could be read."""

    root: yaml.MappingNode
    problems: tuple[Problem, ...]


def read_text(path: Path, language: str = "YAML") -> str:
    """Return the text of a file; raises InputError when it is missing, too large, or no UTF-8.

    `language` is what the problems call it.
    """
    file = str(path)
    try:
        mode = path.stat().st_mode
        data = b""
        if stat.S_ISREG(mode):  # reading a pipe or a device might never end
            with path.open("rb") as stream:
                data = stream.read(LARGEST_FILE + 1)
    except FileNotFoundError:
        raise refusal(Mark(file), "there is no such file", "check the path; it counts from here") from None
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise refusal(
            Mark(file), f"the file cannot be read ({reason})", "check its name and its rights"
        ) from None
    if not stat.S_ISREG(mode):
        kind = "a directory" if stat.S_ISDIR(mode) else "not a regular file"
        raise refusal(Mark(file), f"this is {kind}", f"name a {language} file")
    if len(data) > LARGEST_FILE:
        raise refusal(
            Mark(file), f"the file is larger than {LARGEST_FILE // 1024} KiB", "split it, or thin it out"
        )
    return _decoded(data, file, language)


def _decoded(data: bytes, file: str, language: str) -> str:
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        before = error.object[: error.start].decode("utf-8")
        what = f"the byte 0x{error.object[error.start]:02x} is no UTF-8"
        raise refusal(_mark_at(before, len(before), file), what, "save the file as UTF-8") from None
    if found := Reader.NON_PRINTABLE.search(text):
        what = f"the character U+{ord(found[0]):04X} cannot stand in {language}"
        raise refusal(_mark_at(text, found.start(), file), what, "take it out")
    return text


def parse(text: str, file: str) -> Tree:
    """Return the nodes of a text whose top is a mapping; raises InputError when it is no such YAML."""
    try:
        problems = tuple(_refused_tags(text, file))
        root = yaml.compose(text, _Loader)
    except yaml.MarkedYAMLError as error:
        raise InputError([_in_our_words(error, text, file)]) from None
    except yaml.YAMLError as error:
        raise refusal(Mark(file), f"this is not YAML ({error})", "correct it") from None
    if root is None:
        raise refusal(Mark(file), "the file is empty", "describe a robot or a motion in it")
    if not isinstance(root, yaml.MappingNode):
        raise refusal(node_mark(root, file), "the file is not a mapping", "write `key: value` lines")
    return Tree(root, problems)


def _refused_tags(text: str, file: str) -> Iterator[Problem]:
    """Yield a problem for each tag; raises InputError beyond the limits."""
    depth = nodes = documents = 0
    for event in yaml.parse(text, _Loader):
        mark = _mark(event.start_mark, file)
        if isinstance(event, yaml.DocumentStartEvent):
            documents += 1
            if documents > 1:
                raise refusal(mark, "a second document starts here", "keep one document a file")
        elif isinstance(event, yaml.CollectionStartEvent):
            depth += 1
            if depth > DEEPEST:
                raise refusal(mark, f"this is nested deeper than {DEEPEST} levels", "make it flatter")
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
        if isinstance(event, yaml.NodeEvent):
            nodes += 1
            if nodes > MOST_NODES:
                raise refusal(mark, f"the file has more than {MOST_NODES} values", "split it")
            tag = getattr(event, "tag", None)  # an alias has none
            if tag is not None:
                yield Problem(
                    mark,
                    f"the tag {tag.replace('tag:yaml.org,2002:', '!!')} is refused",
                    "write the value without a tag",
                )


def node_mark(node: yaml.Node, file: str) -> Mark:
    """Return where a node starts."""
    return _mark(node.start_mark, file)


def _mark(place: _Place | None, file: str) -> Mark:
    # PyYAML counts from 0
    return Mark(file) if place is None else Mark(file, place.line + 1, place.column + 1)


def refusal(mark: Mark, what: str, fix: str) -> InputError:
    """Return an InputError with one problem."""
    return InputError([Problem(mark, what, fix)])


def _mark_at(text: str, index: int, file: str) -> Mark:
    lines = text[:index].split("\n")
    return Mark(file, len(lines), len(lines[-1]) + 1)


def _in_our_words(error: yaml.MarkedYAMLError, text: str, file: str) -> Problem:
    """Say what the scanner or parser stumbled over, and how to fix it."""
    place = error.problem_mark or error.context_mark
    opened = error.context_mark
    said = error.problem or ""
    if "unexpected end of stream" in said and opened is not None:
        place = opened
    mark = _mark(place, file)
    since = f" (opened in line {opened.line + 1})" if opened is not None else ""
    line = (text.splitlines() or [""])[min(mark.line, len(text.splitlines())) - 1] if text else ""
    character = line[mark.column - 1 : mark.column]
    if "expected ',' or" in said and line[: mark.column - 1].endswith("$"):
        return Problem(mark, "${...} stands inside { } or [ ] without quotes", 'put it in quotes: "${name}"')
    if "cannot start any token" in said and character == "\t":
        return Problem(mark, "there is a tab in the indentation", "indent with spaces")
    for part, what, fix in _WORDS:
        if part in said:
            return Problem(mark, what.format(since=since, character=character), fix)
    return Problem(mark, f"this is not YAML ({said})", "correct it")


_WORDS = (
    ("cannot start any token", "a value cannot start with {character}", "put it in quotes"),
    (
        "mapping values are not allowed",
        "there is a ':' where none can be",
        "indent the keys of a mapping alike, and put a text with ': ' in quotes",
    ),
    ("unexpected ':'", "a ':' stands where none can be", "write `key: value` with a space behind the ':'"),
    ("entries are not allowed", "a list cannot start here", "start it on a new line, or write [a, b]"),
    ("unexpected end of stream", "a quote is opened here and never closed", "close it"),
    ("expected ',' or", "a comma is missing, or a bracket{since} is not closed", "add it"),
    ("could not find expected ':'", "a key has no ':'", "write `key: value`"),
    (
        "expected key",
        "this line is indented unlike the lines that it belongs to",
        "indent it like its neighbours",
    ),
    ("'-' indicator", "this line does not belong to the list above it", "start it with '- ', or indent it"),
    (
        "block end",
        "this line is indented unlike the lines that it belongs to",
        "indent it like its neighbours",
    ),
    ("undefined alias", "this alias names no anchor above it", "write the value itself"),
    ("duplicate anchor", "this anchor was given before", "give it another name"),
    ("node content", "a value is missing here", "write one, or put the character in quotes"),
    ("unknown escape", "a backslash stands before a character that it does not change", "use single quotes"),
)
