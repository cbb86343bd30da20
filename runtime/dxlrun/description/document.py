"""Document: converts the text of a YAML file into plain values, each with its line and column.

PyYAML only scans and parses (YAML's grammar has two hundred rules). It constructs no objects, so a tag in a
file cannot name a class. Limits are checked on its stream of events, before a tree exists. Arguments are
inserted while the values are made.
"""

from __future__ import annotations

import errno
import math
import os
import re
import stat
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Protocol

import msgspec
import yaml
from yaml.reader import Reader

from dxlrun.description.mistakes.syntax import explain_syntax
from dxlrun.errors import InputError, Mark, Problem

KeyPath = tuple[str | int, ...]
"""Path from the top of a YAML file to a value: keys of mappings and indices of lists."""
LARGEST_FILE = 1024 * 1024
"""Most bytes of a file that is read; files that a person writes are smaller."""
_folder: ContextVar[Path | None] = ContextVar("folder", default=None)
DEEPEST = 32  # nested mappings and lists
MOST_NODES = 200_000  # keys, values, mappings and lists of a file; each use of an anchor counts

_SCALARS: Mapping[str, object] = {
    **dict.fromkeys(("", "~", "null", "Null", "NULL")),
    **dict.fromkeys(("true", "True", "TRUE"), True),
    **dict.fromkeys(("false", "False", "FALSE"), False),
    **dict.fromkeys((".nan", ".NaN", ".NAN"), math.nan),
    **{f"{sign}{word}": float(f"{sign}inf") for sign in ("", "+", "-") for word in (".inf", ".Inf", ".INF")},
}
# Underscores between digits are an extension: 1_000_000 is easier to read than 1000000.
_INT = re.compile(r"[-+]?[0-9]+(?:_[0-9]+)*")
_BASED = re.compile(r"0o[0-7]+|0x[0-9a-fA-F]+")
_FLOAT = re.compile(r"[-+]?(?:\.[0-9]+|[0-9]+(?:_[0-9]+)*(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?")
_LONGEST_NUMBER = 64  # characters; longer is text, because converting a million digits takes long
_Loader: type[yaml.SafeLoader] = getattr(
    yaml, "CSafeLoader", yaml.SafeLoader
)  # the fast scanner, if PyYAML was built with it


class Marks(msgspec.Struct, frozen=True):
    """Line and column of every key and value of one file, by path."""

    file: str
    values: Mapping[KeyPath, Mark]
    keys: Mapping[KeyPath, Mark]
    origins: Mapping[KeyPath, str] = {}  # `rate:=100` for each value with an argument

    def value(self, *path: str | int) -> Mark:
        """Return line and column of a value; if it is not in the file, those of its nearest parent."""
        return self.values.get(path) or self._parent(path)

    def key(self, *path: str | int) -> Mark:
        """Return line and column of a key or list item; if it is not in the file, of its nearest parent."""
        return self.keys.get(path) or self.values.get(path) or self._parent(path)

    def has(self, path: KeyPath) -> bool:
        """Return True if the file has a value at this path."""
        return path in self.values

    def _parent(self, path: KeyPath) -> Mark:
        for end in range(len(path) - 1, -1, -1):
            mark = self.keys.get(path[:end]) or self.values.get(path[:end])
            if mark is not None:
                return mark
        return Mark(self.file)


class _Place(Protocol):
    """Place in a YAML text, counted from 0, as PyYAML gives it; its two scanners have own classes."""

    line: int
    column: int


class Tree(msgspec.Struct, frozen=True):
    """Parsed YAML nodes of a file, and problems (refused tags) that do not prevent reading them."""

    root: yaml.MappingNode
    problems: tuple[Problem, ...]


def read_file(path: Path) -> bytes:
    """Return the bytes of a regular file of at most `LARGEST_FILE` bytes.

    Raises:
        OSError: The file cannot be read, is too large or is not a regular file; `strerror` is the reason.
    """
    # One byte more shows that a file is too large, without reading the rest.
    data = read_start(path, LARGEST_FILE + 1)
    if len(data) > LARGEST_FILE:
        raise OSError(errno.EFBIG, f"the file is larger than {LARGEST_FILE // 1024} KiB", str(path))
    return data


def read_start(path: Path, most: int) -> bytes:
    """Return the first bytes of a regular file, at most `most`. Raises OSError as `read_file`."""
    folder = _folder.get()
    if folder is not None and not path.resolve().is_relative_to(folder):
        raise PermissionError(errno.EACCES, "it is outside the permitted folder", str(path))
    with open(path, "rb", opener=_opened) as stream:
        return stream.read(most)


def _opened(name: str, flags: int) -> int:
    """Open a file without blocking on a pipe; raise OSError if it is not a regular file."""
    descriptor = os.open(name, flags | getattr(os, "O_NONBLOCK", 0))
    mode = os.fstat(descriptor).st_mode
    if stat.S_ISREG(mode):
        return descriptor
    os.close(descriptor)
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, "this is a directory", name)
    raise OSError(errno.EINVAL, "this is not a regular file", name)


@contextmanager
def confined(folder: Path) -> Iterator[None]:
    """Context manager in which `read_file` refuses files outside a folder, for untrusted robot files."""
    token = _folder.set(folder.resolve())
    try:
        yield
    finally:
        _folder.reset(token)


def read_text(path: Path, language: str = "YAML") -> str:
    """Return the text of a file, which must be UTF-8.

    Args:
        path: The file.
        language: Name of the format in messages.

    Raises:
        InputError: The file is missing, too large or not UTF-8.
    """
    file = str(path)
    try:
        data = read_file(path)
    except FileNotFoundError:
        raise refusal(
            Mark(file), "file not found", "check the path, relative to the current directory"
        ) from None
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        number = error.errno if isinstance(error, OSError) else None
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        if number in (errno.EISDIR, errno.EINVAL):
            raise refusal(Mark(file), reason, f"name a {language} file") from None
        if number == errno.EFBIG:
            raise refusal(Mark(file), reason, "split it, or shorten it") from None
        what, fix = f"the file cannot be read ({reason})", "check its name and permissions"
        raise refusal(Mark(file), what, fix) from None
    return _decoded(data, file, language)


def _decoded(data: bytes, file: str, language: str) -> str:
    try:
        # utf-8-sig also accepts the byte order mark that some editors write.
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        before = error.object[: error.start].decode("utf-8")
        what = f"the byte 0x{error.object[error.start]:02x} is not UTF-8"
        raise refusal(_mark_at(before, len(before), file), what, "save the file as UTF-8") from None
    if found := Reader.NON_PRINTABLE.search(text):
        what = f"the character U+{ord(found[0]):04X} is not allowed in {language}"
        raise refusal(_mark_at(text, found.start(), file), what, "remove it")
    return text


def parse(text: str, file: str) -> Tree:
    """Parse YAML; raise InputError if the text is not YAML, or its top level is not a mapping."""
    try:
        problems = tuple(_refused_tags(text, file))
        root = yaml.compose(text, _Loader)
    except yaml.MarkedYAMLError as error:
        raise InputError(explain_syntax(text, file) or [_explained(error, text, file)]) from None
    except yaml.YAMLError as error:
        raise refusal(Mark(file), f"this is not YAML ({error})", "correct it") from None
    if root is None:
        raise refusal(Mark(file), "the file is empty", "write `key: value` lines")
    if not isinstance(root, yaml.MappingNode):
        raise refusal(node_mark(root, file), "the file is not a mapping", "write `key: value` lines")
    return Tree(root, problems)


def _refused_tags(text: str, file: str) -> Iterator[Problem]:
    """Yield a problem for each tag (`!x`) in a YAML text; raise InputError if it is too deep or too large."""
    depth = nodes = documents = 0
    for event in yaml.parse(text, _Loader):
        mark = _mark(event.start_mark, file)
        if isinstance(event, yaml.DocumentStartEvent):
            documents += 1
            if documents > 1:
                raise refusal(mark, "a second document starts here", "keep one document per file")
        elif isinstance(event, yaml.CollectionStartEvent):
            depth += 1
            if depth > DEEPEST:
                raise refusal(mark, f"this is nested deeper than {DEEPEST} levels", "reduce the nesting")
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
    """Return file, line and column where a YAML node starts."""
    return _mark(node.start_mark, file)


def _mark(place: _Place | None, file: str) -> Mark:
    # PyYAML counts from 0
    return Mark(file) if place is None else Mark(file, place.line + 1, place.column + 1)


def refusal(mark: Mark, what: str, fix: str) -> InputError:
    """Return an InputError with a single problem: place, problem, fix."""
    return InputError([Problem(mark, what, fix)])


def _mark_at(text: str, index: int, file: str) -> Mark:
    lines = text[:index].split("\n")
    return Mark(file, len(lines), len(lines[-1]) + 1)


def _explained(error: yaml.MarkedYAMLError, text: str, file: str) -> Problem:
    """Convert an error of PyYAML into a problem with dxlrun's words and a fix."""
    place = error.problem_mark or error.context_mark
    opened = error.context_mark
    reported = error.problem or ""
    if "unexpected end of stream" in reported and opened is not None:
        place = opened
    mark = _mark(place, file)
    since = f" (opened in line {opened.line + 1})" if opened is not None else ""
    line = (text.splitlines() or [""])[min(mark.line, len(text.splitlines())) - 1] if text else ""
    character = line[mark.column - 1 : mark.column]
    if "expected ',' or" in reported and line[: mark.column - 1].endswith("$"):
        return Problem(mark, "${...} inside { } or [ ] has no quotes", 'write "${name}"')
    if "found a tab" in reported or ("cannot start any token" in reported and character == "\t"):
        return Problem(mark, "the indentation contains a tab", "indent with spaces")
    for part, what, fix in _WORDS:
        if part in reported:
            return Problem(mark, what.format(since=since, character=character), fix)
    return Problem(mark, f"this is not YAML ({reported})", "correct it")


_WORDS = (
    ("cannot start any token", "a value cannot start with {character}", "put the value in quotes"),
    (
        "mapping values are not allowed",
        "this ':' is not allowed here",
        "indent all keys of a mapping equally, and put text with ': ' in quotes",
    ),
    ("unexpected ':'", "this ':' is not allowed here", "write `key: value` with a space after the ':'"),
    ("entries are not allowed", "a list cannot start here", "start the list on a new line, or write [a, b]"),
    ("unexpected end of stream", "this quote is not closed", "close it in its line"),
    ("expected ',' or", "a comma is missing here, inside the brackets{since}", "add it"),
    ("could not find expected ':'", "a key has no ':'", "write `key: value`"),
    ("expected key", "this line does not match the indentation above", "use the same indentation"),
    ("'-' indicator", "this line does not belong to the list above it", "start it with '- ', or indent it"),
    ("block end", "this line does not match the indentation above", "use the same indentation"),
    ("undefined alias", "the anchor of this alias is not defined above", "write the value"),
    ("duplicate anchor", "this anchor is already defined", "rename it"),
    ("node content", "a value is missing here", "write a value, or put the character in quotes"),
    ("unknown escape", "this is not an escape sequence of YAML", "use single quotes"),
)


class FilledScalar(msgspec.Struct, frozen=True):
    """Value of one scalar of a file with its arguments `${name}` inserted, or the problems of that."""

    value: object
    origin: str | None = None  # `rate:=100` if it contains an argument
    problems: tuple[tuple[str, str], ...] = ()  # problem and fix
    unknown: bool = False  # the value is not known; further checks must skip it


Fill = Callable[[KeyPath, str, bool], FilledScalar]  # Converts path, text and quoted or not into a value.


def literal(path: KeyPath, text: str, quoted: bool) -> FilledScalar:
    """Return the value of a scalar as YAML reads it, without inserting arguments."""
    return FilledScalar(text if quoted else plain_value(text))


class PlainDocument(msgspec.Struct, frozen=True):
    """All values of a file as dicts and lists, with their places and the problems found so far."""

    data: dict[str, object]
    marks: Marks
    problems: tuple[Problem, ...]
    unknown: frozenset[KeyPath]  # places with a reported problem; their values mean nothing


def grow(tree: Tree, file: str, fill: Fill) -> PlainDocument:
    """Convert parsed YAML into plain values; `fill` computes each scalar. Anchors must not be endless.

    Raises InputError for an endless or huge document.
    """
    grower = _Grower(tree, file, fill)
    return PlainDocument(
        grower.mapping(tree.root, ()),
        Marks(file, grower.values, grower.keys, grower.origins),
        (*tree.problems, *grower.problems),
        frozenset(grower.unknown),
    )


class _Grower:
    """Visits all YAML nodes of a file once and collects values, places and problems."""

    def __init__(self, tree: Tree, file: str, fill: Fill) -> None:
        self._file = file
        self._fill = fill
        self._tagged = {problem.mark for problem in tree.problems}
        self._nodes = 0
        self.values: dict[KeyPath, Mark] = {}
        self.keys: dict[KeyPath, Mark] = {}
        self.origins: dict[KeyPath, str] = {}
        self._merge_keys: list[Mark] = []
        self._problems: list[Problem] = []
        self.unknown: set[KeyPath] = set()

    @property
    def problems(self) -> list[Problem]:
        """Problems of the file; all merge keys `<<` together are one problem."""
        if not self._merge_keys:
            return self._problems
        more = len(self._merge_keys) - 1
        what = f"the merge key << is not YAML 1.2{f' (and {more} more)' * bool(more)}"
        fix = "put shared keys of joints in joint_defaults or groups, and shared sections in an include"
        return [*self._problems, Problem(self._merge_keys[0], what, fix)]

    def value(self, node: yaml.Node, path: KeyPath) -> object:
        """Return the value of a YAML node at a path, and note its place."""
        if isinstance(node, yaml.MappingNode):
            return self.mapping(node, path)
        self._enter(node, path)
        if isinstance(node, yaml.SequenceNode):
            return [self.value(item, (*path, index)) for index, item in enumerate(node.value)]
        assert isinstance(node, yaml.ScalarNode)  # noqa: S101 (YAML has three kinds of nodes)
        return self._scalar(node, path)

    def mapping(self, node: yaml.MappingNode, path: KeyPath) -> dict[str, object]:
        """Return a mapping as a dict with keys as text; of two equal keys, the second is a problem."""
        self._enter(node, path)
        result: dict[str, object] = {}
        for key_node, value_node in node.value:
            key = self._key(key_node, path)
            if key is None:
                continue
            here = (*path, key)
            mark = node_mark(key_node, self._file)
            if key in result:
                what = f"{'.'.join(map(str, here))} is already defined in line {self.keys[here].line}"
                self._problems.append(Problem(mark, what, "keep one of the two"))
                continue
            self.keys[here] = mark
            result[key] = self.value(value_node, here)
        return result

    def _enter(self, node: yaml.Node, path: KeyPath) -> None:
        mark = node_mark(node, self._file)
        self._nodes += 1
        if len(path) > DEEPEST:
            what = f"this is nested deeper than {DEEPEST} levels, or an anchor contains itself"
            raise refusal(mark, what, "reduce the nesting")
        if self._nodes > MOST_NODES:
            what = f"the file has more than {MOST_NODES} values after its aliases are expanded"
            raise refusal(mark, what, "write fewer")
        self.values[path] = mark
        if mark in self._tagged:
            self.unknown.add(path)

    def _key(self, node: yaml.Node, path: KeyPath) -> str | None:
        """Return a key of a mapping as text; None, with a problem, if it is not a simple word."""
        mark = node_mark(node, self._file)
        if not isinstance(node, yaml.ScalarNode):
            self._problems.append(
                Problem(mark, "a mapping or a list cannot be a key", "write a name before the ':'")
            )
            return None
        if node.value == "<<" and not _quoted(node):
            self._merge_keys.append(mark)
            if path:
                self.unknown.add(path)  # the merged keys are missing in it
            return None
        if not node.value:
            self._problems.append(Problem(mark, "a key is empty", "write a name before the ':'"))
            return None
        if "${" in node.value:
            self._problems.append(Problem(mark, "a key cannot contain ${...}", "write the key"))
            return None
        return str(node.value)

    def _scalar(self, node: yaml.ScalarNode, path: KeyPath) -> object:
        filled = self._fill(path, node.value, _quoted(node))
        mark = self.values[path]
        self._problems.extend(Problem(mark, what, fix) for what, fix in filled.problems)
        if filled.unknown:
            self.unknown.add(path)
        if filled.origin is not None:
            self.origins[path] = filled.origin
        return filled.value


def _quoted(node: yaml.ScalarNode) -> bool:
    # A plain scalar has the style None in one scanner of PyYAML, "" in the other.
    return bool(node.style)


def plain_value(text: str) -> object:
    """Return the value of a scalar without quotes, by YAML 1.2: None, bool, int, float or str.

    Follows the core schema of YAML 1.2: `yes` and `on` are text, `010` is ten. PyYAML follows YAML 1.1, where
    `no` is false and `1:30` is ninety, so only its syntax is used, not its values.
    """
    if text in _SCALARS:
        return _SCALARS[text]
    if len(text) > _LONGEST_NUMBER:
        return text
    if _INT.fullmatch(text):
        return int(text)
    if _BASED.fullmatch(text):
        return int(text, 0)
    return float(text) if _FLOAT.fullmatch(text) else text


def text_of(value: object) -> str:
    """Write a scalar as text that `plain_value` reads back to the same value."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float) and not math.isfinite(value):
        return ".nan" if math.isnan(value) else ("-.inf" if value < 0 else ".inf")
    return str(value)
